"""Each skip against the same frame with nothing skipped, and the scenes where it must not fire."""

import math

import pytest
import torch

from drgs.render.accumulate import RenderSettings
from drgs.render.environment_table import build_environment_table, environment_light
from drgs.render.plan import plan_frame
from drgs.render.render_frame import render_frame
from drgs.render.sample_rays import SampleCounts
from drgs.render.shade import RayStarts, shade
from drgs.render.trace_rays import build_tracer
from drgs.scene.environment import Environment
from drgs.scene.posed_scene import PosedScene
from tests.render.closed_form_scenes import constant_sky, front_camera, points_seen_at, sphere_mesh, sunny_sky, two_spheres


def test_an_even_sky_needs_no_environment_samples_and_keeps_the_total() -> None:
    plan = plan_frame(constant_sky(), 1.0, SampleCounts(16, 8, 8), 1, skip=True)
    assert plan.counts.environment == 0 and plan.counts.total == 32
    assert "environment samples" in [skip.what for skip in plan.skips]


def test_a_faint_sun_keeps_its_environment_samples() -> None:
    sky = constant_sky().radiance.clone()
    sky[5, 5] = 1.01
    assert plan_frame(Environment(sky), 1.0, SampleCounts(16, 8, 8), 1, skip=True).counts.environment == 8


def test_nothing_is_skipped_when_told_not_to() -> None:
    plan = plan_frame(constant_sky(0.0), 1.0, SampleCounts(16, 8, 8), 1, skip=False)
    assert plan.skips == () and not plan.by_material and plan.counts == SampleCounts(16, 8, 8)


def test_a_black_sky_sends_no_rays_and_gives_black() -> None:
    frame = render_frame(PosedScene(None, sphere_mesh(), constant_sky(0.0)), front_camera(), RenderSettings(samples_per_pixel=32))
    assert float(frame.radiance_linear.abs().max()) == 0.0
    assert float(frame.gbuffer.coverage.max()) == 1.0 and frame.metadata["skipped"][0]["what"] == "light rays"


@pytest.mark.parametrize("metallic", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("roughness", [0.05, 0.2, 0.8])
def test_sharing_samples_out_by_material_keeps_the_mean(metallic: float, roughness: float) -> None:
    points = points_seen_at([40.0], roughness=roughness, metallic=metallic, copies=400)
    sky = sunny_sky(sun=5.0)
    light = environment_light(sky, build_environment_table(sky))
    starts = RayStarts(points.position_world + 100 * points.normal_world, points.normal_world)
    tracer = build_tracer(sphere_mesh(1, radius=1e-3))
    results = [
        shade(points, starts, light, tracer, SampleCounts(16, 8, 8), 0, seed, by_material=chosen)
        for seed, chosen in ((0, True), (1, False))
    ]
    means = [(r.diffuse + r.specular).mean(-1) for r in results]
    error = math.sqrt(float(means[0].var() + means[1].var()) / len(means[0]))
    assert abs(float(means[0].mean() - means[1].mean())) < 4 * error + 1e-5


def test_sharing_samples_out_by_material_lowers_the_error_on_metal() -> None:
    points = points_seen_at([40.0], roughness=0.2, metallic=1.0, copies=400)
    sky = sunny_sky(sun=5.0)
    light = environment_light(sky, build_environment_table(sky))
    starts = RayStarts(points.position_world + 100 * points.normal_world, points.normal_world)
    tracer = build_tracer(sphere_mesh(1, radius=1e-3))
    spread = [
        float(shade(points, starts, light, tracer, SampleCounts(16, 8, 8), 0, 0, by_material=chosen).specular.mean(-1).var())
        for chosen in (True, False)
    ]
    assert spread[0] < 0.6 * spread[1]


@pytest.mark.parametrize("sky", [constant_sky(), sunny_sky(sun=3.0)])
def test_frames_with_and_without_skipping_agree(sky: Environment) -> None:
    scene = PosedScene(None, two_spheres(roughness=0.4, metallic=0.5), sky)
    frames = [
        render_frame(scene, front_camera(16, distance=8.0), RenderSettings(samples_per_pixel=512, skip=skip, seed=int(skip)))
        for skip in (True, False)
    ]
    covered = frames[0].gbuffer.coverage == 1
    a, b = (torch.mean(frame.radiance_linear[covered]) for frame in frames)
    assert abs(float(a / b) - 1) < 5e-3
