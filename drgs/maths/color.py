"""Linear Rec.709 and sRGB (IEC 61966-2-1)."""

import torch
from torch import Tensor


def srgb_from_linear(linear: Tensor) -> Tensor:
    """sRGB curve, extended above 1 so that over-exposed values keep their gradient; clip only for files and metrics."""
    safe = linear.clamp(min=0.0031308)
    return torch.where(linear <= 0.0031308, 12.92 * linear, 1.055 * safe ** (1 / 2.4) - 0.055)


def linear_from_srgb(srgb: Tensor) -> Tensor:
    """Inverse of `srgb_from_linear`."""
    safe = srgb.clamp(min=0.04045)
    return torch.where(srgb <= 0.04045, srgb / 12.92, ((safe + 0.055) / 1.055) ** 2.4)


def luminance(linear: Tensor) -> Tensor:
    """Rec.709 luminance of linear RGB (..., 3)."""
    return linear @ torch.tensor([0.2126, 0.7152, 0.0722], dtype=linear.dtype, device=linear.device)
