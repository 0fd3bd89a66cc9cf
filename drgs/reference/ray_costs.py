"""Slow torch twin of drgs/reconstruct/capture/ray_costs.py, at the precision of its inputs; the specification of the kernel."""

import torch
from torch import Tensor

from drgs.reconstruct.capture.radiance_grid import HARMONICS, RadianceGrid, RadianceGridSettings, Rays


def colors_at(grid: RadianceGrid, places: Tensor, direction: Tensor) -> Tensor:
    """(n, 3) sRGB seen at places (n, 3) in directions (n, 3); the derivative goes to the coefficients alone."""
    harmonics = torch.cat([torch.ones_like(direction[:, :1]), direction], -1)
    return torch.sigmoid((grid.coefficients_at(places).reshape(-1, 3, HARMONICS) * harmonics[:, None]).sum(-1))


def ray_costs(grid: RadianceGrid, rays: Rays, colors: Tensor, shake: Tensor, settings: RadianceGridSettings, gather: bool) -> Tensor:
    """As ray_costs of the kernel; torch differentiates it in the grid's density and colours."""
    count = len(grid.density)
    offsets = (torch.arange(count, device=shake.device) + shake) / count
    _, places, weights = grid.samples(rays, offsets)
    ray, sample = (weights.detach() > settings.least_weight).nonzero(as_tuple=True)
    kept = weights[ray, sample]
    shown = colors_at(grid, places[ray, sample].detach(), rays.direction[ray])
    opacity = weights.sum(1)
    empty = torch.zeros_like(opacity)
    # What was not looked up has the photograph's colour, and no say.
    rest = (opacity - empty.index_add(0, ray, kept)).detach()
    image = torch.zeros_like(colors).index_add(0, ray, kept[:, None] * shown) + rest[:, None] * colors
    cost = (image - colors).square().mean(1) - settings.weight_opaque * opacity.clamp(1e-4, 1).log()
    if gather:
        side = grid.cell * (count - 5)
        at = (offsets * ((rays.far - rays.near + 2 * grid.cell) / side)[:, None]).detach()
        middle = (weights * at).sum(1, keepdim=True) / opacity.detach()[:, None].clamp(min=0.01)
        cost = cost + settings.weight_gathered * (weights * (at - middle).abs()).sum(1)
    return cost.sum()
