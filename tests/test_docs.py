"""What the documents promise is there."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
DOCUMENTS = [*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md"), *ROOT.glob("benchmarks/*.md")]
CODE = [
    path for folder in ("drgs", "worker", "server", "examples") for pattern in ("*.py", "*.h") for path in (ROOT / folder).rglob(pattern)
]


def test_every_cited_source_is_listed():
    listed = set(re.findall(r"^\| (\w+) \|", (ROOT / "docs" / "sources.md").read_text(), re.MULTILINE))
    cited = {
        (key, path.name)
        for path in CODE
        for group in re.findall(r"docs/sources\.md: ([\w, ]+)", path.read_text())
        for key in re.findall(r"\b[a-z]+\d{4}[a-z]*\b", group)
    }
    assert len(cited) > 5, "the pattern finds nothing any more"
    assert {(key, name) for key, name in cited if key not in listed} == set()


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_links_inside_the_repository_lead_somewhere(document: Path):
    targets = re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", document.read_text())
    broken = [target for target in targets if "://" not in target and not (document.parent / target).exists()]
    assert broken == []


def test_the_tree_in_the_readme_is_the_tree():
    readme = (ROOT / "README.md").read_text()
    block = readme[readme.index("## The tree") :].split("```")[1]
    top = set(re.findall(r"(?<![\w/.])([a-z]+)/(?=\s)", block))
    assert {"drgs", "worker", "server", "web", "tests", "benchmarks", "examples", "docs"} <= top
    assert [name for name in top if not ((ROOT / name).is_dir() or (ROOT / "drgs" / name).is_dir())] == []
    subfolders = {path.name for path in (ROOT / "drgs").iterdir() if path.is_dir() and not path.name.startswith("__")}
    assert subfolders <= top, "a folder of drgs has no phrase in the README"
