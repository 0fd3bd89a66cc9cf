"""The order of points along a curve through space: what is near in it is near in memory."""

import torch
from jaxtyping import Float, Int
from torch import Tensor


def z_order(points: Float[Tensor, "point 3"]) -> Int[Tensor, "point"]:
    """Which point stands at each place along a Z-order curve of 1024 steps a side."""
    low, high = points.amin(0), points.amax(0)
    cell = ((points - low) / (high - low).clamp(min=1e-30) * 1023).long()
    for shift, mask in ((16, 0x030000FF), (8, 0x0300F00F), (4, 0x030C30C3), (2, 0x09249249)):  # two empty bits behind each
        cell = (cell | (cell << shift)) & mask
    code = cell[:, 0] | (cell[:, 1] << 1) | (cell[:, 2] << 2)
    return torch.argsort(code, stable=True)
