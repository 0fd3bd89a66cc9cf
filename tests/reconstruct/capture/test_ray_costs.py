"""Costs of rays through a radiance grid, and their gradients, against the float64 twin."""

from dataclasses import replace

import pytest
import torch

from drgs.reconstruct.capture.radiance_grid import RadianceGrid, RadianceGridSettings, Rays
from drgs.reconstruct.capture.ray_costs import ray_costs, ray_depths
from drgs.reference import ray_costs as reference

NODES, RAYS = 14, 300


def hull_of_fog() -> tuple[RadianceGrid, Rays, torch.Tensor, torch.Tensor]:
    """A ball of uneven density and colour in a box of its own, and rays across it."""
    generator = torch.Generator().manual_seed(3)
    rand = lambda *shape: torch.rand(*shape, generator=generator, dtype=torch.float64)  # noqa: E731
    cell = 2.0 / (NODES - 5)
    low = torch.full((3,), -cell * (NODES - 1) / 2, dtype=torch.float64)
    node = torch.stack(torch.meshgrid(*3 * [torch.arange(NODES)], indexing="ij"), -1).reshape(-1, 3)
    inside = ((low + cell * node).norm(dim=1) < 1).double().reshape(NODES, NODES, NODES)
    active = torch.nn.functional.max_pool3d(inside[None, None], 5, 1, 2).flatten().nonzero().squeeze(1)
    row = torch.zeros(NODES**3, dtype=torch.long)
    row[active] = torch.arange(1, len(active) + 1)
    density, colors = 6 * rand(NODES, NODES, NODES) - 4, 2 * rand(len(active) + 1, 12) - 1
    density[6, 6, 6] = 30.0  # beyond where the softplus is a line
    grid = RadianceGrid(low, cell, density, inside, colors, row)
    direction = torch.nn.functional.normalize(rand(RAYS, 3) - 0.5, dim=1)
    aside = 0.9 * torch.nn.functional.normalize(torch.linalg.cross(direction, rand(RAYS, 3) - 0.5), dim=1) * rand(RAYS, 1)
    half = (1 - aside.square().sum(1)).sqrt()
    rays = Rays(aside - 3 * direction, direction, 3 - half, 3 + half)
    return grid, rays, rand(RAYS, 3), rand(RAYS, 1)


def tuple_of(rays: Rays, device: str) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    origin, direction, near, far = (values.float().to(device) for values in (rays.origin, rays.direction, rays.near, rays.far))
    return origin, direction, near, far


@pytest.mark.parametrize("gather", [False, True])
def test_costs_and_gradients_equal_the_twin(device: str, gather: bool):
    grid, rays, colors, shake = hull_of_fog()
    settings = RadianceGridSettings(weight_gathered=0.3)
    exact = replace(grid, density=grid.density.clone().requires_grad_(True), colors=grid.colors.clone().requires_grad_(True))
    expected = reference.ray_costs(exact, rays, colors, shake, settings, gather)
    slopes = torch.autograd.grad(expected, [exact.density, exact.colors])

    own = {name: value.float().to(device) if name != "row" else value.to(device) for name, value in vars(grid).items() if name != "cell"}
    found, *gradients = ray_costs(
        tuple_of(rays, device), colors.float().to(device), shake.float().to(device), own["low"],
        grid.cell, own["inside"], own["row"], own["density"], own["colors"], (settings.weight_opaque, settings.weight_gathered if gather else 0.0),
        settings.least_weight,
    )  # fmt: skip
    assert float(found) == pytest.approx(float(expected.detach()), rel=1e-4)
    for gradient, wanted in zip(gradients, slopes, strict=True):
        error = (gradient.cpu().double() - wanted).abs() / (wanted.abs() + 1e-2 * wanted.abs().max())
        # A sample whose weight lies next to the least that is looked up may fall on either side.
        assert float(error.max()) < 2e-2 and float(error.mean()) < 1e-4


def test_no_rays_cost_nothing():
    grid, rays, colors, shake = hull_of_fog()
    none = slice(0, 0)
    cost, by_density, by_colors = ray_costs(
        tuple_of(rays[none], "cpu"), colors[none].float(), shake[none].float(), grid.low.float(), grid.cell,
        grid.inside.float(), grid.row, grid.density.float(), grid.colors.float(), (0.02, 0.005), 4e-3,
    )  # fmt: skip
    assert float(cost) == 0 and float(by_density.abs().max()) == 0 and float(by_colors.abs().max()) == 0


def test_depths_equal_the_twin(device: str):
    grid, rays, _, _ = hull_of_fog()
    wanted_median, wanted_spread = reference.ray_depths(grid, rays, 160)
    low, inside, density = (values.float().to(device) for values in (grid.low, grid.inside, grid.density))
    median, spread = ray_depths(tuple_of(rays, device), low, grid.cell, inside, density, 160)
    assert 0.2 < float(torch.isfinite(wanted_median).double().mean()) < 1  # both kinds are asked for
    one = 2 * (1 + grid.cell) / 160  # a sample's stretch at most: half of the light may be stopped by either of two
    same = (median.cpu().double() - wanted_median).abs() < 1.01 * one
    assert float((same | (median.cpu() == wanted_median)).double().mean()) > 0.99
    torch.testing.assert_close(spread.cpu().double(), wanted_spread, atol=2e-3 * grid.cell, rtol=1e-3)


def test_no_rays_see_nowhere():
    grid, rays, _, _ = hull_of_fog()
    none = tuple_of(rays[slice(0, 0)], "cpu")
    median, spread = ray_depths(none, grid.low.float(), grid.cell, grid.inside.float(), grid.density.float(), 160)
    assert median.shape == spread.shape == (0,)
