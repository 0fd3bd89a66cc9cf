"""drgs/maths/color.py for NumPy arrays and plain numbers, for code that does without torch; the precision is that of the input."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from drgs.maths.constants import (
    LUMINANCE_BLUE,
    LUMINANCE_GREEN,
    LUMINANCE_RED,
    SRGB_ENCODED_END,
    SRGB_GAMMA,
    SRGB_LINEAR_END,
    SRGB_OFFSET,
    SRGB_SCALE,
    SRGB_SLOPE,
)

Floats = NDArray[np.floating[Any]]


def srgb_from_linear(linear: Floats) -> Floats:
    """sRGB curve, extended above 1; clip before or after where pixels are wanted."""
    safe = np.maximum(linear, SRGB_LINEAR_END)
    return np.where(linear <= SRGB_LINEAR_END, SRGB_SLOPE * linear, SRGB_SCALE * safe ** (1 / SRGB_GAMMA) - SRGB_OFFSET)


def linear_from_srgb(srgb: Floats) -> Floats:
    """Inverse of `srgb_from_linear`."""
    return np.where(srgb <= SRGB_ENCODED_END, srgb / SRGB_SLOPE, ((srgb + SRGB_OFFSET) / SRGB_SCALE) ** SRGB_GAMMA)


def luminance(linear: Floats) -> Floats:
    """Rec.709 luminance of linear RGB (..., 3)."""
    return linear @ np.array([LUMINANCE_RED, LUMINANCE_GREEN, LUMINANCE_BLUE], linear.dtype)
