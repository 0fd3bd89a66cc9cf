"""A curve of costs over a size, and how steep it is.

In: what was measured at each size. Out: the exponents k of cost ~ size^k, as slopes of the logarithms. A cost with a constant share is flatter
at small sizes, so the slope between the last two points tells more about large ones than that over all.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

from benchmarks._plot import Curve, log_log_svg

LINEAR = 1.1
"""Up to this exponent a cost is said to grow no faster than its size: clocks are noisy."""

Point = dict[str, float | None]


@dataclass(frozen=True)
class CostCurve:
    """Costs against one size."""

    name: str
    x_name: str
    points: list[Point]
    """Each with x, costs, and what else was seen; None: the system does not tell."""
    costs: dict[str, str] = field(default_factory=lambda: {"seconds": "seconds"})
    """Keys of points that are costs, with their names for people; the curve's exponent is the first one's."""

    def exponents(self, cost: str) -> tuple[float | None, float | None]:
        """Over all points, and between the last two."""
        pairs = [(point["x"], point.get(cost)) for point in self.points]
        return log_log_slope(pairs), log_log_slope(pairs[-2:])

    def document(self) -> dict:
        slopes = {cost: self.exponents(cost) for cost in self.costs}
        exponent, last_exponent = next(iter(slopes.values()))
        return {
            "x": self.x_name,
            "points": self.points,
            "exponent": exponent,
            "last_exponent": last_exponent,
            "exponents": {cost: {"all": over_all, "last": last} for cost, (over_all, last) in slopes.items()},
        }


def log_log_slope(points: Sequence[tuple[float | None, float | None]]) -> float | None:
    """Least squares of log cost over log x; None where that says nothing: fewer than two sizes, or a value that is not above 0."""
    if any(x is None or cost is None or not (x > 0 and cost > 0) for x, cost in points):
        return None
    logs = [(math.log(x), math.log(cost)) for x, cost in points if x and cost]
    if len({x for x, _ in logs}) < 2:
        return None
    middle_x, middle_y = (sum(values) / len(logs) for values in zip(*logs, strict=True))
    slope = sum((x - middle_x) * (y - middle_y) for x, y in logs) / sum((x - middle_x) ** 2 for x, _ in logs)
    return round(slope, 3)


def table_lines(curve: CostCurve) -> list[str]:
    """A Markdown table of one curve, with the slope of each cost to its neighbour before, and its exponents."""
    columns = [key for key in dict.fromkeys(key for point in curve.points for key in point) if key != "x"]
    lines = [f"{curve.name}, against {curve.x_name}", f"| {' | '.join(['x', *columns])} |", f"|{'---|' * (1 + len(columns))}"]
    for point in curve.points:
        lines.append(f"| {' | '.join(_text(point.get(key)) for key in ('x', *columns))} |")
    for cost, said in curve.costs.items():
        over_all, last = curve.exponents(cost)
        steps = [log_log_slope([(a["x"], a.get(cost)), (b["x"], b.get(cost))]) for a, b in pairwise(curve.points)]
        lines.append(
            f"exponent of {said}: {_text(over_all)}, last {_text(last)}; steps {', '.join(map(_text, steps))}{_verdict(over_all, last)}"
        )
    return lines


def write_plot(curve: CostCurve, folder: Path) -> None:
    """folder/scale_<name>.svg; costs that a logarithm cannot show are left out, and without any no file is written."""
    shown = []
    for cost, said in curve.costs.items():
        points = [(x, y) for x, y in ((point["x"], point.get(cost)) for point in curve.points) if x and y and x > 0 and y > 0]
        if points:
            shown.append(Curve(said, points))
    if shown:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / f"scale_{curve.name}.svg").write_text(log_log_svg(shown, f"How costs grow: {curve.name}", curve.x_name, "cost"))


def _verdict(over_all: float | None, last: float | None) -> str:
    if over_all is None or last is None:
        return ""
    return " (no faster than linearly)" if max(over_all, last) <= LINEAR else " (faster than linearly)"


def _text(value: float | None) -> str:
    return "–" if value is None else f"{value:.4g}" if isinstance(value, float) else str(value)
