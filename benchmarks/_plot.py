"""Curves on logarithmic axes as an SVG, in a few lines: pictures in the documents need no plotting library."""

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


def log_log_svg(curves: list[Curve], title: str, x_name: str, y_name: str) -> str:
    """An SVG document.

    Raises:
        ValueError: there is nothing to draw, or a value is not above 0.
    """
    values = [point for curve in curves for point in curve.points]
    if not values or any(not (v > 0 and math.isfinite(v)) for point in values for v in point):
        raise ValueError(f"a log-log plot needs points above 0; found {values[:3]}")
    low, high = ([pick(point[k] for point in values) for k in (0, 1)] for pick in (min, max))
    spans = [(math.log10(a), max(math.log10(b), math.log10(a) + 0.3)) for a, b in zip(low, high, strict=True)]
    spans = [(a - 0.04 * (b - a), b + 0.04 * (b - a)) for a, b in spans]

    def place(x: float, y: float) -> tuple[float, float]:
        across, up = ((math.log10(v) - a) / (b - a) for v, (a, b) in zip((x, y), spans, strict=True))
        return LEFT + across * (WIDTH - LEFT - RIGHT), HEIGHT - BOTTOM - up * (HEIGHT - TOP - BOTTOM)

    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" font-family="sans-serif" font-size="11" fill="#222">',
        f'<rect width="{WIDTH}" height="{HEIGHT}" fill="#fff"/>',
        f'<text x="{(LEFT + WIDTH - RIGHT) / 2}" y="17" text-anchor="middle" font-size="13">{escape(title)}</text>',
        f'<text x="{(LEFT + WIDTH - RIGHT) / 2}" y="{HEIGHT - 8}" text-anchor="middle">{escape(x_name)}</text>',
        f'<text transform="translate(14 {HEIGHT / 2}) rotate(-90)" text-anchor="middle">{escape(y_name)}</text>',
    ]
    for value in _ticks(*spans[0]):
        x, _ = place(value, 10 ** spans[1][0])
        parts.append(f'<path d="M{x:.1f} {TOP}V{HEIGHT - BOTTOM}" stroke="#ddd"/>')
        parts.append(f'<text x="{x:.1f}" y="{HEIGHT - BOTTOM + 14}" text-anchor="middle">{value:g}</text>')
    for value in _ticks(*spans[1]):
        _, y = place(10 ** spans[0][0], value)
        parts.append(f'<path d="M{LEFT} {y:.1f}H{WIDTH - RIGHT}" stroke="#ddd"/>')
        parts.append(f'<text x="{LEFT - 5}" y="{y + 4:.1f}" text-anchor="end">{value:g}</text>')
    for k, curve in enumerate(curves):
        color, dash = COLORS[k % len(COLORS)], DASHES[k % len(DASHES)]
        at = [place(x, y) for x, y in sorted(curve.points)]
        line = " ".join(f"{x:.1f},{y:.1f}" for x, y in at)
        parts.append(f'<polyline points="{line}" fill="none" stroke="{color}" stroke-width="1.8" stroke-dasharray="{dash}"/>')
        parts += [f'<circle cx="{x:.1f}" cy="{y:.1f}" r="2.6" fill="{color}"/>' for x, y in at]
        x, y = WIDTH - RIGHT + 10, TOP + 12 + 16 * k
        parts.append(f'<path d="M{x} {y - 4}h22" stroke="{color}" stroke-width="1.8" stroke-dasharray="{dash}"/>')
        parts.append(f'<text x="{x + 28}" y="{y}">{escape(curve.name)}</text>')
    return "\n".join([*parts, "</svg>"]) + "\n"


def _ticks(low: float, high: float) -> list[float]:
    """1, 2, 5 of each decade between two exponents; only the ones where there are many decades."""
    steps = (1, 2, 5) if high - low < 2.5 else (1,)
    decades = range(math.floor(low), math.ceil(high) + 1)
    return [step * 10.0**d for d in decades for step in steps if low <= math.log10(step) + d <= high]
