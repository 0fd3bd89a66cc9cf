"""Whole frames: furnaces, coverage, progress, determinism, and ray starts under splatted points."""

import math

import pytest
import torch

from drgs.maths.color import srgb_from_linear
from drgs.render.film.resolve_frame import resolve_frame
from drgs.render.progressive.refine import refine_frame
from drgs.render.progressive.start_frame import start_frame
from drgs.render.records import GBuffer, RenderSettings, SampleCounts
from drgs.render.render_frame import render_frame
from drgs.render.visible.trace_primary import trace_primary
from drgs.scene.camera import Camera, pixel_rays_world
from drgs.scene.environment import Environment, environment_radiance, rotate_environment
from drgs.scene.posed_scene import PosedScene
from tests.render.closed_form_scenes import constant_sky, front_camera, on_device, sphere_mesh, sunny_sky, two_spheres


def test_furnace_sphere_returns_incoming_radiance(device: str) -> None:
    """Albedo 1 under a sky of 1: the diffuse part is 1 in every pixel."""
    mesh = on_device(sphere_mesh(4, albedo=1.0, roughness=1.0), device)
    scene = PosedScene(None, mesh, Environment(constant_sky().radiance.to(device)))
    frame = render_frame(scene, front_camera().to(device), RenderSettings(samples_per_pixel=128))
    inside = frame.gbuffer.coverage == 1
    assert abs(float(frame.radiance.diffuse[inside].mean()) - 1) < 5e-3
    assert float(frame.radiance.visibility[inside].min()) > 0.9
    assert frame.rgba_srgb.shape == (24, 24, 4)


def test_coverage_of_a_sphere_is_the_area_of_its_outline() -> None:
    camera = front_camera(32)
    state = start_frame(PosedScene(None, sphere_mesh(5), constant_sky()), camera, RenderSettings(bounces=0, counts=SampleCounts(1, 0, 0)))
    coverage = resolve_frame(refine_frame(state, 32)).gbuffer.coverage
    angle = math.asin(1 / 4)
    expected = math.pi * (math.tan(angle) * float(camera.intrinsics[0, 0])) ** 2
    assert abs(float(coverage.sum()) / expected - 1) < 5e-3


def test_depth_and_normals_of_a_traced_sphere_are_exact() -> None:
    gbuffer = trace_primary(sphere_mesh(5), front_camera(33))
    assert abs(float(gbuffer.depth[16, 16]) - 3) < 1e-3
    assert bool(torch.isinf(gbuffer.depth[0, 0]))
    covered = gbuffer.coverage > 0
    radial = torch.nn.functional.normalize(gbuffer.position_world[covered], dim=-1)
    assert float((radial * gbuffer.normal_world[covered]).sum(-1).min()) > 0.9995


def test_refining_twice_is_refining_by_two_passes() -> None:
    scene = PosedScene(None, two_spheres(), sunny_sky())
    start = start_frame(scene, front_camera(distance=8), RenderSettings(seed=3))
    apart, at_once = refine_frame(refine_frame(start)), refine_frame(start, 2)
    assert torch.equal(resolve_frame(apart).radiance_linear, resolve_frame(at_once).radiance_linear)
    assert start.passes == 0 and float(start.sums.weight.max()) == 0  # the given state is left alone


@pytest.mark.parametrize("bounces", [0, 1])
def test_passes_side_by_side_are_those_one_after_another(bounces: int) -> None:
    """Five passes at once, threads with pixels of their own and several passes in a batch, against five single ones."""
    scene = PosedScene(None, two_spheres(metallic=0.3), sunny_sky(sun=20.0))
    apart = at_once = refine_frame(start_frame(scene, front_camera(37, distance=8), RenderSettings(seed=3, bounces=bounces)))
    for _ in range(5):
        apart = refine_frame(apart)
    at_once = refine_frame(at_once, 5)
    assert at_once.passes == 6
    for name in ("diffuse", "specular", "weight", "luminance_squared", "scatter", "visibility", "surface"):
        assert torch.equal(getattr(apart.sums, name), getattr(at_once.sums, name))


def test_same_seed_same_bits_on_the_cpu() -> None:
    scene = PosedScene(None, two_spheres(), sunny_sky())
    a, b, other = (render_frame(scene, front_camera(distance=8), RenderSettings(samples_per_pixel=16, seed=s)) for s in (1, 1, 2))
    assert torch.equal(a.rgba_srgb, b.rgba_srgb)
    assert not torch.equal(a.rgba_srgb, other.rgba_srgb)


@pytest.mark.slow
def test_error_falls_as_samples_grow_and_the_variance_says_so() -> None:
    scene = PosedScene(None, sphere_mesh(4), sunny_sky(sun=20.0))
    exact = render_frame(scene, front_camera(), RenderSettings(samples_per_pixel=4096, bounces=0, seed=99))
    truth, inside = exact.radiance_linear.mean(-1), exact.gbuffer.coverage == 1
    errors = []
    for samples in (16, 256):
        frame = render_frame(scene, front_camera(), RenderSettings(samples_per_pixel=samples, bounces=0))
        errors.append(float(((frame.radiance_linear.mean(-1) - truth)[inside] ** 2).mean()))
        predicted = float(frame.radiance.variance[inside].mean())
        assert 0.4 < predicted / errors[-1] < 6  # stratified samples do better than their scatter predicts, never much worse
    assert errors[1] < errors[0] / 12


def test_turning_the_light_equals_turning_its_table() -> None:
    sky = sunny_sky(height=16, sun=20.0)
    degrees = 360 / 32 * 5  # whole texels: both are exact
    settings = RenderSettings(samples_per_pixel=512, bounces=0)
    turned = render_frame(PosedScene(None, sphere_mesh(4), sky, environment_rotation_degrees=degrees), front_camera(), settings)
    table = render_frame(PosedScene(None, sphere_mesh(4), rotate_environment(sky, degrees)), front_camera(), settings)
    inside = turned.gbuffer.coverage == 1
    difference = (turned.radiance_linear - table.radiance_linear)[inside]
    assert float(difference.abs().mean() / table.radiance_linear[inside].mean()) < 0.02


def splatted_sphere(camera: Camera, offset: float) -> GBuffer:
    """A G-buffer of the unit sphere whose points lie `offset` outside it along the view, as splats' points do."""
    exact = trace_primary(sphere_mesh(5), camera)
    position = exact.position_world + offset * exact.wo_world
    return GBuffer(exact.coverage, exact.depth, position, exact.normal_world, exact.wo_world, exact.albedo, exact.roughness, exact.metallic)


@pytest.mark.parametrize("offset", [0.0, 0.01, -0.01, 0.03, -0.03])
def test_splatted_points_near_the_mesh_show_no_shadow_acne(offset: float) -> None:
    camera = front_camera()
    scene = PosedScene(None, sphere_mesh(3), constant_sky())  # coarser than the splatted surface
    state = start_frame(scene, camera, RenderSettings(bounces=0, primary="gaussians"), gbuffer=splatted_sphere(camera, offset))
    frame = resolve_frame(refine_frame(state))
    covered = frame.gbuffer.coverage > 0
    facing = (frame.gbuffer.normal_world * frame.gbuffer.wo_world).sum(-1) > 0.2
    assert float(frame.radiance.visibility[covered & facing].min()) > 0.9
    assert float(frame.radiance.visibility[covered].mean()) > 0.97


def test_gaussians_asked_for_where_there_are_none_is_an_error() -> None:
    with pytest.raises(ValueError, match="no Gaussians"):
        start_frame(PosedScene(None, sphere_mesh(), constant_sky()), front_camera(), RenderSettings(primary="gaussians"))


def test_background_shows_the_environment_behind_the_object() -> None:
    sky = sunny_sky(sun=1.0)
    settings = RenderSettings(samples_per_pixel=8, bounces=0, background="environment")
    frame = render_frame(PosedScene(None, sphere_mesh(), sky, environment_intensity=0.5), front_camera(distance=20), settings)
    assert float(frame.rgba_srgb[..., 3].min()) == 1.0
    _, direction = pixel_rays_world(front_camera(distance=20))
    torch.testing.assert_close(frame.rgba_srgb[0, 0, :3], srgb_from_linear(0.5 * environment_radiance(sky, direction[0, 0])).clamp(0, 1))


def test_camera_inside_or_behind_renders_without_nan() -> None:
    inside = front_camera(distance=0.0)
    frame = render_frame(PosedScene(None, sphere_mesh(), sunny_sky()), inside, RenderSettings(samples_per_pixel=8))
    assert bool(torch.isfinite(frame.rgba_srgb).all())
    assert float(frame.radiance_linear.max()) == 0.0  # the back of a triangle is black
    away = front_camera(distance=-8.0)
    assert (
        float(render_frame(PosedScene(None, sphere_mesh(), sunny_sky()), away, RenderSettings(samples_per_pixel=8)).gbuffer.coverage.max())
        == 0
    )
