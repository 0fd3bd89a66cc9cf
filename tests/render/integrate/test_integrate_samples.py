"""The differentiable estimator against its float64 twin, finite differences and a closed form."""

import dataclasses
import math

import pytest
import torch

from drgs import warp_torch
from drgs.reference import integrate_samples as reference
from drgs.reference.split_sum import brdf_factors
from drgs.render.integrate.environment_table import build_environment_table
from drgs.render.integrate.integrate_samples import integrate_samples
from drgs.render.integrate.sample_rays import sample_rays
from drgs.render.records import Rays, SampleCounts, ShadingPoints
from tests.render.closed_form_scenes import constant_sky, points_seen_at, sunny_sky

NAMES = ("normal_world", "albedo", "roughness", "metallic")


@dataclasses.dataclass(frozen=True, eq=False)
class Scene:
    points: ShadingPoints
    rays: Rays
    transmittance: torch.Tensor
    hit_radiance: torch.Tensor
    table: torch.Tensor


def cast(record, dtype: torch.dtype, device: str = "cpu", **changes):
    fields = {f.name: changes.get(f.name, getattr(record, f.name)).to(device) for f in dataclasses.fields(record)}
    return type(record)(**{k: v.to(dtype) if v.is_floating_point() else v for k, v in fields.items()})


def various_scene(counts: SampleCounts, copies: int = 6, height: int = 16) -> Scene:
    """Points of every kind, partly shadowed, under coloured noise with a sun."""
    points = points_seen_at([5.0, 40.0, 70.0, 85.0], copies=copies)
    generator = torch.Generator().manual_seed(11)
    count = len(points.pixel)
    rand = lambda *shape: torch.rand(*shape, generator=generator)  # noqa: E731
    points = dataclasses.replace(points, albedo=rand(count, 3), roughness=0.1 + 0.9 * rand(count), metallic=rand(count))
    environment = sunny_sky(height=height, sun=20.0)
    rays = sample_rays(points, build_environment_table(environment), counts, seed=4)
    transmittance = rand(*rays.weight.shape)
    return Scene(points, rays, transmittance, rand(*rays.weight.shape, 3) * (1 - transmittance)[..., None], environment.radiance)


def gradients(function, scene: Scene, dtype: torch.dtype, device: str = "cpu") -> tuple[torch.Tensor, tuple[torch.Tensor, ...]]:
    """Radiance, and the gradient of a fixed weighted sum of it by normal, materials and environment."""
    leaves = {name: getattr(scene.points, name).to(device, dtype).requires_grad_(True) for name in NAMES}
    table = scene.table.to(device, dtype).requires_grad_(True)
    points = cast(scene.points, dtype, device, **leaves)
    radiance = function(
        points, cast(scene.rays, dtype, device), scene.transmittance.to(device, dtype), scene.hit_radiance.to(device, dtype), table
    )
    weights = torch.rand(radiance.shape, generator=torch.Generator().manual_seed(2)).to(device, dtype) - 0.3
    return radiance.detach().cpu(), tuple(g.cpu() for g in torch.autograd.grad((radiance * weights).sum(), [*leaves.values(), table]))


def test_radiance_and_gradients_equal_the_twin(device: str):
    scene = various_scene(SampleCounts(16, 8, 8))
    expected, expected_gradients = gradients(reference.integrate_samples, scene, torch.float64)
    radiance, actual_gradients = gradients(integrate_samples, scene, torch.float32, device)
    torch.testing.assert_close(radiance.double(), expected, rtol=1e-4, atol=1e-5)
    for name, actual, wanted in zip((*NAMES, "environment"), actual_gradients, expected_gradients, strict=True):
        assert float(wanted.abs().max()) > 0, name
        error = (actual.double() - wanted).abs() / (wanted.abs() + 1e-3 * wanted.abs().max())
        assert float(error.max()) < 5e-3, f"{name}: {float(error.max()):.1e}"


@pytest.mark.slow
def test_the_twins_gradient_is_that_of_finite_differences():
    scene = various_scene(SampleCounts(2, 1, 1), copies=1, height=4)
    rays, transmittance, hit_radiance = cast(scene.rays, torch.float64), scene.transmittance.double(), scene.hit_radiance.double()
    inputs = [getattr(scene.points, name).double().requires_grad_(True) for name in NAMES] + [scene.table.double().requires_grad_(True)]

    def radiance(*values):
        points = cast(scene.points, torch.float64, **dict(zip(NAMES, values[:-1], strict=True)))
        return reference.integrate_samples(points, rays, transmittance, hit_radiance, values[-1])

    assert torch.autograd.gradcheck(radiance, inputs, eps=1e-6, atol=1e-4, rtol=1e-4)


def test_the_kernels_gradient_is_that_of_finite_differences():
    scene = various_scene(SampleCounts(8, 4, 4))
    # Smooth lobes: a finite step must stay small against their width.
    scene = dataclasses.replace(scene, points=dataclasses.replace(scene.points, roughness=scene.points.roughness.clamp(min=0.4)))
    _, analytic = gradients(integrate_samples, scene, torch.float32)
    weights = torch.rand(len(scene.points.pixel), 3, generator=torch.Generator().manual_seed(2)) - 0.3
    generator = torch.Generator().manual_seed(8)
    for k, name in enumerate((*NAMES, "environment")):
        value = scene.table if name == "environment" else getattr(scene.points, name)
        direction = torch.randn(value.shape, generator=generator)
        step = {"environment": 1e-2, "normal_world": 2e-4}.get(name, 2e-3)

        def total(sign: float, name=name, value=value, direction=direction, step=step) -> float:
            moved = value + sign * step * direction
            points = scene.points if name == "environment" else dataclasses.replace(scene.points, **{name: moved})
            table = moved if name == "environment" else scene.table
            with torch.no_grad():
                return float(
                    (integrate_samples(points, scene.rays, scene.transmittance, scene.hit_radiance, table).double() * weights).sum()
                )

        measured = (total(1.0) - total(-1.0)) / (2 * step)
        assert measured == pytest.approx(float((analytic[k] * direction).sum()), rel=0.02), name


def test_radiance_met_is_not_dimmed_and_openness_lets_the_sky_in():
    scene = various_scene(SampleCounts(8, 4, 4))
    nothing, everything = torch.zeros_like(scene.transmittance), torch.ones_like(scene.transmittance)
    black = torch.zeros_like(scene.hit_radiance)
    shut = integrate_samples(scene.points, scene.rays, nothing, black, scene.table)
    assert float(shut.abs().max()) == 0.0
    sky = integrate_samples(scene.points, scene.rays, everything, black, torch.full_like(scene.table, 0.7))
    hit_radiance = integrate_samples(scene.points, scene.rays, nothing, torch.full_like(scene.hit_radiance, 0.7), scene.table)
    torch.testing.assert_close(sky, hit_radiance)
    assert float(sky.min()) > 0.0


@pytest.mark.parametrize("roughness", [0.3, 0.7])
def test_a_metal_under_a_constant_sky_reflects_the_integral_of_its_brdf(roughness: float):
    angles = [15.0, 45.0, 70.0]
    points = points_seen_at(angles, albedo=0.6, roughness=roughness, metallic=1.0)
    sky = constant_sky(2.0)
    rays = sample_rays(points, build_environment_table(sky), SampleCounts(64, 512, 0), seed=1)
    radiance = integrate_samples(points, rays, torch.ones_like(rays.weight), torch.zeros_like(rays.direction_world), sky.radiance)
    for k, angle in enumerate(angles):
        f1, f2 = brdf_factors(math.cos(math.radians(angle)), roughness)
        assert float(radiance[k, 0]) == pytest.approx(2.0 * (0.6 * f1 + f2), rel=0.015)


def test_rays_shared_out_by_material_keep_the_mean_gradient_of_metal_and_calm_it():
    """Cosine rays, half of a place's by the published split, hardly ever meet what a mirror shows."""
    points = points_seen_at([40.0], albedo=0.6, roughness=0.2, metallic=1.0, copies=8000)
    sky = sunny_sky(height=32, sun=20.0)

    def gradients_of_points(by_material: bool) -> list[torch.Tensor]:
        rays = sample_rays(points, build_environment_table(sky), SampleCounts(32, 16, 16), seed=5, by_material=by_material)
        leaves = {name: getattr(points, name).clone().requires_grad_(True) for name in NAMES}
        open_sky, dark = torch.ones_like(rays.weight), torch.zeros_like(rays.direction_world)
        radiance = integrate_samples(dataclasses.replace(points, **leaves), rays, open_sky, dark, sky.radiance)
        return [gradient.view(len(points.pixel), -1) for gradient in torch.autograd.grad(radiance.sum(), list(leaves.values()))]

    for name, even, shared in zip(NAMES, gradients_of_points(False), gradients_of_points(True), strict=True):
        error = (even.var(0) / len(even) + shared.var(0) / len(shared)).sqrt()
        assert bool(((even.mean(0) - shared.mean(0)).abs() < 4 * error + 1e-3 * even.mean(0).abs()).all()), name
        if name != "metallic":
            assert float(shared.std(0).norm()) < 0.8 * float(even.std(0).norm()), name


def test_same_bits_whatever_the_number_of_threads(monkeypatch: pytest.MonkeyPatch):
    scene = various_scene(SampleCounts(8, 4, 4), copies=40)
    results = []
    for threads in ("1", "3"):
        monkeypatch.setenv("DRGS_THREADS", threads)
        monkeypatch.setattr(warp_torch, "_pool", None)  # the pool is made once, for the threads asked for then
        radiance, grads = gradients(integrate_samples, scene, torch.float32)
        results.append([radiance, *grads])
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))


def test_no_points_give_no_radiance():
    scene = various_scene(SampleCounts(2, 1, 1))
    none = ShadingPoints(*(getattr(scene.points, f.name)[:0] for f in dataclasses.fields(ShadingPoints)))
    rays = Rays(none.position_world, scene.rays.direction_world[:0], scene.rays.weight[:0])
    table = scene.table.clone().requires_grad_(True)
    radiance = integrate_samples(none, rays, scene.transmittance[:0], scene.hit_radiance[:0], table)
    radiance.sum().backward()
    assert radiance.shape == (0, 3) and float(table.grad.abs().max()) == 0.0


def test_opposite_directions_have_a_finite_gradient():
    """Between them there is no half vector; the lobe is cut there."""
    points = points_seen_at([20.0], albedo=0.5, roughness=0.4, metallic=0.5)
    points = dataclasses.replace(
        points, normal_world=points.normal_world.requires_grad_(True), roughness=points.roughness.requires_grad_(True)
    )
    table = torch.ones(4, 8, 3)
    rays = sample_rays(points, build_environment_table(constant_sky(1.0)), SampleCounts(4, 0, 0), seed=1)
    against = dataclasses.replace(rays, direction_world=-points.wo_world[:, None].expand_as(rays.direction_world).contiguous())
    radiance = integrate_samples(points, against, torch.ones_like(rays.weight), torch.zeros_like(rays.direction_world), table)
    gradients = torch.autograd.grad(radiance.sum(), [points.normal_world, points.roughness])
    assert all(bool(torch.isfinite(values).all()) for values in gradients)
