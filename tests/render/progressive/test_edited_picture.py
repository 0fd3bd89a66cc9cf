"""The first picture after an edit: half of its rays are left out and named, it errs no more than that costs, and the next picture knows nothing of it."""

import dataclasses

import pytest
import torch

from drgs.render.film.resolve_frame import resolve_frame
from drgs.render.integrate.plan import EVERY_OTHER
from drgs.render.progressive.edited_picture import EditedPoints
from drgs.render.progressive.frame_state import FrameState, MeshView
from drgs.render.progressive.neighbours import LEAST_COSINE, MOST_OFF_PLANE, MOST_UNLIKE
from drgs.render.progressive.refine import refine_frame
from drgs.render.progressive.start_frame import start_frame
from drgs.render.records import PrimaryPoints, RenderSettings, SampleCounts, ShadedPoints
from drgs.scene.environment import Environment
from drgs.scene.mesh import TriangleMesh
from drgs.scene.posed_scene import PosedScene
from tests.render.closed_form_scenes import front_camera, on_device, sunny_sky, two_spheres
from tests.render.progressive.test_quick_picture import assert_same_sums, error

SETTINGS = RenderSettings(samples_per_pass=4, denoise="svgf", keep_light=True)
CAMERA = front_camera(48, distance=8)


def scene_of(mesh: TriangleMesh | None = None) -> PosedScene:
    mesh = two_spheres(roughness=0.4, metallic=0.0) if mesh is None else mesh
    return PosedScene(None, mesh, Environment(sunny_sky(sun=20.0).radiance.to(mesh.vertices.device)))


def darker(scene: PosedScene, share: float = 0.5) -> PosedScene:
    return dataclasses.replace(scene, mesh=dataclasses.replace(scene.mesh, albedo=share * scene.mesh.albedo))


def edits_of(scene: PosedScene) -> list[PosedScene]:
    other = Environment(scene.environment.radiance.flip(1).contiguous())
    turned = dataclasses.replace(scene, environment_rotation_degrees=40.0)
    return [darker(scene), turned, dataclasses.replace(scene, environment=other)]


def at_rest(scene: PosedScene, settings: RenderSettings = SETTINGS) -> FrameState:
    return refine_frame(start_frame(scene, CAMERA.to(scene.mesh.vertices.device), settings), 6)


def after(scene: PosedScene, before: FrameState, settings: RenderSettings = SETTINGS) -> FrameState:
    return refine_frame(start_frame(scene, before.inputs.camera, settings, previous=before))


def test_what_it_leaves_out_is_named_and_the_next_picture_is_that_of_a_frame_begun_there() -> None:
    scene = scene_of()
    for edited in edits_of(scene):
        shown = after(edited, at_rest(scene))
        assert shown.is_quick and EVERY_OTHER in shown.plan.skips and shown.samples == 2
        assert EVERY_OTHER.what in [skip["what"] for skip in resolve_frame(shown).metadata["skipped"]]
        rested, fresh = refine_frame(shown, 3), refine_frame(start_frame(edited, CAMERA, SETTINGS), 3)
        assert not rested.is_quick and EVERY_OTHER not in rested.plan.skips and rested.passes == 3 and rested.reprojected is None
        assert_same_sums(fresh, rested)
        torch.testing.assert_close(resolve_frame(rested).rgba_srgb, resolve_frame(fresh).rgba_srgb, rtol=0, atol=0)


def test_edits_that_follow_each_other_are_each_shown_at_once() -> None:
    scene = scene_of()
    state = at_rest(scene)
    for share in (0.9, 0.6, 0.3):
        state = after(darker(scene, share), state)
        assert state.is_quick
        assert_same_sums(refine_frame(start_frame(darker(scene, share), CAMERA, SETTINGS), 2), refine_frame(state, 2))


@pytest.mark.parametrize(
    "change", [{"skip": False}, {"denoise": "none"}, {"split_indirect": True}, {"counts": SampleCounts(2, 1, 1)}, {"keep_light": False}]
)
def test_where_all_rays_are_wanted_they_are_traced(change: dict) -> None:
    scene, settings = scene_of(), dataclasses.replace(SETTINGS, **change)
    state = after(darker(scene), at_rest(scene, settings), settings)
    assert not state.is_quick and EVERY_OTHER not in state.plan.skips
    assert_same_sums(refine_frame(start_frame(darker(scene), CAMERA, settings)), state)


def test_a_moved_shape_and_several_passes_at_once_are_traced_with_all_rays() -> None:
    scene = scene_of()
    moved = dataclasses.replace(scene, mesh=dataclasses.replace(scene.mesh, vertices=scene.mesh.vertices + 0.01))
    assert not after(moved, at_rest(scene)).is_quick
    assert not refine_frame(start_frame(darker(scene), CAMERA, SETTINGS, previous=at_rest(scene)), 2).is_quick


@pytest.mark.parametrize("metallic", [0.0, 1.0])
def test_it_errs_no_more_than_half_of_the_rays_must(metallic: float, device: str) -> None:
    scene = scene_of(on_device(two_spheres(roughness=0.4, metallic=metallic), device))
    edited, before = darker(scene), at_rest(scene)
    half = resolve_frame(after(edited, before))
    whole = resolve_frame(after(edited, before, dataclasses.replace(SETTINGS, keep_light=False)))
    truth = resolve_frame(refine_frame(start_frame(edited, before.inputs.camera, RenderSettings(samples_per_pass=16, seed=5)), 64))
    assert half.metadata["samples"] == 2 and whole.metadata["samples"] == 4
    assert error(half, truth) < 1.5 * error(whole, truth), "half of the rays"


def made_light(points: PrimaryPoints) -> ShadedPoints:
    count, random = len(points.depth), torch.Generator().manual_seed(0)
    diffuse, specular, variance = (torch.rand(count, 3, generator=random) + 0.1 for _ in range(3))
    return ShadedPoints(diffuse, specular, variance, torch.rand(count, generator=random))


def test_pixels_between_take_the_mean_of_their_like_and_edges_have_rays_of_their_own() -> None:
    """Against a loop over pixels."""
    scene = scene_of()
    metallic = (scene.mesh.vertices[:, 0] > 0.2).float()  # a seam on a sphere
    state = at_rest(dataclasses.replace(scene, mesh=dataclasses.replace(scene.mesh, metallic=metallic)))
    assert isinstance(state.view, MeshView) and state.view.first_primary_points is not None
    primary, camera = state.view.first_primary_points, state.window.camera(state.inputs.camera)
    points, light, (rows, columns) = primary.points, made_light(primary), state.window.shape
    edited = EditedPoints(primary, state.window, camera)
    chosen, picture = set(edited.order.tolist()), edited.picture(light, 2)
    number = {(int(p) // 48 - state.window.rows.start, int(p) % 48 - state.window.columns.start): i for i, p in enumerate(points.pixel)}

    def alike(i: int, place: tuple[int, int]) -> bool:
        if (j := number.get(place)) is None:
            return False
        off = abs(float(points.normal_world[i] @ (points.position_world[j] - points.position_world[i])))
        unlike = max(abs(float(values[i] - values[j])) for values in (points.roughness, points.metallic))
        near = off <= float(MOST_OFF_PLANE) / float(camera.intrinsics[0, 0]) * float(primary.depth[i])
        return near and unlike <= float(MOST_UNLIKE) and float(points.normal_world[i] @ points.normal_world[j]) >= float(LEAST_COSINE)

    reflected = (
        (1 - points.metallic[:, None]) * points.albedo,
        points.metallic[:, None] * points.albedo + 0.04 * (1 - points.metallic[:, None]),
    )
    plain = [values / share.clamp(min=0.02) for values, share in zip((light.diffuse, light.specular), reflected, strict=True)]
    filled = 0
    for (y, x), i in number.items():
        row, column = y + state.window.rows.start, x + state.window.columns.start
        like = [number[place] for place in ((y - 1, x), (y + 1, x), (y, x - 1), (y, x + 1)) if alike(i, place)]
        assert (i in chosen) == ((row + column) % 2 == 0 or not like)
        sources = [i] if i in chosen else like
        filled += i not in chosen
        torch.testing.assert_close(picture.history.light.diffuse[y, x], plain[0][sources].mean(0))
        torch.testing.assert_close(picture.history.light.specular[y, x], plain[1][sources].mean(0))
        torch.testing.assert_close(picture.visibility[y, x], light.visibility[sources].mean())
        variance = light.variance[sources, 1] / reflected[0][sources].clamp(min=0.02).square().mean(-1)
        torch.testing.assert_close(picture.history.light.variance[y, x, 0], variance.sum() / len(sources) ** 2)
        torch.testing.assert_close(picture.history.gbuffer.albedo[y, x], points.albedo[i])
    own_edges = [i for i in chosen if (int(points.pixel[i]) // 48 + int(points.pixel[i]) % 48) % 2 == 1]
    assert 0.4 * len(number) < filled < 0.5 * len(number) and own_edges, "half of the pixels but for edges, of which there are some"
    assert float(picture.history.gbuffer.coverage.sum()) == len(number) and rows * columns > len(number)
