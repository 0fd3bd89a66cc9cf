"""Stage 2: gradients against finite differences through the whole chain, and a fit that finds a light and a colour."""

import dataclasses
import math
import statistics
from collections.abc import Callable
from functools import cache
from pathlib import Path

import pytest
import torch

from drgs.reconstruct.capture.load_views import load_views
from drgs.reconstruct.checkpoints import fit_tensors, read_tensors, restore_fit, write_tensors
from drgs.reconstruct.fit.fit_loop import FitReport, FitState
from drgs.reconstruct.fit.light.environment_pyramid import ENVIRONMENT_PYRAMID, environment_table
from drgs.reconstruct.fit.surfels.fit_materials import (
    MaterialSettings,
    fit_materials,
    gaussians_from_materials,
    start_materials,
    trace_samples,
)
from drgs.reconstruct.fit.surfels.incident_light import build_incident_light
from drgs.reconstruct.fit.surfels.render_stage_two import points_at, render_stage_two
from drgs.render.integrate.environment_table import build_environment_table
from drgs.render.integrate.integrate_samples import integrate_samples
from drgs.render.integrate.sample_rays import sample_rays
from drgs.render.intersect.trace_rays import build_tracer
from drgs.render.records import SampleCounts
from drgs.scene.environment import Environment
from drgs.scene.gaussians import Gaussians
from drgs.scene.mesh import TriangleMesh
from drgs.scene.views import Views
from tests.reconstruct.fit.convex_rays import assert_only_the_sky_is_seen, rays_of_convex
from tests.reconstruct.surfel_spheres import surfel_sphere
from tests.reconstruct.tiny_capture import SPHERE_CENTER, SPHERE_RADIUS, sphere_views, write_nerf_synthetic
from tests.render.closed_form_scenes import front_camera, sphere_mesh

NEAR = 0.01


def various_surfels(count: int = 150) -> Gaussians:
    """A sphere of large overlapping surfels, each with another material."""
    surfels = surfel_sphere(count, opacity=0.7, overlap=1.5)
    generator = torch.Generator().manual_seed(6)
    rand = lambda *shape: torch.rand(*shape, generator=generator)  # noqa: E731
    return dataclasses.replace(
        surfels, albedo=0.2 + 0.6 * rand(count, 3), roughness=0.4 + 0.5 * rand(count), metallic=0.1 + 0.8 * rand(count)
    )


def environment_parameters(seed: int = 2) -> dict[str, torch.Tensor]:
    """Logs of a coloured light that is brighter on one side."""
    generator = torch.Generator().manual_seed(seed)
    return {
        f"environment_{rows}": 0.4 * torch.randn(1, 3, rows, 2 * rows, generator=generator) * (1.0 if rows == 8 else 0.1)
        for rows in ENVIRONMENT_PYRAMID
    }


@dataclasses.dataclass(frozen=True, eq=False)
class FrozenView:
    """One view with its rays drawn and traced once: what is left is a smooth function of the parameters."""

    parameters: dict[str, torch.Tensor]
    loss: Callable[[dict[str, torch.Tensor]], torch.Tensor]


@cache
def frozen_view() -> FrozenView:
    mesh, camera = sphere_mesh(subdivisions=2), front_camera(32)
    parameters = start_materials(various_surfels(), environment_parameters(), mesh, MaterialSettings(), 1.0).parameters
    with torch.no_grad():
        maps = render_stage_two(parameters, camera, NEAR)
        pixels = (maps.coverage > 0.9).flatten().nonzero().squeeze(1)
        points = points_at(maps, camera, pixels)
        table = build_environment_table(Environment(environment_table(parameters)))
        rays = sample_rays(points, table, SampleCounts(16, 8, 8), seed=3)
        generator = torch.Generator().manual_seed(4)
        transmittance = torch.rand(rays.weight.shape, generator=generator)
        hit_radiance = (1 - transmittance)[..., None] * torch.rand(rays.direction_world.shape, generator=generator)

    def loss(values: dict[str, torch.Tensor]) -> torch.Tensor:
        shaded = points_at(render_stage_two(values, camera, NEAR), camera, pixels)
        radiance = integrate_samples(shaded, rays, transmittance, hit_radiance, environment_table(values))
        return (radiance.double() - 0.3).square().mean()

    return FrozenView(parameters, loss)


STEPS = {
    "environment_8": 1e-2,
    "environment_32": 1e-2,
    "environment_128": 1e-2,
    "albedo_logits": 1e-2,
    "roughness_logits": 1e-2,
    "metallic_logits": 1e-2,
    "quats": 3e-4,
    "centers": 1e-5,
    "log_scales": 1e-3,
    "opacity_logits": 1e-2,
}
"""Half the distance of the two ends of a difference, an entry: large against float32's rounding, small against curvature, and for
centres so small that no two surfels change places in depth: the picture jumps there, and no gradient tells of it."""


@pytest.mark.slow
@pytest.mark.parametrize("name", STEPS)
def test_the_gradient_is_that_of_finite_differences(name: str):
    view = frozen_view()
    (gradient,) = torch.autograd.grad(view.loss(view.parameters), view.parameters[name])
    norm = float(gradient.norm())
    assert norm > 0 and bool(torch.isfinite(gradient).all())
    generator = torch.Generator().manual_seed(9)
    errors = []
    for k in range(4):
        noise = torch.randn(gradient.shape, generator=generator)
        # Half of the gradient's own direction keeps the derivative away from zero; the noise shows what the gradient leaves out.
        along = gradient / norm if k == 0 else gradient / norm + noise / noise.norm()
        direction = along * (math.sqrt(gradient.numel()) / along.norm())
        with torch.no_grad():
            ends = [
                float(view.loss(view.parameters | {name: view.parameters[name] + sign * STEPS[name] * direction})) for sign in (1.0, -1.0)
            ]
        measured = (ends[0] - ends[1]) / (2 * STEPS[name])
        errors.append(abs(measured - float((gradient * direction).sum())) / (norm * float(direction.norm())))
    assert max(errors) < 0.03, [f"{e:.3f}" for e in errors]


def test_materials_start_where_stage_one_ended():
    surfels, light = various_surfels(), environment_parameters()
    before = {name: value.clone() for name, value in light.items()}
    state = start_materials(surfels, light | {"centers": torch.zeros(3)}, sphere_mesh(), MaterialSettings(), 1.0)
    found = gaussians_from_materials(state)
    for name in ("centers", "log_scales", "opacity_logits", "quats_wxyz"):
        torch.testing.assert_close(getattr(found, name), getattr(surfels, name))
    for name in ("albedo", "roughness", "metallic"):
        torch.testing.assert_close(getattr(found, name), getattr(surfels, name), atol=1e-5, rtol=0)
    torch.testing.assert_close(environment_table(state.parameters), environment_table(light))
    with torch.no_grad():
        for value in state.parameters.values():
            assert value.is_leaf and value.requires_grad
            value += 1.0
    assert all(torch.equal(light[name], before[name]) for name in light)  # a copy


def test_shading_points_lie_on_their_pixels_ray_in_the_surface():
    camera = front_camera(32)
    parameters = frozen_view().parameters
    with torch.no_grad():
        maps = render_stage_two(parameters, camera, NEAR)
        pixels = (maps.coverage > 0.9).flatten().nonzero().squeeze(1)
        points = points_at(maps, camera, pixels)
    in_camera = points.position_world @ camera.camera_from_world[:3, :3].T + camera.camera_from_world[:3, 3]
    projected = in_camera @ camera.intrinsics.T
    expected = torch.stack([pixels % 32, pixels // 32], -1) + 0.5
    torch.testing.assert_close(projected[:, :2] / projected[:, 2:], expected, atol=1e-3, rtol=0)
    torch.testing.assert_close(in_camera[:, 2], maps.depth.flatten()[pixels], atol=1e-4, rtol=0)
    torch.testing.assert_close(
        points.wo_world, torch.nn.functional.normalize(camera.center_world - points.position_world, dim=-1), atol=1e-4, rtol=0
    )
    assert float((points.position_world.norm(dim=-1) - 1).abs().median()) < 0.15
    assert torch.equal(points.pixel, pixels.int())


def test_on_a_convex_surface_rays_above_it_see_the_sky_and_others_bring_nothing():
    mesh = sphere_mesh(subdivisions=3)
    points, rays = rays_of_convex(mesh)
    light = build_incident_light("mesh", mesh, surfel_sphere(300))
    assert_only_the_sky_is_seen(points, rays, *trace_samples(points, rays, light, build_tracer(mesh)))


@pytest.fixture(scope="module")
def painted_sphere(tmp_path_factory: pytest.TempPathFactory) -> tuple[Views, TriangleMesh, Gaussians]:
    """Views of the painted sphere, its mesh, and grey surfels in its surface."""
    views = load_views(write_nerf_synthetic(tmp_path_factory.mktemp("capture"), sphere_views(8, square=True)))
    center = torch.tensor(SPHERE_CENTER, dtype=torch.float32)
    unit = sphere_mesh(subdivisions=3)
    mesh = dataclasses.replace(unit, vertices=SPHERE_RADIUS * unit.vertices + center)
    return views, mesh, surfel_sphere(600, radius=SPHERE_RADIUS, center=tuple(center.tolist()))


def short(iterations: int, **changes) -> MaterialSettings:
    return MaterialSettings(iterations=iterations, points_a_step=128, samples=SampleCounts(8, 4, 4), **changes)


def grey_light() -> dict[str, torch.Tensor]:
    return {f"environment_{rows}": torch.zeros(1, 3, rows, 2 * rows) for rows in ENVIRONMENT_PYRAMID}


def fitted(
    scene: tuple[Views, TriangleMesh, Gaussians], settings: MaterialSettings, stop_at: int | None = None, state: FitState | None = None
) -> tuple[FitState, list[FitReport]]:
    views, mesh, surfels = scene
    state = state or start_materials(surfels, grey_light(), mesh, settings, SPHERE_RADIUS)
    reports: list[FitReport] = []
    fit_materials(
        views,
        mesh,
        state,
        settings,
        SPHERE_RADIUS,
        reports.append,
        lambda: stop_at is not None and state.iteration >= stop_at,
    )
    return state, reports


@pytest.mark.slow
def test_a_grey_sphere_takes_on_the_colours_of_its_photographs(painted_sphere):
    state, reports = fitted(painted_sphere, short(50))
    assert [r.iteration for r in reports] == list(range(1, 51))
    assert statistics.fmean(r.psnr for r in reports[-5:]) > reports[0].psnr + 4.0
    surfels = gaussians_from_materials(state)
    normal = (surfels.centers - torch.tensor(SPHERE_CENTER, dtype=torch.float32)) / SPHERE_RADIUS
    for channel in range(3):  # the paint's red grows with the normal's x, and so on
        together = torch.stack([surfels.albedo[:, channel], normal[:, channel]])
        assert float(torch.corrcoef(together)[0, 1]) > 0.5
    assert float((surfels.centers - painted_sphere[2].centers).norm(dim=-1).max()) < 0.01  # geometry moved a little only


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["mesh", "surfels"])
def test_the_same_seed_gives_the_same_bits(painted_sphere, kind: str):
    settings = short(4, indirect=kind, seed=5)
    results = [fitted(painted_sphere, settings)[0].parameters for _ in range(2)]
    other = fitted(painted_sphere, short(4, indirect=kind, seed=6))[0].parameters
    assert all(torch.equal(results[0][name], results[1][name]) for name in results[0])
    assert not torch.equal(results[0]["albedo_logits"], other["albedo_logits"])


@pytest.mark.slow
def test_a_fit_resumed_where_the_light_was_refreshed_ends_with_the_same_numbers(painted_sphere, tmp_path: Path):
    settings = short(9, refresh_every=5)
    whole, _ = fitted(painted_sphere, settings)
    stopped, _ = fitted(painted_sphere, settings, stop_at=5)
    assert stopped.iteration == 5
    write_tensors(tmp_path / "x", fit_tensors(stopped), {})
    _, mesh, surfels = painted_sphere
    resumed = start_materials(surfels, grey_light(), mesh, settings, SPHERE_RADIUS)
    restore_fit(read_tensors(tmp_path / "x", torch.device("cpu"))[0], resumed)
    fitted(painted_sphere, settings, state=resumed)
    assert resumed.iteration == 9
    for name, value in whole.parameters.items():
        assert torch.equal(resumed.parameters[name], value), name
