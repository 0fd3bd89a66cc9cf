"""What drgs/reconstruct/fit/losses.py compares pixel by pixel, as operations on whole images in any precision."""

import torch
from torch import Tensor

from drgs.maths.color import srgb_from_linear


def display_image(radiance_linear: Tensor, coverage: Tensor, photo_srgb: Tensor, ceiling: float = 1.0) -> Tensor:
    """Radiance (..., 3) as the camera would have stored it, times coverage: sRGB, and no reward for passing `ceiling` where the photo is saturated."""
    srgb = srgb_from_linear(radiance_linear)
    saturated = photo_srgb >= 254 / 255 * ceiling
    return torch.where(saturated, srgb.clamp(max=ceiling), srgb) * coverage[..., None]


def mask_loss(coverage: Tensor, mask: Tensor) -> Tensor:
    """Scalar binary cross-entropy of coverage (height, width) against the mask 0..1."""
    return torch.nn.functional.binary_cross_entropy(coverage.clamp(1e-4, 1 - 1e-4), mask)


def edge_aware_smoothness(maps: Tensor, photo: Tensor, coverage: Tensor) -> Tensor:
    """Scalar first-order smoothness of maps (height, width, c), less where the photo has an edge, only between solid pixels."""
    solid = (coverage.detach() > 0.9).to(maps)
    total = maps.new_zeros(())
    for axis in (0, 1):
        ahead, here = [slice(None)] * 2, [slice(None)] * 2
        ahead[axis], here[axis] = slice(1, None), slice(None, -1)
        edge = (photo[tuple(ahead)] - photo[tuple(here)]).abs().mean(-1)
        weight = torch.exp(-8 * edge) * solid[tuple(ahead)] * solid[tuple(here)]
        total = total + ((maps[tuple(ahead)] - maps[tuple(here)]).abs().mean(-1) * weight).sum() / solid.sum().clamp(min=1)
    return total
