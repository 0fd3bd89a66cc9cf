"""Slow torch twin of drgs/reconstruct/capture/ray_costs.py, at the precision of its inputs; the specification of the kernel."""

import torch
from torch import Tensor

from drgs.reconstruct.capture.radiance_grid import HARMONICS, RadianceGrid, RadianceGridSettings, Rays


def samples_along(grid: RadianceGrid, rays: Rays, offsets: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Distances (ray, k) at shares `offsets` (ray, k) of the way, a cell longer at both ends, places there (ray, k, 3) and weights (ray, k)."""
    near = rays.near - grid.cell
    length = rays.far + grid.cell - near
    distance = near[:, None] + length[:, None] * offsets
    places = rays.origin[:, None] + distance[..., None] * rays.direction[:, None]
    step = length[:, None] / (offsets.shape[1] * grid.cell)
    density = torch.nn.functional.softplus(grid.looked_up(grid.density, places))
    opacity = (1 - torch.exp(-density * step)) * (grid.looked_up(grid.inside, places) > 0.5)
    passed = torch.cumprod(torch.cat([torch.ones_like(near)[:, None], 1 - opacity + 1e-7], 1), 1)
    return distance, places, opacity * passed[:, :-1]


@torch.no_grad()
def ray_depths(grid: RadianceGrid, rays: Rays, samples: int) -> tuple[Tensor, Tensor]:
    """As ray_depths of the kernel."""
    offsets = (torch.arange(samples, device=grid.low.device) + 0.5) / samples
    distance, _, weight = samples_along(grid, rays, offsets.expand(len(rays.near), -1))
    stopped = weight.cumsum(1) > 0.5
    median = torch.where(stopped.any(1), distance.gather(1, stopped.to(torch.uint8).argmax(1, keepdim=True))[:, 0], torch.inf)
    total = weight.sum(1, keepdim=True).clamp(min=0.01)
    mean = (weight * distance).sum(1, keepdim=True) / total
    return median, (weight * (distance - mean).abs()).sum(1) / total[:, 0]


def colors_at(grid: RadianceGrid, places: Tensor, direction: Tensor) -> Tensor:
    """(n, 3) sRGB seen at places (n, 3) in directions (n, 3); the derivative goes to the coefficients alone."""
    harmonics = torch.cat([torch.ones_like(direction[:, :1]), direction], -1)
    return torch.sigmoid((grid.coefficients_at(places).reshape(-1, 3, HARMONICS) * harmonics[:, None]).sum(-1))


def ray_costs(grid: RadianceGrid, rays: Rays, colors: Tensor, shake: Tensor, settings: RadianceGridSettings, gather: bool) -> Tensor:
    """As ray_costs of the kernel; torch differentiates it in the grid's density and colours."""
    count = len(grid.density)
    offsets = (torch.arange(count, device=shake.device) + shake) / count
    _, places, weights = samples_along(grid, rays, offsets)
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
