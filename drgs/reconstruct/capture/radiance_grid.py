"""A coarse radiance field inside the hull: density and colour on a grid, fitted to the photographs by volume rendering, coarse to fine.

It knows no surface, so nothing has to move for a hollow to empty: all of the hull begins as thin fog, and what photographs agree about becomes
dense wherever it lies. Colours are spherical harmonics of degree 1 of the viewing direction. What mirrors is seen behind its surface, and
plain gloss a little below it: whom to believe is find_hollows' matter.
Sources: Sun et al. 2022 (grids of density and colour), Fridovich-Keil et al. 2022 (harmonics in place of a network), Barron et al. 2022
(densities gathered along rays); docs/sources.md: sun2022, fridovich2022, barron2022.

In: rays with colours, a box, what of it is inside. Out: RadianceGrid, which tells how far rays see.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from drgs.reconstruct.capture.ray_costs import ray_costs, ray_depths
from drgs.reconstruct.fit.adam import Adam
from drgs.reconstruct.fit.cost_in_slices import slice_edges
from drgs.warp_torch import by_pool

HARMONICS = 4
"""Of degree 0 and 1: 1, x, y, z."""
EVEN_SAMPLES = 160
"""Along a ray whose depth is asked for."""


@dataclass(frozen=True)
class RadianceGridSettings:
    """Size and rates. Figures are of still_life, teapot and bunny (docs/decisions/0003-fitting.md)."""

    levels: tuple[tuple[int, int], ...] = ((32, 150), (64, 250))
    """Nodes along the longest side, and steps."""
    rays_a_step: int = 1024
    density_rate: float = 0.3
    color_rate: float = 0.15
    decay: float = 0.1
    """Rates fall to this share in the second half of a level: until then they are too large to settle."""
    start_density: float = -4.0
    """Before softplus, a node's side: thin fog."""
    weight_opaque: float = 0.02
    """Of the mean -log of opacity: what masks cover is not to be seen through."""
    weight_even: float = 0.001
    weight_gathered: float = 0.005
    """Of the mean distance of a ray's density from its own mean, in sides of the box; from `gathered_from` on."""
    gathered_from: float = 0.15
    least_weight: float = 4e-3
    """Places of less weight keep their share of the ray, but their colour is not looked up."""


@dataclass(frozen=True, eq=False)
class Rays:
    """Through pixels that masks fill; unit directions, distances in world units."""

    origin: Float[Tensor, "ray 3"]
    direction: Float[Tensor, "ray 3"]
    near: Float[Tensor, "ray"]
    """Where the hull is entered first, and left last."""
    far: Float[Tensor, "ray"]

    def __getitem__(self, index: Tensor | slice) -> "Rays":
        return Rays(self.origin[index], self.direction[index], self.near[index], self.far[index])


@dataclass(frozen=True, eq=False)
class RadianceGrid:
    """Nodes at low + cell * (i, j, k)."""

    low: Float[Tensor, "3"]
    cell: float
    """[world units]"""
    density: Float[Tensor, "n n n"]
    """Before softplus, a cell."""
    inside: Float[Tensor, "n n n"]
    """1 in the hull, 0 outside."""
    colors: Float[Tensor, "row 12"]
    """Before the sigmoid: of each channel HARMONICS coefficients; row 0 is of nodes far outside."""
    row: Int[Tensor, "node"]
    """Of `colors`."""

    def coefficients_at(self, places: Float[Tensor, "n 3"]) -> Float[Tensor, "n 12"]:
        """Trilinearly, as `colors` has them."""
        count = len(self.density)
        at = ((places - self.low) / self.cell).clamp(0, count - 1.001)
        base = at.floor().long()
        part = at - base
        corner = torch.tensor([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)], device=places.device)
        node = base[:, None] + corner
        rows = self.row[(node[..., 0] * count + node[..., 1]) * count + node[..., 2]]
        weights = torch.where(corner.bool(), part[:, None], 1 - part[:, None]).prod(-1)
        return torch.nn.functional.embedding_bag(rows, self.colors, mode="sum", per_sample_weights=weights)

    def depths(self, rays: Rays) -> tuple[Float[Tensor, "ray"], Float[Tensor, "ray"]]:
        """Distance at which half of the light is stopped, inf where it never is; and the mean distance of what stops it from its own mean."""
        through = (rays.origin, rays.direction, rays.near, rays.far)
        return ray_depths(through, self.low, self.cell, self.inside, self.density, EVEN_SAMPLES)

    def looked_up(self, field: Float[Tensor, "n n n"], places: Float[Tensor, "*shape 3"]) -> Float[Tensor, "*shape"]:
        """Trilinearly."""
        at = 2 * (places - self.low) / (self.cell * (len(field) - 1)) - 1
        flat = at.reshape(1, 1, 1, -1, 3).flip(-1)  # grid_sample names the last axis first
        return torch.nn.functional.grid_sample(field[None, None], flat, align_corners=True).reshape(places.shape[:-1])


def fit_radiance_grid(
    rays: Rays,
    colors: Float[Tensor, "ray 3"],
    box: tuple[Float[Tensor, "3"], Float[Tensor, "3"]],
    is_inside: Callable[[Float[Tensor, "place 3"]], Bool[Tensor, "place"]],
    settings: RadianceGridSettings,
    seed: int,
    report: Callable[[float], None] | None = None,
    should_stop: Callable[[], bool] | None = None,
) -> RadianceGrid | None:
    """Fit the grid; None when should_stop(), asked before each step, said so.

    Args:
        colors: SRGB of the rays' pixels. box: of the hull, low and high. is_inside: of the hull. report: is told the share that is done.
    """
    generator, grid, done = torch.Generator().manual_seed(seed), None, 0
    total = sum(steps for _, steps in settings.levels)
    for count, steps in settings.levels:
        grid = _finer(grid, box, is_inside, count, settings)
        optimizer = Adam(
            [{"params": [grid.density], "lr": settings.density_rate}, {"params": [grid.colors], "lr": settings.color_rate}],
            betas=(0.9, 0.99),
            eps=1e-15,
        )
        rates = [group["lr"] for group in optimizer.param_groups]
        for step in range(steps):
            if should_stop is not None and should_stop():
                return None
            late = max(0.0, 2 * step / steps - 1)
            for group, rate in zip(optimizer.param_groups, rates, strict=True):
                group["lr"] = rate * settings.decay**late
            drawn = torch.randint(len(colors), (settings.rays_a_step,), generator=generator).to(colors.device)
            shake = torch.rand(settings.rays_a_step, 1, generator=generator).to(colors.device)
            batch = (rays[drawn], colors[drawn], shake)
            grid.density.grad, grid.colors.grad = _gradients(grid, batch, settings, done > settings.gathered_from * total)
            optimizer.step()
            done += 1
            if report is not None and done % 20 == 0:
                report(done / total)
    return grid


def _finer(
    coarse: RadianceGrid | None,
    box: tuple[Float[Tensor, "3"], Float[Tensor, "3"]],
    is_inside: Callable[[Float[Tensor, "place 3"]], Bool[Tensor, "place"]],
    count: int,
    settings: RadianceGridSettings,
) -> RadianceGrid:
    """A grid of `count` nodes a side, of what a coarser one holds; of fog where there is none."""
    low, high = box
    cell = float((high - low).max()) / (count - 5)  # two nodes to spare on each side
    low = (low + high - cell * (count - 1)) / 2
    node = torch.stack(torch.meshgrid(*(3 * [torch.arange(count, device=low.device)]), indexing="ij"), -1).reshape(-1, 3)
    places = low + cell * node
    inside = is_inside(places).to(low).reshape(count, count, count)
    # Two nodes around what is inside may be asked for by interpolation.
    active = torch.nn.functional.max_pool3d(inside[None, None], 5, 1, 2).flatten().nonzero().squeeze(1)
    row = torch.zeros(count**3, dtype=torch.long, device=low.device)
    row[active] = torch.arange(1, len(active) + 1, device=low.device)
    colors = torch.zeros(len(active) + 1, 3 * HARMONICS, device=low.device)
    density = torch.full_like(inside, settings.start_density)
    if coarse is not None:
        density = coarse.looked_up(coarse.density, places).reshape(inside.shape).contiguous()
        colors[1:] = coarse.coefficients_at(places[active])
    return RadianceGrid(low, cell, density, inside, colors, row)


def _gradients(
    grid: RadianceGrid, batch: tuple[Rays, Tensor, Tensor], settings: RadianceGridSettings, gather: bool
) -> tuple[Tensor, Tensor]:
    """Of the cost of a batch (rays, colours, shakes), by density and colours."""
    rays, colors, shake = batch
    weights = (settings.weight_opaque, settings.weight_gathered if gather else 0.0)

    def of_some(first: int, last: int) -> tuple[Tensor, Tensor]:
        some = slice(first, last)
        here = rays[some]
        through = (here.origin, here.direction, here.near, here.far)
        return ray_costs(
            through, colors[some], shake[some], grid.low, grid.cell, grid.inside, grid.row, grid.density, grid.colors, weights,
            settings.least_weight,
        )[1:]  # fmt: skip

    found = by_pool(of_some, slice_edges(len(shake), colors.device), colors.device)
    density, hue = (sum(others, start=first).div_(len(shake)) for first, *others in zip(*found, strict=True))
    field = grid.density
    for axis in range(3):
        slope = field.diff(dim=axis)
        slope *= 2 * settings.weight_even / slope.numel()
        last = field.shape[axis] - 1
        density.narrow(axis, 1, last).add_(slope)
        density.narrow(axis, 0, last).sub_(slope)
    return density, hue
