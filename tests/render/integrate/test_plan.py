"""Each skip against the same frame with nothing skipped, and the scenes where it must not fire."""

import dataclasses
import math

import pytest
import torch

from drgs.render.film.resolve_frame import resolve_frame
from drgs.render.integrate.choose_integrator import choose_integrator
from drgs.render.integrate.environment_pool import CANDIDATES
from drgs.render.integrate.environment_table import build_environment_table, environment_light
from drgs.render.integrate.integrator import IntegratorSettings
from drgs.render.integrate.plan import SceneFacts, light_spread, plan_frame, scene_facts
from drgs.render.intersect.horizon import Horizons
from drgs.render.intersect.trace_rays import build_tracer
from drgs.render.progressive.refine import refine_frame
from drgs.render.progressive.start_frame import start_frame
from drgs.render.records import RayStarts, RenderSettings, SampleCounts, ShadedPoints, ShadingPoints
from drgs.render.render_frame import render_frame
from drgs.scene.environment import Environment
from drgs.scene.mesh import TriangleMesh
from drgs.scene.posed_scene import PosedScene
from tests.render.closed_form_scenes import constant_sky, front_camera, points_seen_at, sphere_mesh, sunny_sky, two_spheres


def shaded(points: ShadingPoints, sky: Environment, counts: SampleCounts, seed: int, by_material: bool) -> ShadedPoints:
    """Direct light of points with nothing in the way."""
    tracer = build_tracer(sphere_mesh(1, radius=1e-3))
    starts = RayStarts(points.position_world + 100 * points.normal_world, points.normal_world)
    light = environment_light(build_environment_table(sky))
    return choose_integrator(tracer).shade(points, starts, light, IntegratorSettings(counts, seed=seed, by_material=by_material))


def test_an_even_sky_needs_no_environment_samples_and_keeps_the_total() -> None:
    plan = plan_frame(constant_sky(), 1.0, SampleCounts(16, 8, 8), 1, skip=True)
    assert plan.counts.environment == 0 and plan.counts.total == 32
    assert "environment samples" in [skip.what for skip in plan.skips]


def test_a_faint_sun_keeps_its_environment_samples() -> None:
    sky = constant_sky().radiance.clone()
    sky[5, 5] = 1.01
    assert plan_frame(Environment(sky), 1.0, SampleCounts(16, 8, 8), 1, skip=True).counts.environment == 8


def test_the_spread_of_a_sky_is_the_share_of_the_sphere_that_lights() -> None:
    assert abs(light_spread(constant_sky()) - 1) < 1e-6
    half = torch.zeros(64, 128, 3)
    half[:32] = 2.0
    assert abs(light_spread(Environment(half)) - 0.5) < 1e-3
    assert light_spread(sunny_sky(sun=1e5)) < 1e-2


def test_under_a_sun_half_of_the_samples_go_to_the_environment() -> None:
    for total in (SampleCounts(16, 8, 8), SampleCounts(2, 1, 1)):
        plan = plan_frame(sunny_sky(sun=1e5), 1.0, total, 1, skip=True)
        assert plan.counts.total == total.total and plan.counts.environment == total.total // 2
        assert min(plan.counts.cosine, plan.counts.ggx) >= 1
        assert "part of the cosine and GGX samples" in [skip.what for skip in plan.skips]
    assert plan_frame(sunny_sky(sun=1e5), 1.0, SampleCounts(16, 8, 8), 1, skip=False).counts == SampleCounts(16, 8, 8)


def test_more_samples_of_the_environment_lower_the_error_under_a_sun() -> None:
    points = points_seen_at([40.0], roughness=0.4, metallic=0.0, copies=400)
    sky = sunny_sky(sun=1e4)
    spread = [
        float(shaded(points, sky, counts, 0, True).diffuse.mean(-1).var())
        for counts in (plan_frame(sky, 1.0, SampleCounts(16, 8, 8), 0, skip=True).counts, SampleCounts(16, 8, 8))
    ]
    assert spread[0] < 0.7 * spread[1]


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
    results = [shaded(points, sky, SampleCounts(16, 8, 8), seed, chosen) for seed, chosen in ((0, True), (1, False))]
    means = [(r.diffuse + r.specular).mean(-1) for r in results]
    error = math.sqrt(float(means[0].var() + means[1].var()) / len(means[0]))
    assert abs(float(means[0].mean() - means[1].mean())) < 4 * error + 1e-5


def test_a_mirror_keeps_a_sample_of_the_environment() -> None:
    """A smooth metal in a pass of four samples: light that only the lobe's far tail reflects is found, or at least known to be missing."""
    points = points_seen_at([40.0], roughness=0.1, metallic=1.0, copies=400)
    sky = torch.zeros(32, 64, 3)
    sky[3, 40] = 1e3  # far from the mirror direction
    environment = Environment(sky)
    means = [float(shaded(points, environment, SampleCounts(*counts), 0, True).specular.mean()) for counts in ((0, 3, 1), (0, 3, 61))]
    assert means[1] > 0 and abs(means[0] / means[1] - 1) < 0.2


def test_sharing_samples_out_by_material_lowers_the_error_on_metal() -> None:
    points = points_seen_at([40.0], roughness=0.2, metallic=1.0, copies=400)
    sky = sunny_sky(sun=5.0)
    spread = [float(shaded(points, sky, SampleCounts(16, 8, 8), 0, chosen).specular.mean(-1).var()) for chosen in (True, False)]
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


def skipped(scene: PosedScene, **settings) -> list[str]:
    return [skip["what"] for skip in render_frame(scene, front_camera(8, 12.0), RenderSettings(8, **settings)).metadata["skipped"]]


def with_one_vertex(mesh: TriangleMesh, **values: float) -> TriangleMesh:
    """The mesh with the materials of its first vertex changed."""
    changed = {name: getattr(mesh, name).clone() for name in values}
    for name, value in values.items():
        changed[name][0] = value
    return dataclasses.replace(mesh, **changed)


def test_rough_dielectrics_need_no_ggx_samples_but_one_shiny_or_metal_vertex_does() -> None:
    rough, sky = sphere_mesh(2, roughness=0.8), sunny_sky()
    assert "GGX samples" in skipped(PosedScene(None, rough, sky))
    for values in ({"roughness": 0.3}, {"metallic": 0.2}):
        assert "GGX samples" not in skipped(PosedScene(None, with_one_vertex(rough, **values), sky))


def test_bare_metal_needs_no_cosine_samples_but_one_diffuse_vertex_does() -> None:
    metal, sky = sphere_mesh(2, metallic=1.0), sunny_sky()
    assert "cosine samples" in skipped(PosedScene(None, metal, sky))
    assert "cosine samples" not in skipped(PosedScene(None, with_one_vertex(metal, metallic=0.9), sky))


@pytest.mark.parametrize(("metallic", "roughness", "what"), [(0.0, 0.85, "GGX samples"), (1.0, 0.4, "cosine samples")])
def test_dropping_a_strategy_keeps_the_mean(metallic: float, roughness: float, what: str) -> None:
    scene = PosedScene(None, two_spheres(roughness=roughness, metallic=metallic), sunny_sky(sun=3.0))
    frames = [render_frame(scene, front_camera(16, 8.0), RenderSettings(512, skip=skip, seed=int(skip))) for skip in (True, False)]
    assert what in [skip["what"] for skip in frames[0].metadata["skipped"]] and frames[1].metadata["skipped"] == []
    covered = frames[0].gbuffer.coverage == 1
    a, b = (torch.mean(frame.radiance_linear[covered]) for frame in frames)
    assert abs(float(a / b) - 1) < 6e-3


def test_strategies_are_dropped_for_what_reflections_show_too() -> None:
    """Facts are those of all surfaces: one metal vertex on the far side is in them."""
    mesh = with_one_vertex(sphere_mesh(2, roughness=0.8), metallic=1.0)
    paint = 1 - 1 / len(mesh.vertices)
    expected = SceneFacts(pytest.approx(0.7), 1.0, pytest.approx(0.8), diffuse_share=pytest.approx(paint))
    assert scene_facts(PosedScene(None, mesh, sunny_sky())) == expected


@pytest.mark.parametrize(("painted", "asks"), [(0.05, False), (0.2, True)])
def test_kept_light_is_asked_where_enough_of_the_surface_is_diffuse(painted: float, asks: bool) -> None:
    mesh = sphere_mesh(3, roughness=0.8)
    metallic = torch.ones_like(mesh.metallic)
    metallic[: round(painted * len(metallic))] = 0
    facts = scene_facts(PosedScene(None, dataclasses.replace(mesh, metallic=metallic), sunny_sky()))
    assert facts.diffuse_share == pytest.approx(painted, abs=2e-3)
    plan = plan_frame(constant_sky(), 1.0, SampleCounts(2, 1, 1), 0, True, facts, moving=True)
    assert plan.kept_light == asks


def test_a_triangle_smaller_than_a_pixel_is_in_no_empty_tile() -> None:
    mesh = sphere_mesh(2, radius=0.02)
    frames = [
        render_frame(PosedScene(None, mesh, constant_sky()), front_camera(64), RenderSettings(16, skip=skip)) for skip in (True, False)
    ]
    assert "rays through empty tiles" in [skip["what"] for skip in frames[0].metadata["skipped"]]
    assert float(frames[0].gbuffer.coverage.sum()) > 0
    assert torch.equal(frames[0].gbuffer.coverage, frames[1].gbuffer.coverage)


@pytest.mark.parametrize("bounces", [0, 1, 2])
def test_rays_spared_by_horizons_change_not_one_bit(bounces: int) -> None:
    scene = PosedScene(None, two_spheres(metallic=0.5), sunny_sky(sun=30.0))
    pictures = []
    for found in (False, True):
        tracer = build_tracer(scene.mesh)
        tracer.horizons = Horizons(scene.mesh, tracer.lift)
        if found:
            tracer.horizons.find(tracer.horizons.faces)
        state = start_frame(scene, front_camera(16, 8.0), RenderSettings(bounces=bounces), tracer)
        pictures.append(resolve_frame(refine_frame(state, 2)).radiance_linear)
        assert (tracer.horizons.spared() > 0.5) == found
    assert torch.equal(*pictures)


def test_giving_up_a_share_of_the_sky_errs_by_no_more_than_it() -> None:
    """Under an even sky, direct light, the error of a white surface is the share of the sky that is wrongly open."""
    scene = PosedScene(None, two_spheres(albedo=1.0, roughness=1.0), constant_sky())
    error = 0.1
    frames = []
    for settings in (RenderSettings(bounces=0, skip_error=error), RenderSettings(bounces=0)):
        tracer = build_tracer(scene.mesh)
        tracer.horizons = Horizons(scene.mesh, tracer.lift)
        tracer.horizons.find(tracer.horizons.faces)
        state = start_frame(scene, front_camera(24, 8.0), settings, tracer)
        even = dataclasses.replace(state, plan=dataclasses.replace(state.plan, spread_places=False))  # the same places in both
        frames.append(resolve_frame(refine_frame(even, 32)))
    assert any(f"{100 * error:g} %" in skip["bound"] for skip in frames[0].metadata["skipped"])
    brighter = (frames[0].radiance.diffuse - frames[1].radiance.diffuse)[frames[1].gbuffer.coverage == 1]
    assert 0 < float(brighter.max()) <= error + 0.02 and float(brighter.min()) > -1e-6


def test_a_black_sky_with_one_bright_texel_is_not_black() -> None:
    sky = constant_sky(0.0).radiance.clone()
    sky[3, 7] = 1e-3
    assert "light rays" not in skipped(PosedScene(None, sphere_mesh(1), Environment(sky)))


def test_samples_of_the_environment_choose_where_light_is_not_all_around() -> None:
    counts = SampleCounts(16, 8, 8)
    plan = plan_frame(sunny_sky(sun=200.0), 1.0, counts, 1, skip=True)
    assert plan.candidates == CANDIDATES and "one of 16 directions" in plan.skips[-1].why
    faint = Environment(1 + 0.1 * sunny_sky(sun=1.0).radiance)
    plans = [
        plan_frame(faint, 1.0, counts, 1, skip=True),
        plan_frame(constant_sky(), 1.0, counts, 1, skip=True),
        plan_frame(constant_sky(0.0), 1.0, counts, 1, skip=True),
        plan_frame(sunny_sky(sun=200.0), 1.0, counts, 1, skip=False),
        plan_frame(sunny_sky(sun=200.0), 1.0, counts, 1, skip=True, counts_given=True),
        plan_frame(sunny_sky(sun=200.0), 1.0, SampleCounts(16, 16, 0), 1, skip=True),
    ]
    assert [plan.candidates for plan in plans] == 6 * [1]


def test_a_frame_says_whether_its_samples_chose() -> None:
    scene = PosedScene(None, sphere_mesh(), sunny_sky())
    free, given = (
        render_frame(scene, front_camera(16), RenderSettings(samples_per_pixel=32, counts=counts))
        for counts in (None, SampleCounts(4, 2, 2))
    )
    assert free.metadata["candidates"] == CANDIDATES and given.metadata["candidates"] == 1
