"""Pictures of a moving camera: what they leave out is named, errs no more, ends with the movement, and can be switched off."""

import dataclasses

import pytest
import torch

from drgs.render.film.resolve_frame import resolve_frame
from drgs.render.integrate.plan import FEWER_RAYS, KEPT_LIGHT, PIXEL_MIDDLES, moving_counts
from drgs.render.intersect.trace_rays import build_tracer
from drgs.render.progressive.frame_state import FrameState
from drgs.render.progressive.mean_radiance import quick_radiance
from drgs.render.progressive.quick_picture import quick_picture
from drgs.render.progressive.refine import refine_frame
from drgs.render.progressive.reproject import blend_history, remember, reproject
from drgs.render.progressive.see_middles import see_middles
from drgs.render.progressive.start_frame import start_frame
from drgs.render.records import DemodulatedLight, Frame, History, Radiance, RenderSettings, SampleCounts, ShadedPoints
from drgs.render.visible.image_tiles import tiles_of_box, tiles_of_mesh
from drgs.render.visible.trace_primary import trace_primary
from drgs.scene.camera import Camera
from drgs.scene.environment import Environment
from drgs.scene.mesh import TriangleMesh
from drgs.scene.posed_scene import PosedScene
from tests.render.closed_form_scenes import front_camera, on_device, sphere_mesh, sunny_sky, two_spheres

SETTINGS = RenderSettings(samples_per_pass=16, denoise="svgf", keep_light=True)
METAL = two_spheres(roughness=0.4, metallic=1.0)
LEFT_OUT = {PIXEL_MIDDLES, FEWER_RAYS, KEPT_LIGHT}


def scene_of(mesh: TriangleMesh = METAL) -> PosedScene:
    sky = sunny_sky(sun=20.0)
    return PosedScene(None, mesh, Environment(sky.radiance.to(mesh.vertices.device)))


def cameras(count: int, device: str = "cpu") -> list[Camera]:
    """That come nearer."""
    return [front_camera(48, distance=8 - 0.05 * k).to(device) for k in range(count)]


def moved_through(scene: PosedScene, path: list[Camera], settings: RenderSettings = SETTINGS) -> FrameState:
    state = None
    for camera in path:
        state = refine_frame(start_frame(scene, camera, settings, previous=state))
    assert state is not None
    return state


def assert_same_sums(a: FrameState, b: FrameState) -> None:
    for name, sums in vars(a.sums).items():
        assert sums is None or torch.equal(getattr(b.sums, name), sums), name


def bumpy_metal() -> TriangleMesh:
    """Normals that turn within a pixel, as those of built assets do."""
    mesh = sphere_mesh(5, roughness=0.3, metallic=1.0)
    turned = mesh.normals + 0.1 * torch.randn(mesh.normals.shape, generator=torch.Generator().manual_seed(1))
    return dataclasses.replace(mesh, normals=torch.nn.functional.normalize(turned, dim=-1))


def error(shown: Frame, truth: Frame) -> float:
    inside = (truth.gbuffer.coverage == 1) & (shown.gbuffer.coverage == 1)
    difference = (shown.radiance_linear - truth.radiance_linear)[inside].square()
    return float((difference / (truth.radiance_linear[inside].square() + 1e-2)).mean())


@pytest.mark.slow
def test_a_moving_picture_of_metal_errs_less_with_a_quarter_of_its_rays(device: str) -> None:
    scene, path = scene_of(on_device(bumpy_metal(), device)), cameras(8, device)
    moving, traced = (resolve_frame(moved_through(scene, path, dataclasses.replace(SETTINGS, keep_light=keep))) for keep in (True, False))
    truth = resolve_frame(refine_frame(start_frame(scene, path[-1], RenderSettings(samples_per_pass=16, seed=5)), 64))
    assert moving.metadata["samples"] == 4 and traced.metadata["samples"] == 16
    assert error(moving, truth) < error(traced, truth)


def test_what_a_moving_picture_leaves_out_is_named_and_a_first_picture_leaves_nothing() -> None:
    scene, path = scene_of(), cameras(3)
    first, moving = moved_through(scene, path[:1]), moved_through(scene, path)
    assert not first.is_quick and not LEFT_OUT & set(first.plan.skips)
    assert moving.is_quick and LEFT_OUT & set(moving.plan.skips) == {PIXEL_MIDDLES, FEWER_RAYS}
    named = [skip["what"] for skip in resolve_frame(moving).metadata["skipped"]]
    assert PIXEL_MIDDLES.what in named and FEWER_RAYS.what in named
    few = moved_through(scene, path, dataclasses.replace(SETTINGS, samples_per_pass=4))
    assert few.is_quick and LEFT_OUT & set(few.plan.skips) == {PIXEL_MIDDLES}


def test_a_moving_picture_sees_what_lies_in_the_middle_of_each_pixel() -> None:
    scene, path = scene_of(), cameras(3)
    shown, middles = resolve_frame(moved_through(scene, path)).gbuffer, trace_primary(scene.mesh, path[-1])
    for name, values in vars(middles).items():  # rays that Embree takes together and single ones differ in the last bits of a place
        torch.testing.assert_close(getattr(shown, name), values, rtol=1e-6, atol=1e-6)


def test_a_picture_at_rest_holds_nothing_of_the_moving_one() -> None:
    """Its sums are, to the bit, those of a frame that was begun there."""
    scene, path = scene_of(), cameras(4)
    moving, fresh = moved_through(scene, path), refine_frame(start_frame(scene, path[-1], SETTINGS), 3)
    rested = refine_frame(refine_frame(moving), 2)
    assert rested.passes == 3 and not rested.is_quick and not LEFT_OUT & set(rested.plan.skips)
    assert_same_sums(fresh, rested)
    # What the moving picture showed is worth something until the frame has samples of its own.
    assert rested.reprojected is not None and float(rested.reprojected.samples.max()) > 0


def test_an_edit_of_what_a_moving_picture_shows_is_traced_with_all_rays() -> None:
    scene, path = scene_of(), cameras(3)
    edited = dataclasses.replace(scene, mesh=dataclasses.replace(scene.mesh, albedo=0.5 * scene.mesh.albedo))
    for changed in (edited, dataclasses.replace(scene, environment_rotation_degrees=40.0)):
        state = refine_frame(start_frame(changed, path[-1], SETTINGS, previous=moved_through(scene, path)))
        assert not state.is_quick and not LEFT_OUT & set(state.plan.skips)
        assert_same_sums(refine_frame(start_frame(changed, path[-1], SETTINGS)), state)


def test_a_moving_picture_goes_on_being_one_where_only_its_exposure_changes() -> None:
    scene, path = scene_of(), cameras(3)
    moving = moved_through(scene, path)
    brighter = start_frame(scene, path[-1], dataclasses.replace(SETTINGS, exposure=1.0), previous=moving)
    assert brighter.is_quick and brighter.samples == 4
    assert_same_sums(moving, brighter)


@pytest.mark.parametrize("change", [{"skip": False}, {"denoise": "none"}, {"split_indirect": True}, {"counts": SampleCounts(8, 4, 4)}])
def test_without_skips_and_where_all_rays_are_wanted_no_picture_is_a_moving_one(change: dict) -> None:
    scene, path, settings = scene_of(), cameras(3), dataclasses.replace(SETTINGS, **change)
    state, without = (moved_through(scene, path, dataclasses.replace(settings, keep_light=keep)) for keep in (True, False))
    assert not state.is_quick and not LEFT_OUT & set(state.plan.skips)
    assert_same_sums(without, state)


@pytest.mark.parametrize("with_kept", [False, True])
def test_a_moving_picture_is_put_together_as_pictures_at_rest_are(with_kept: bool, device: str) -> None:
    mesh, (before, now) = on_device(two_spheres(metallic=0.3), device), (front_camera(48, distance=d).to(device) for d in (8.0, 7.9))
    tracer = build_tracer(mesh)
    old, middles = (see_middles(tracer, camera, tiles_of_box(mesh, camera)) for camera in (before, now))
    count, numbers = len(middles.primary.depth), torch.Generator().manual_seed(3)

    def random(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=numbers).to(device)

    found = ShadedPoints(random(count, 3), random(count, 3), random(count, 3), random(count))
    kept = torch.where(random(count) < 0.5, 40.0, 0.0) if with_kept else None
    size = old.surface.coverage.shape
    light = DemodulatedLight(random(*size, 3), random(*size, 3), random(*size, 2))
    history = History(old.window.camera(before), old.surface, light, 30 * random(*size, 2))
    camera = middles.window.camera(now)
    picture = quick_picture(middles.surface, middles.place, found, kept, 8, camera, history)

    covered = middles.surface.coverage > 0

    def on_map(values: torch.Tensor) -> torch.Tensor:
        spread = values.new_zeros(*covered.shape, *values.shape[1:])
        spread[covered] = values
        return spread

    own = torch.full((count, 2), 8.0, device=device)
    own[:, 0] = own[:, 0] if kept is None else torch.where(kept > 0, kept, own[:, 0])
    own, looked_up = on_map(own), reproject(history, middles.surface, camera)
    variances = [on_map(found.variance[:, k]) for k in range(3)]
    mean = Radiance(on_map(found.diffuse), on_map(found.specular), variances[0], on_map(found.visibility), 8, *variances[1:])
    blend_history(mean, looked_up, middles.surface, own)
    wanted = remember(mean, middles.surface, camera, own, looked_up)
    assert float(looked_up.samples[covered].mean()) > 5
    for name, values in vars(wanted.light).items():
        torch.testing.assert_close(getattr(picture.history.light, name)[covered], values[covered], rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(picture.history.samples[covered], wanted.samples[covered])
    torch.testing.assert_close(picture.visibility, mean.visibility)
    assert (picture.kept_samples is None) == (kept is None)
    if kept is not None and picture.kept_samples is not None:
        assert torch.equal(picture.kept_samples, on_map(kept))
    # Without a picture before, it is what its own rays found.
    alone = quick_picture(middles.surface, middles.place, found, kept, 8, camera, None)
    torch.testing.assert_close(alone.history.samples[covered], own[covered])
    shown = quick_radiance(alone, alone.history.light, 8)
    torch.testing.assert_close(shown.diffuse[covered], found.diffuse, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(shown.specular[covered], found.specular, rtol=1e-4, atol=1e-5)
    assert shown.diffuse_variance is not None
    torch.testing.assert_close(shown.diffuse_variance[covered], found.variance[:, 1], rtol=1e-4, atol=1e-5)


def test_a_moving_picture_under_a_light_of_another_strength_shows_the_same_brighter() -> None:
    scene, path = scene_of(), cameras(3)
    moving = moved_through(scene, path)
    brighter = start_frame(dataclasses.replace(scene, environment_intensity=3.0), path[-1], SETTINGS, previous=moving)
    assert brighter.is_quick
    shown, before = resolve_frame(brighter), resolve_frame(moving)
    torch.testing.assert_close(shown.radiance_linear, 3 * before.radiance_linear, rtol=1e-3, atol=1e-5)


def test_after_a_moving_picture_all_tiles_are_looked_at_that_may_show_something() -> None:
    """It knew them by its rays through middles; at rest rays go through all of a pixel."""
    scene, path = scene_of(), cameras(3)
    moving, wanted = moved_through(scene, path), tiles_of_mesh(scene.mesh, path[-1])
    assert torch.equal(refine_frame(moving).tiles.covered, wanted) and not bool((moving.tiles.covered & ~wanted).any())
    turned = dataclasses.replace(scene, environment_rotation_degrees=40.0)
    assert torch.equal(start_frame(turned, path[-1], SETTINGS, previous=moving).tiles.covered, wanted)


def test_a_quarter_of_the_rays_is_of_all_strategies_that_had_any() -> None:
    assert moving_counts(SampleCounts(16, 8, 8)) == SampleCounts(4, 2, 2)
    assert moving_counts(SampleCounts(0, 24, 8)) == SampleCounts(0, 6, 2)
    assert moving_counts(SampleCounts(24, 8, 0)) == SampleCounts(6, 2, 0)
    assert moving_counts(SampleCounts(2, 1, 1)) == SampleCounts(2, 1, 1)
    assert moving_counts(SampleCounts(4, 2, 2)) == SampleCounts(2, 1, 1)
    assert moving_counts(SampleCounts(1, 1, 0)) == SampleCounts(1, 1, 0)
    assert moving_counts(SampleCounts(0, 0, 0)).total == 0
