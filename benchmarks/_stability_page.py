"""docs/stability.md: its two sections lie between markers, each written by a benchmark of its own; the rest of the page is written by hand."""

from pathlib import Path

PAGE = Path(__file__).parent.parent / "docs" / "stability.md"


def markers(section: str, benchmark: str) -> tuple[str, str]:
    """What stands before and after a section."""
    return f"<!-- {section}: written by python -m benchmarks {benchmark} -->", f"<!-- {section}: end -->"


def rewritten(page: str, between: tuple[str, str], text: str) -> str:
    """The page with a section replaced.

    Raises:
        ValueError: the page lacks the markers.
    """
    start, end = between
    if page.count(start) != 1 or page.count(end) != 1:
        raise ValueError(f"the page holds its markers {page.count(start)} and {page.count(end)} times; expected once each: {start} {end}")
    return page[: page.index(start) + len(start)] + "\n" + text + page[page.index(end) :]
