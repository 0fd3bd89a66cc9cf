"""Pages of the site that are not files of docs/: those of the repository's root, and the commands' own help.

MkDocs calls `on_config`, `on_files` and `on_page_markdown` while it builds. Links between the repository's pages are turned into links
between the site's; a link to a file that the site does not have becomes the file's name.
"""

import posixpath
import re
from pathlib import Path

import typer
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parent.parent
GATHERED = {
    "index.md": "README.md",
    "results.md": "benchmarks/README.md",
    "security.md": "SECURITY.md",
    "contributing.md": "CONTRIBUTING.md",
    "changelog.md": "CHANGELOG.md",
}
"""Page of the site: file of the repository."""
WIDTH = 76
"""Of commands' help, in characters: a page shows that many side by side."""
LIST_ITEM = re.compile(r"(- |1\. )")
LINK = re.compile(r"(!?)\[([^\]]*)\]\(([^)#\s]+)(#[^)\s]*)?\)")


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """The menu's part of decisions, in the order of their numbers."""
    decisions = [path.relative_to(ROOT / "docs").as_posix() for path in sorted((ROOT / "docs" / "decisions").glob("*.md"))]
    config.nav = [{"Decisions": decisions} if "Decisions" in entry else entry for entry in config.nav or []]
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    for page, source in GATHERED.items():
        files.append(File.generated(config, page, abs_src_path=str(ROOT / source)))
    files.append(File.generated(config, "commands.md", content=commands_page()))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    here = page.file.src_uri
    source = GATHERED.get(here, f"docs/{here}")
    return LINK.sub(lambda link: site_link(link, source, here, files), part_lists_from_text(markdown))


def part_lists_from_text(markdown: str) -> str:
    """With an empty line before each list: Python-Markdown wants one where other readers do not."""
    lines: list[str] = []
    fenced = False
    for line in markdown.splitlines():
        fenced ^= line.startswith("```")
        above = lines[-1] if lines else ""
        if not fenced and LIST_ITEM.match(line) and above and not above.startswith((" ", "-")) and not re.match(r"\d+\. ", above):
            lines.append("")
        lines.append(line)
    return "\n".join(lines)


def site_link(link: re.Match[str], source: str, here: str, files: Files) -> str:
    """The same link on the page `here`, whose text is the repository's file `source`."""
    picture, text, target, anchor = link[1], link[2], link[3], link[4] or ""
    if "://" in target or target.startswith("mailto:"):
        return link[0]
    path = posixpath.normpath(posixpath.join(posixpath.dirname(source), target))
    page = next((page for page, gathered in GATHERED.items() if gathered == path), path.removeprefix("docs/"))
    if files.get_file_from_path(page) is None:
        return text if text == path else f"{text} (`{path}`)"
    return f"{picture}[{text}]({posixpath.relpath(page, posixpath.dirname(here) or '.')}{anchor})"


def commands_page() -> str:
    """The help of each command, as `drgs COMMAND --help` prints it."""
    from drgs.cli import app

    group = typer.main.get_command(app)
    context = typer.Context(group, info_name="drgs", terminal_width=WIDTH, max_content_width=WIDTH)
    parts = ["# Commands", "Wrong input ends with one sentence on stderr; with `--json`, stdout holds one JSON document and nothing else."]
    for name in group.list_commands(context):
        command = group.get_command(context, name)
        if command is None or command.hidden:
            continue
        inner = typer.Context(command, info_name=name, parent=context, terminal_width=WIDTH, max_content_width=WIDTH)
        parts += [f"## drgs {name}", f"```text\n{command.get_help(inner).strip()}\n```"]
    return "\n\n".join(parts) + "\n"
