"""The learned light: tables of several sizes whose upsampled sum is the log of the radiance; and the learned picture behind the object.

In: parameters of a fit, by name. Out: radiance by direction (linear), or the sRGB of the surroundings; both differentiable.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from drgs.scene.camera import Camera, pixel_rays_world
from drgs.scene.environment import uv_from_direction

BACKGROUND_ROWS = 64
"""Of the picture of the surroundings that captures without masks are given, by direction alone."""
ENVIRONMENT_PYRAMID = (8, 32, 128)
"""Rows of the tables whose upsampled sum is the log of the environment: coarse light settles first."""


def environment_table(parameters: dict[str, Tensor]) -> Float[Tensor, "128 256 3"]:
    """(128, 256, 3) linear radiance; exp keeps it positive and lets a lamp be a thousand times the sky."""
    log_radiance = parameters[f"environment_{ENVIRONMENT_PYRAMID[-1]}"]
    for rows in ENVIRONMENT_PYRAMID[:-1]:
        log_radiance = log_radiance + upsampled(parameters[f"environment_{rows}"], ENVIRONMENT_PYRAMID[-1])
    return log_radiance[0].permute(1, 2, 0).clamp(-8, 8).exp()


def upsampled(coarse: Float[Tensor, "1 3 rows columns"], rows: int) -> Float[Tensor, "1 3 {rows} 2*{rows}"]:
    """A table of so many rows, a multiple of its own, linear between texels."""
    scale = rows // coarse.shape[2]
    wrapped = torch.cat([coarse[..., -1:], coarse, coarse[..., :1]], -1)
    fine = torch.nn.functional.interpolate(wrapped, scale_factor=scale, mode="bilinear", align_corners=False)
    return fine[..., scale:-scale]


def background_image(background: Float[Tensor, "1 3 rows columns"], camera: Camera) -> Float[Tensor, "height width 3"]:
    """(height, width, 3) sRGB of the surroundings, from their logits (1, 3, rows, 2 rows) in the environment's layout; differentiable."""
    uv = uv_from_direction(pixel_rays_world(camera)[1])
    wrapped = torch.cat([background[..., -1:], background, background[..., :1]], -1)
    columns = wrapped.shape[-1]
    x = (uv[..., 0] * (columns - 2) + 1) / columns
    grid = torch.stack([2 * x - 1, 2 * uv[..., 1] - 1], -1)[None]
    sampled = torch.nn.functional.grid_sample(wrapped, grid, mode="bilinear", padding_mode="border", align_corners=False)
    return torch.sigmoid(sampled[0]).permute(1, 2, 0)
