"""Linear Rec.709 and sRGB for kernels: the Warp restatement of drgs/maths/color.py."""

import warp as wp

from drgs.maths.constants import (
    LUMINANCE_BLUE,
    LUMINANCE_GREEN,
    LUMINANCE_RED,
    SRGB_GAMMA,
    SRGB_LINEAR_END,
    SRGB_OFFSET,
    SRGB_SCALE,
    SRGB_SLOPE,
)


@wp.func
def luminance_of(linear: wp.vec3) -> float:
    return LUMINANCE_RED * linear[0] + LUMINANCE_GREEN * linear[1] + LUMINANCE_BLUE * linear[2]


@wp.func
def srgb_of(linear: float) -> float:
    """maths.color.srgb_from_linear, clipped to 0..1."""
    c = wp.clamp(linear, 0.0, 1.0)
    if c <= SRGB_LINEAR_END:
        return SRGB_SLOPE * c
    return SRGB_SCALE * wp.pow(c, 1.0 / SRGB_GAMMA) - SRGB_OFFSET
