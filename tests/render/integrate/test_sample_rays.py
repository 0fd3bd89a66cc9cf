"""Kernels against the torch twin, weights against integrals, and independence of batching."""

import dataclasses
import math

import pytest
import torch

from drgs.reference import sample_rays as reference
from drgs.render.integrate.environment_table import build_environment_table
from drgs.render.integrate.sample_rays import sample_counts, sample_rays, shading_points
from drgs.render.records import GBuffer, SampleCounts, ShadingPoints
from drgs.scene.environment import Environment
from tests.render.closed_form_scenes import constant_sky, points_seen_at, sunny_sky


def points_as(points: ShadingPoints, dtype: torch.dtype | None = None, device: str = "cpu", rows: slice = slice(None)) -> ShadingPoints:
    fields = {f.name: getattr(points, f.name)[rows].to(device) for f in dataclasses.fields(points)}
    return ShadingPoints(**{k: v.to(dtype) if dtype and v.is_floating_point() else v for k, v in fields.items()})


@pytest.mark.parametrize(
    ("roughness", "metallic", "by_material"), [(0.2, 0.0, False), (0.6, 0.0, True), (1.0, 0.0, False), (0.2, 1.0, True)]
)
def test_kernel_draws_what_the_reference_draws(device: str, roughness: float, metallic: float, by_material: bool) -> None:
    points = points_seen_at([5.0, 50.0, 85.0], roughness=roughness, metallic=metallic, copies=20)
    counts = SampleCounts(16, 8, 8)
    environment = sunny_sky(sun=20.0)
    table = build_environment_table(Environment(environment.radiance.to(device)))
    rays = sample_rays(points_as(points, device=device), table, counts, seed=3, by_material=by_material)
    twin = reference.sample_rays(
        points_as(points, torch.float64),
        build_environment_table(Environment(environment.radiance.double())),
        counts,
        3,
        by_material=by_material,
    )
    kept = (twin.weight > 0) & (rays.weight.cpu() > 0)
    assert float((kept == (twin.weight > 0)).float().mean()) > 0.995
    distance = (rays.direction_world.cpu().double() - twin.direction_world)[kept].norm(dim=-1)
    assert float(distance.quantile(0.99)) < 1e-4
    relative = (rays.weight.cpu().double() / twin.weight - 1)[kept].abs()
    assert float(relative.quantile(0.99)) < 2e-3


@pytest.mark.parametrize("counts", [SampleCounts(64, 0, 0), SampleCounts(0, 0, 64), SampleCounts(32, 16, 16), SampleCounts(16, 16, 32)])
def test_weights_integrate_the_cosine_to_pi(counts: SampleCounts) -> None:
    points = points_seen_at([30.0, 70.0], copies=200)
    rays = sample_rays(points, build_environment_table(sunny_sky(sun=5.0)), counts, seed=1)
    cosine = (rays.direction_world * points.normal_world[:, None]).sum(-1)
    estimates = (cosine * rays.weight).sum(1)
    error = float(estimates.std()) / math.sqrt(len(estimates))
    assert abs(float(estimates.mean()) - math.pi) < 4 * error + 1e-4


def test_samples_do_not_depend_on_batching(device: str) -> None:
    points = points_as(points_seen_at([10.0, 60.0], copies=50), device=device)
    table = build_environment_table(Environment(sunny_sky().radiance.to(device)))
    whole = sample_rays(points, table, SampleCounts(4, 2, 2), seed=9)
    part = sample_rays(points_as(points, device=device, rows=slice(37, 61)), table, SampleCounts(4, 2, 2), seed=9)
    assert torch.equal(whole.direction_world[37:61], part.direction_world)
    assert torch.equal(whole.weight[37:61], part.weight)


def test_samples_below_the_horizon_weigh_nothing() -> None:
    points = points_seen_at([80.0], copies=50)
    rays = sample_rays(points, build_environment_table(constant_sky()), SampleCounts(2, 8, 32), seed=0)
    below = (rays.direction_world * points.normal_world[:, None]).sum(-1) <= 0
    assert bool(below.any())
    assert float(rays.weight[below].abs().max()) == 0.0
    assert bool(torch.isfinite(rays.weight).all())


def test_points_seen_from_below_get_no_samples() -> None:
    rays = sample_rays(points_seen_at([100.0]), build_environment_table(constant_sky()), SampleCounts(), seed=0)
    assert float(rays.weight.abs().max()) == 0.0


def test_default_split_is_two_to_one_to_one() -> None:
    assert sample_counts(32) == SampleCounts(16, 8, 8) == SampleCounts()
    assert sample_counts(512) == SampleCounts(256, 128, 128)


def test_shading_points_are_the_covered_pixels_with_and_without_gradients(device: str) -> None:
    coverage = torch.rand(13, 21, device=device).round()
    wide = torch.rand(13, 30, 14, device=device)[:, 4:25]  # lies in memory with gaps
    gbuffer = GBuffer(coverage, wide[..., 0], wide[..., :3], wide[..., 3:6], wide[..., 6:9], wide[..., 9:12], wide[..., 12], wide[..., 13])
    points = shading_points(gbuffer)
    learnt = shading_points(dataclasses.replace(gbuffer, roughness=gbuffer.roughness.clone().requires_grad_(True)))
    assert learnt.roughness.requires_grad and not points.roughness.requires_grad
    y, x = torch.nonzero(coverage == 1).unbind(-1)
    assert 0 < len(x) < coverage.numel()
    assert torch.equal(points.pixel, (21 * y + x).int())
    for name in set(vars(points)) - {"pixel"}:
        assert torch.equal(getattr(points, name), getattr(gbuffer, name)[y, x]), name
        assert torch.equal(getattr(points, name), getattr(learnt, name).detach()), name
    nothing = shading_points(dataclasses.replace(gbuffer, coverage=torch.zeros_like(coverage)))
    assert {tuple(values.shape) for values in vars(nothing).values()} == {(0, 3), (0,)} and nothing.pixel.dtype == torch.int32
