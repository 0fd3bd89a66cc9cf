"""Split-sum shading: the filter against direct sums, the table against quadrature, the kernel and its gradient against the float64 twin."""

import math

import pytest
import torch

from drgs import warp_torch
from drgs.reconstruct.fit.light.split_sum import (
    ENVIRONMENT_SIZE,
    LEVELS,
    brdf_table,
    filter_environment,
    shade_split_sum,
    texel_directions,
    texel_solid_angles,
)
from drgs.reference import split_sum as reference
from drgs.scene.environment import Environment, direction_from_uv, environment_radiance

ROWS = ENVIRONMENT_SIZE[0]


def noisy_environment(seed: int = 0) -> torch.Tensor:
    """Coloured noise with a lamp."""
    radiance = torch.rand(*ENVIRONMENT_SIZE, 3, generator=torch.Generator().manual_seed(seed)) + 0.1
    radiance[30:33, 100:103] = 50.0
    return radiance


def level_tables(tables: torch.Tensor) -> list[tuple[float | None, torch.Tensor]]:
    """(roughness, (rows, 2 rows, 3)) of each level; last the irradiance over pi, without a roughness."""
    levels, irradiance = reference.split_tables(tables)
    return [*zip((roughness for roughness, _ in LEVELS), levels, strict=True), (None, irradiance)]


@pytest.fixture(scope="module")
def noisy_tables() -> torch.Tensor:
    return filter_environment(noisy_environment())


def random_points(count: int = 400, seed: int = 1) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    rand = lambda *shape: torch.rand(*shape, generator=generator, dtype=torch.float64)  # noqa: E731
    normal = torch.nn.functional.normalize(rand(count, 3) - 0.5, dim=-1)
    wo = torch.nn.functional.normalize(normal + 1.2 * (rand(count, 3) - 0.5), dim=-1)  # n.wo > 0
    return {
        "diffuse_albedo": rand(count, 3),
        "residual": rand(count, 3) - 0.3,
        "f0": rand(count, 3),
        "roughness": 0.02 + 0.96 * rand(count),
        "normal": normal,
        "wo": wo,
    }


def test_texels_cover_the_sphere_and_point_where_the_environment_says():
    for rows in (16, 128):
        assert float(texel_solid_angles(rows).double().sum()) * 2 * rows == pytest.approx(4 * math.pi, rel=1e-5)
    table = torch.arange(16 * 32 * 3, dtype=torch.float32).reshape(16, 32, 3)
    torch.testing.assert_close(environment_radiance(Environment(table), texel_directions(16)), table, rtol=1e-3, atol=0.05)


def test_a_constant_environment_stays_constant_at_every_roughness():
    for _, table in level_tables(filter_environment(torch.full((*ENVIRONMENT_SIZE, 3), 0.7))):
        torch.testing.assert_close(table, torch.full_like(table, 0.7), atol=2e-5, rtol=0)


def test_filtering_keeps_the_light_of_the_whole_sphere(noisy_tables: torch.Tensor):
    def mean(table: torch.Tensor) -> torch.Tensor:
        return (table * texel_solid_angles(len(table))[:, None, None]).sum((0, 1)) / (4 * math.pi)

    levels = level_tables(noisy_tables)
    for roughness, table in levels[1:]:
        torch.testing.assert_close(mean(table), mean(levels[0][1]), rtol=0.01, atol=0, msg=lambda m, r=roughness: f"roughness {r}: {m}")


@pytest.mark.parametrize("level", range(1, len(LEVELS) + 1))
def test_each_level_is_the_direct_sum_over_texels_with_the_ggx_lobe(noisy_tables: torch.Tensor, level: int):
    roughness, table = level_tables(noisy_tables)[level]
    rows = len(table)
    generator = torch.Generator().manual_seed(level)
    # The poles, the lamp and anywhere else.
    row = torch.cat([torch.tensor([0, rows - 1, 31 * rows // ROWS]), torch.randint(rows, (9,), generator=generator)])
    column = torch.cat([torch.tensor([0, 2 * rows - 1, 101 * rows // ROWS]), torch.randint(2 * rows, (9,), generator=generator)])
    uv = torch.stack([(column + 0.5) / (2 * rows), (row + 0.5) / rows], -1).double()
    fine = reference.reduce_rows(noisy_environment().double(), rows)
    expected = reference.filtered_radiance(fine, roughness, direction_from_uv(uv))
    torch.testing.assert_close(table[row, column].double(), expected, rtol=2e-3, atol=2e-3)


def test_filtering_is_linear_and_its_gradient_is_that_of_finite_differences():
    radiance = noisy_environment().requires_grad_(True)
    generator = torch.Generator().manual_seed(3)
    tables = filter_environment(radiance)
    weights = torch.randn(tables.shape, generator=generator)
    direction = torch.rand(radiance.shape, generator=generator)
    (gradient,) = torch.autograd.grad((tables * weights).sum(), radiance)
    along = (filter_environment(direction).double() * weights).sum()  # linear: the derivative is the value itself
    assert float((gradient.double() * direction).sum()) == pytest.approx(float(along), rel=1e-3)


@pytest.mark.parametrize(("n_dot_v_texel", "roughness_texel"), [(4, 4), (16, 10), (28, 16), (6, 24), (31, 31)])
def test_the_brdf_table_equals_quadrature(n_dot_v_texel: int, roughness_texel: int):
    f1, f2 = brdf_table(32)[:, roughness_texel, n_dot_v_texel].tolist()
    expected = reference.brdf_factors((n_dot_v_texel + 0.5) / 32, (roughness_texel + 0.5) / 32)
    assert (f1, f2) == pytest.approx(expected, abs=3e-3)


def test_the_brdf_never_reflects_more_than_arrives():
    f1, f2 = brdf_table(32)
    assert float(f1.min()) >= 0 and float(f2.min()) >= 0
    assert float((f1 + f2).max()) <= 1 + 1e-4
    assert float((f1 + f2)[1, 16:].min()) > 0.97  # a mirror loses next to nothing


def shade_with_gradients(function, points: dict[str, torch.Tensor], tables: torch.Tensor, device: str, dtype: torch.dtype):
    leaves = {k: v.detach().to(device, dtype).requires_grad_(k != "wo") for k, v in (points | {"tables": tables}).items()}
    radiance = function(**leaves)
    weights = torch.rand(radiance.shape, generator=torch.Generator().manual_seed(7)).to(device, dtype) - 0.4
    wanted = [k for k in leaves if k != "wo"]
    gradients = torch.autograd.grad((radiance * weights).sum(), [leaves[k] for k in wanted])
    return radiance.detach().cpu(), dict(zip(wanted, (g.cpu() for g in gradients), strict=True))


def test_shading_and_its_gradients_equal_the_twin(device: str, noisy_tables: torch.Tensor):
    points = random_points()

    def twin(**inputs):
        return reference.shade_split_sum(**inputs, factor_table=brdf_table(32))

    expected, expected_gradients = shade_with_gradients(twin, points, noisy_tables, "cpu", torch.float64)
    radiance, gradients = shade_with_gradients(shade_split_sum, points, noisy_tables, device, torch.float32)
    # Near the lamp a texel's slope is 50 a hundredth of a radian: float32 directions show.
    error = (radiance.double() - expected).abs() / (1 + expected.abs())
    assert float(error.max()) < 1e-3
    for name, wanted in expected_gradients.items():
        assert float(wanted.abs().max()) > 0, name
        error = (gradients[name].double() - wanted).abs() / (wanted.abs() + 1e-2 * wanted.abs().max())
        assert float(error.quantile(0.99) if error.numel() < 1e5 else error.max()) < 1e-2, name
        assert float(error.median()) < 1e-4, name


@pytest.mark.slow
def test_the_twins_gradient_is_that_of_finite_differences():
    # A smooth environment: tables have kinks at texel borders.
    points = {k: v.requires_grad_(k != "wo") for k, v in random_points(6, seed=5).items()}
    ramp = torch.sin(texel_directions(ROWS).double() * 2) + 1.5
    tables = filter_environment(ramp.float()).double()

    def radiance(diffuse_albedo, residual, f0, roughness, normal):
        return reference.shade_split_sum(diffuse_albedo, residual, f0, roughness, normal, points["wo"], tables, brdf_table(32))

    leaves = [value for name, value in points.items() if name != "wo"]
    assert torch.autograd.gradcheck(radiance, leaves, eps=1e-7, atol=1e-5, rtol=1e-3)


def test_a_mirror_shows_the_environment_where_it_is_also_across_the_seam_and_at_the_poles():
    radiance = noisy_environment(seed=4)
    azimuth = torch.tensor([math.pi, -math.pi + 1e-3, math.pi - 4e-3, 0.0, 1.0, -2.0]).repeat(3)
    polar = torch.tensor([0.01, 1.3, math.pi - 0.01]).repeat_interleave(6)
    mirror = torch.stack([azimuth.cos() * polar.sin(), azimuth.sin() * polar.sin(), polar.cos()], -1)
    wo = torch.nn.functional.normalize(torch.linalg.cross(mirror, torch.tensor([[0.3, -0.8, 0.5]]).expand_as(mirror)), dim=-1)
    normal = torch.nn.functional.normalize(mirror + wo, dim=-1)
    count = len(mirror)
    zero, white, smooth = torch.zeros(count, 3), torch.ones(count, 3), torch.zeros(count)
    seen = shade_split_sum(zero, zero, white, smooth, normal, wo, filter_environment(radiance))
    under_white = shade_split_sum(zero, zero, white, smooth, normal, wo, filter_environment(torch.ones_like(radiance)))
    torch.testing.assert_close(seen / under_white, environment_radiance(Environment(radiance), mirror), rtol=2e-3, atol=2e-3)


def test_a_white_diffuse_surface_shows_the_irradiance_over_pi():
    # Light from the upper half only: cos-weighted, a surface tilted by theta sees (1 + cos theta) / 2 of it.
    radiance = torch.zeros(*ENVIRONMENT_SIZE, 3)
    radiance[: ROWS // 2] = 3.0
    theta = torch.tensor([0.3, 1.0, 1.6, 2.4])
    normal = torch.stack([theta.sin() * 0.6, theta.sin() * -0.8, theta.cos()], -1)
    zero, white = torch.zeros(4, 3), torch.ones(4, 3)
    tables = filter_environment(radiance)
    seen = [shade_split_sum(albedo, zero, zero, torch.ones(4), normal, normal, tables) for albedo in (white, zero)]
    torch.testing.assert_close((seen[0] - seen[1])[:, 0], 3.0 * (1 + theta.cos()) / 2, atol=0.03, rtol=0)


def test_same_bits_whatever_the_number_of_threads(noisy_tables: torch.Tensor, monkeypatch: pytest.MonkeyPatch):
    results = []
    for threads in ("1", "3"):
        monkeypatch.setenv("DRGS_THREADS", threads)
        monkeypatch.setattr(warp_torch, "_pool", None)  # the pool is made once, for the threads asked for then
        radiance, gradients = shade_with_gradients(shade_split_sum, random_points(), noisy_tables, "cpu", torch.float32)
        results.append([radiance, *gradients.values()])
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))


def test_no_points_give_no_radiance(noisy_tables: torch.Tensor):
    tables = noisy_tables.clone().requires_grad_(True)
    none = torch.zeros(0, 3)
    radiance = shade_split_sum(none, none, none, torch.zeros(0), none, none, tables)
    radiance.sum().backward()
    assert radiance.shape == (0, 3) and float(tables.grad.abs().max()) == 0.0
