"""What the documents promise is there."""

import ast
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


def files_of_ours() -> list[Path]:
    folders = ("drgs", "server", "worker", "web/src", "tests", "benchmarks", "examples", ".github")
    return [*ROOT.glob("*"), *(path for folder in folders for path in (ROOT / folder).rglob("*"))]


def folders_of(path: Path) -> set[str]:
    """Names of the folders inside that hold code or text of ours."""
    inside = (child for child in path.iterdir() if child.is_dir() and not child.name.startswith((".", "_")))
    kept_out = {"node_modules", "static", "out", "data", "site"}
    return {
        child.name for child in inside if child.name not in kept_out and not child.name.endswith(".egg-info") and not is_left_behind(child)
    }


def is_left_behind(folder: Path) -> bool:
    """Where files were moved away, Python's cache of them stays."""
    return {child.name for child in folder.iterdir()} <= {"__pycache__"}


def test_the_tree_in_the_readme_is_the_tree():
    readme = (ROOT / "README.md").read_text()
    block = readme[readme.index("## The tree") :].split("```")[1]
    named = set(re.findall(r"(?<![\w.])(\w+)/(?=[\s:\w])", block))
    # Packages whose parts the block lists, each as one phrase.
    packages = ("drgs", "drgs/deform", "drgs/render", "drgs/reconstruct", "worker/drgs_worker", "server/drgs_server", "web/src")
    listed = [ROOT, *(ROOT / package for package in packages)]
    there = set().union(*map(folders_of, listed)) | {"drgs_worker", "drgs_server", "src"}
    assert named - there == set(), "the README names folders that are not there"
    assert there - named == set(), "folders without a phrase in the README"
    files = set(re.findall(r"(?<![\w./])\w+\.(?:py|txt|toml|md)\b", block))
    assert [name for name in files if not any((folder / name).exists() for folder in listed)] == []


def test_decisions_are_numbered_without_holes():
    pages = sorted((ROOT / "docs" / "decisions").glob("*.md"))
    assert [path.name[:4] for path in pages] == [f"{number:04}" for number in range(1, len(pages) + 1)]
    for number, path in enumerate(pages, 1):
        assert path.read_text().startswith(f"# {number}. "), f"{path.name} does not say its number"


@pytest.mark.parametrize("document", ["docs/how_it_works.md", "docs/conventions.md", "CONTRIBUTING.md"])
def test_files_that_the_text_names_are_there(document: str):
    named = re.findall(r"`([\w./]+\.(?:py|ts|sh|toml|txt|yml|yaml))`", (ROOT / document).read_text())
    everything = [path.relative_to(ROOT).as_posix() for path in files_of_ours()]
    assert [name for name in named if not any(f"/{path}".endswith(f"/{name}") for path in everything)] == []


def test_the_readme_promises_no_gpu_that_the_roadmap_has_never_seen():
    (row,) = [line for line in (ROOT / "docs" / "roadmap.md").read_text().splitlines() if line.startswith("| CUDA |")]
    readme = " ".join((ROOT / "README.md").read_text().split())
    assert ("never run" in row) == ("NVIDIA GPUs, too, without a CUDA toolkit, but it has never been run on one" in readme)


PACKAGES = sorted(path for top in ("drgs", "server", "worker") for path in (ROOT / top).rglob("__init__.py"))


@pytest.mark.parametrize("package", PACKAGES, ids=lambda path: str(path.parent.relative_to(ROOT)))
def test_packages_name_files_that_they_have(package: Path):
    named = re.findall(r"(?<![\w/])[\w*]+\.py\b", ast.get_docstring(ast.parse(package.read_text())) or "")
    assert [name for name in named if not list(package.parent.rglob(name))] == []
