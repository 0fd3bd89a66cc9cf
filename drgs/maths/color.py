"""Linear Rec.709 and sRGB (IEC 61966-2-1)."""

import torch
from torch import Tensor

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


def srgb_from_linear(linear: Tensor) -> Tensor:
    """sRGB curve, extended above 1 so that over-exposed values keep their gradient; clip only for files and metrics."""
    safe = linear.clamp(min=SRGB_LINEAR_END)
    return torch.where(linear <= SRGB_LINEAR_END, SRGB_SLOPE * linear, SRGB_SCALE * safe ** (1 / SRGB_GAMMA) - SRGB_OFFSET)


def linear_from_srgb(srgb: Tensor) -> Tensor:
    """Inverse of `srgb_from_linear`."""
    safe = srgb.clamp(min=SRGB_ENCODED_END)
    return torch.where(srgb <= SRGB_ENCODED_END, srgb / SRGB_SLOPE, ((safe + SRGB_OFFSET) / SRGB_SCALE) ** SRGB_GAMMA)


def luminance(linear: Tensor) -> Tensor:
    """Rec.709 luminance of linear RGB (..., 3)."""
    return linear @ torch.tensor([LUMINANCE_RED, LUMINANCE_GREEN, LUMINANCE_BLUE], dtype=linear.dtype, device=linear.device)
