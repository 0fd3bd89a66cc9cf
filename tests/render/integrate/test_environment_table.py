"""The table's density against integrals, histograms and the lookup it serves."""

import math

import pytest
import torch
from scipy import stats

from drgs.render.integrate.environment_table import build_environment_table, environment_pdf, sample_environment
from drgs.scene.environment import Environment, direction_from_uv, environment_radiance, uv_from_direction
from tests.render.closed_form_scenes import constant_sky, sunny_sky


def in_float64(environment: Environment) -> Environment:
    return Environment(environment.radiance.double())


def sphere_grid(rows: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Directions (rows, 2 rows, 3) and solid angles (rows, 1) of a lat-long grid."""
    v = (torch.arange(rows, dtype=torch.float64) + 0.5) / rows
    u = (torch.arange(2 * rows, dtype=torch.float64) + 0.5) / (2 * rows)
    v, u = torch.meshgrid(v, u, indexing="ij")
    return direction_from_uv(torch.stack([u, v], -1)), torch.sin(v[:, :1] * math.pi) * (math.pi / rows) ** 2


@pytest.mark.slow
@pytest.mark.parametrize("environment", [constant_sky(), sunny_sky(), sunny_sky(sun=1e6), sunny_sky(height=5)])
def test_density_integrates_to_one(environment: Environment) -> None:
    direction, solid_angle = sphere_grid(640)
    density = environment_pdf(build_environment_table(in_float64(environment)), direction)
    assert abs(float((density * solid_angle).sum()) - 1) < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("environment", [constant_sky(height=8), sunny_sky(height=8), sunny_sky(height=8, sun=1e4)])
def test_samples_follow_the_density(environment: Environment) -> None:
    table = build_environment_table(in_float64(environment))
    count, sub = 400_000, 10
    direction, solid_angle = sphere_grid(16 * sub)
    mass = (environment_pdf(table, direction) * solid_angle).reshape(16, sub, 32, sub).sum((1, 3)).reshape(-1)
    uv = uv_from_direction(sample_environment(table, torch.rand(count, 2, dtype=torch.float64)))
    cell = (uv[:, 1] * 16).long().clamp(max=15) * 32 + (uv[:, 0] % 1 * 32).long().clamp(max=31)
    found = torch.bincount(cell, minlength=512).double()
    expected = mass / mass.sum() * count
    large = expected > 8
    statistic = float(((found - expected)[large] ** 2 / expected[large]).sum())
    assert stats.chi2.sf(statistic, int(large.sum()) - 1) > 1e-4
    assert float((found - expected)[~large].sum().abs()) < 6 * math.sqrt(float(expected[~large].sum()) + 1) + 1


def test_light_that_leaks_into_neighbouring_texels_is_sampled_in_proportion() -> None:
    """radiance / density varies little wherever there is light, also in the bilinear skirt of a sun over a black sky."""
    radiance = torch.zeros(32, 64, 3, dtype=torch.float64)
    radiance[9, 20] = 1000.0
    environment = Environment(radiance)
    direction, _ = sphere_grid(256)
    light = environment_radiance(environment, direction)[..., 0]
    density = environment_pdf(build_environment_table(environment), direction)
    lit = light > 1e-3
    ratio = light[lit] / density[lit]
    assert int(lit.sum()) > 100
    assert float(ratio.max() / ratio.min()) < 1.3


def test_constant_sky_is_sampled_evenly() -> None:
    direction, _ = sphere_grid(100)
    density = environment_pdf(build_environment_table(Environment(torch.full((64, 128, 3), 2.0, dtype=torch.float64))), direction)
    torch.testing.assert_close(density, torch.full_like(density, 1 / (4 * math.pi)), rtol=2e-3, atol=0)


def test_black_sky_has_density_zero_and_no_nan() -> None:
    table = build_environment_table(constant_sky(0.0))
    direction = sample_environment(table, torch.rand(100, 2))
    assert bool(torch.isfinite(direction).all())
    assert float(environment_pdf(table, direction).abs().max()) == 0.0
