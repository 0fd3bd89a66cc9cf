"""Distant light: a lat-long table of linear radiance."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

TURNED_ROWS = 256
"""Of a turned table: twice the learned one's, so that resampling blurs little."""


@dataclass(frozen=True, eq=False)
class Environment:
    """The texel at (u, v), u right, v down in [0, 1], holds the radiance arriving from direction d with
    u = 0.5 - atan2(d_y, d_x) / 2 pi, v = acos(d_z) / pi (z up). Lookup is bilinear between texel centres,
    wrapping in u and clamped in v."""

    radiance: Float[Tensor, "height width 3"]
    """Linear Rec.709, width = 2 * height."""


def uv_from_direction(direction_world: Tensor) -> Tensor:
    """(..., 2) table coordinates in [0, 1] of unit directions (..., 3)."""
    u = 0.5 - torch.atan2(direction_world[..., 1], direction_world[..., 0]) / (2 * math.pi)
    v = torch.acos(direction_world[..., 2].clamp(-1, 1)) / math.pi
    return torch.stack([u, v], -1)


def direction_from_uv(uv: Tensor) -> Tensor:
    """(..., 3) unit directions of table coordinates (..., 2)."""
    azimuth = (0.5 - uv[..., 0]) * (2 * math.pi)
    polar = uv[..., 1] * math.pi
    return torch.stack([torch.cos(azimuth) * torch.sin(polar), torch.sin(azimuth) * torch.sin(polar), torch.cos(polar)], -1)


def environment_radiance(environment: Environment, direction_world: Tensor) -> Tensor:
    """(..., 3) bilinear lookup; differentiable in the table."""
    height, width, _ = environment.radiance.shape
    uv = uv_from_direction(direction_world)
    x = uv[..., 0] * width - 0.5
    y = (uv[..., 1] * height - 0.5).clamp(0, height - 1)
    x0, y0 = torch.floor(x), torch.floor(y).clamp(max=height - 2)
    fx, fy = (x - x0)[..., None], (y - y0)[..., None]
    column0 = x0.long() % width
    column1 = (column0 + 1) % width
    row0 = y0.long()
    table = environment.radiance.reshape(-1, 3)

    def texel(row: Tensor, column: Tensor) -> Tensor:
        return table[row * width + column]

    top = texel(row0, column0) * (1 - fx) + texel(row0, column1) * fx
    bottom = texel(row0 + 1, column0) * (1 - fx) + texel(row0 + 1, column1) * fx
    return top * (1 - fy) + bottom * fy


def rotate_environment(environment: Environment, degrees: float) -> Environment:
    """Turn the light by `degrees` counter-clockwise seen from above (+z).

    A turn that is no whole number of texels is resampled bilinearly along u (periodic), which keeps the table's
    mean; live rendering turns directions instead, which is exact.
    """
    _, width, _ = environment.radiance.shape
    shift = -degrees / 360 * width  # u falls with azimuth
    whole, part = math.floor(shift), shift - math.floor(shift)
    a = torch.roll(environment.radiance, whole, dims=1)
    b = torch.roll(environment.radiance, whole + 1, dims=1)
    return Environment(a * (1 - part) + b * part)


def turned_environment(environment: Environment, light_from_world: Float[Tensor, "3 3"]) -> Environment:
    """The light as the world sees it, of a table whose directions are turned against the world's; resampled to at least TURNED_ROWS rows.

    Args:
        light_from_world: rotation of directions in the world to those of the table.
    """
    rows = max(TURNED_ROWS, environment.radiance.shape[0])
    v, u = torch.meshgrid((torch.arange(rows) + 0.5) / rows, (torch.arange(2 * rows) + 0.5) / (2 * rows), indexing="ij")
    directions = direction_from_uv(torch.stack([u, v], -1)).to(environment.radiance)
    return Environment(environment_radiance(environment, directions @ light_from_world.to(directions).T))
