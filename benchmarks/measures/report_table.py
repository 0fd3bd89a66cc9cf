"""Nested figures as lines that people read."""

from collections.abc import Iterator


def flat_figures(figures: object, name: str = "") -> Iterator[tuple[str, object]]:
    """(dotted name, value) of every leaf of nested dictionaries; lists stay whole."""
    if isinstance(figures, dict):
        for key, inner in figures.items():
            yield from flat_figures(inner, f"{name}.{key}" if name else str(key))
    else:
        yield name, figures


def figure_lines(figures: dict) -> list[str]:
    return [f"{name:44s} {_text(value)}" for name, value in flat_figures(figures)]


def markdown_table(rows: list[dict[str, object]], columns: list[str]) -> str:
    """A Markdown table; a value that a row lacks is a dash."""
    lines = [f"| {' | '.join(columns)} |", f"|{'---|' * len(columns)}"]
    lines += [f"| {' | '.join(_text(row.get(column)) for column in columns)} |" for row in rows]
    return "\n".join(lines)


def _text(value: object) -> str:
    if value is None:
        return "–"
    if isinstance(value, bool) or not isinstance(value, float):
        return str(value)
    return f"{value:.2f}" if abs(value) >= 1 else f"{value:.3f}"
