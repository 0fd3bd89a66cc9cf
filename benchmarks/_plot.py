"""Curves on logarithmic or plain axes as an SVG, in a few lines: pictures in the documents need no plotting library."""

import math
from dataclasses import dataclass
from xml.sax.saxutils import escape

WIDTH, HEIGHT, LEFT, RIGHT, TOP, BOTTOM = 600, 320, 62, 170, 28, 42
COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#555555")
DASHES = ("", "6 3", "2 3")
"""Taken in turn with the colours, so that curves differ without them."""


@dataclass(frozen=True)
class Curve:
    """A name and its (x, y) points, all above 0."""

    name: str
    points: list[tuple[float, float]]


@dataclass(frozen=True)
class _Axis:
    """Which part of an axis is shown, in the coordinate along which it is even: the value, or its logarithm."""

    low: float
    high: float
    logarithmic: bool

    def place(self, value: float) -> float:
        """0 at the low end, 1 at the high one."""
        return ((math.log10(value) if self.logarithmic else value) - self.low) / (self.high - self.low)

    def ticks(self) -> list[float]:
        return _decade_ticks(self.low, self.high) if self.logarithmic else _even_ticks(self.low, self.high)


def log_log_svg(curves: list[Curve], title: str, x_name: str, y_name: str) -> str:
    """An SVG document.

    Raises:
        ValueError: there is nothing to draw, or a value is not above 0.
    """
    values = [point for curve in curves for point in curve.points]
    if not values or any(not (v > 0 and math.isfinite(v)) for point in values for v in point):
        raise ValueError(f"a log-log plot needs points above 0; found {values[:3]}")
    axes = [_axis([math.log10(point[k]) for point in values], 0.3, True) for k in (0, 1)]
    return _svg(curves, axes[0], axes[1], (title, x_name, y_name), dots=True)


def linear_svg(curves: list[Curve], title: str, x_name: str, y_name: str) -> str:
    """An SVG document with plain axes; curves of many points, so without dots.

    Raises:
        ValueError: there is nothing to draw, or a value is not finite.
    """
    values = [point for curve in curves for point in curve.points]
    if not values or any(not math.isfinite(v) for point in values for v in point):
        raise ValueError(f"a plot needs finite points; found {values[:3]}")
    axes = [_axis([point[k] for point in values], 1e-9, False) for k in (0, 1)]
    return _svg(curves, axes[0], axes[1], (title, x_name, y_name), dots=False)


def _axis(coordinates: list[float], least: float, logarithmic: bool) -> _Axis:
    """All coordinates, and a little more on both sides."""
    low, high = min(coordinates), max(max(coordinates), min(coordinates) + least)
    return _Axis(low - 0.04 * (high - low), high + 0.04 * (high - low), logarithmic)


def _svg(curves: list[Curve], x_axis: _Axis, y_axis: _Axis, names: tuple[str, str, str], dots: bool) -> str:
    title, x_name, y_name = names

    def across(x: float) -> float:
        return LEFT + x_axis.place(x) * (WIDTH - LEFT - RIGHT)

    def down(y: float) -> float:
        return HEIGHT - BOTTOM - y_axis.place(y) * (HEIGHT - TOP - BOTTOM)

    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" font-family="sans-serif" font-size="11" fill="#222">',
        f'<rect width="{WIDTH}" height="{HEIGHT}" fill="#fff"/>',
        f'<text x="{(LEFT + WIDTH - RIGHT) / 2}" y="17" text-anchor="middle" font-size="13">{escape(title)}</text>',
        f'<text x="{(LEFT + WIDTH - RIGHT) / 2}" y="{HEIGHT - 8}" text-anchor="middle">{escape(x_name)}</text>',
        f'<text transform="translate(14 {HEIGHT / 2}) rotate(-90)" text-anchor="middle">{escape(y_name)}</text>',
    ]
    for value in x_axis.ticks():
        x = across(value)
        parts.append(f'<path d="M{x:.1f} {TOP}V{HEIGHT - BOTTOM}" stroke="#ddd"/>')
        parts.append(f'<text x="{x:.1f}" y="{HEIGHT - BOTTOM + 14}" text-anchor="middle">{value:g}</text>')
    for value in y_axis.ticks():
        y = down(value)
        parts.append(f'<path d="M{LEFT} {y:.1f}H{WIDTH - RIGHT}" stroke="#ddd"/>')
        parts.append(f'<text x="{LEFT - 5}" y="{y + 4:.1f}" text-anchor="end">{value:g}</text>')
    for k, curve in enumerate(curves):
        color, dash = COLORS[k % len(COLORS)], DASHES[k % len(DASHES)]
        at = [(across(x), down(y)) for x, y in sorted(curve.points)]
        line = " ".join(f"{x:.1f},{y:.1f}" for x, y in at)
        parts.append(f'<polyline points="{line}" fill="none" stroke="{color}" stroke-width="1.8" stroke-dasharray="{dash}"/>')
        if dots:
            parts += [f'<circle cx="{x:.1f}" cy="{y:.1f}" r="2.6" fill="{color}"/>' for x, y in at]
        x, y = WIDTH - RIGHT + 10, TOP + 12 + 16 * k
        parts.append(f'<path d="M{x} {y - 4}h22" stroke="{color}" stroke-width="1.8" stroke-dasharray="{dash}"/>')
        parts.append(f'<text x="{x + 28}" y="{y}">{escape(curve.name)}</text>')
    return "\n".join([*parts, "</svg>"]) + "\n"


def _decade_ticks(low: float, high: float) -> list[float]:
    """1, 2, 5 of each decade between two exponents; only the ones where there are many decades."""
    steps = (1, 2, 5) if high - low < 2.5 else (1,)
    decades = range(math.floor(low), math.ceil(high) + 1)
    return [step * 10.0**d for d in decades for step in steps if low <= math.log10(step) + d <= high]


def _even_ticks(low: float, high: float) -> list[float]:
    """Multiples of 1, 2 or 5 times a power of ten, some four to ten of them."""
    wanted = (high - low) / 5
    power = 10.0 ** math.floor(math.log10(wanted))
    step = max(step * power for step in (1, 2, 5) if step * power <= wanted)
    return [k * step for k in range(math.ceil(low / step), math.floor(high / step) + 1)]
