"""Each channel shows what its name says, on scenes where that is known."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from drgs.maths.color import srgb_from_linear
from drgs.reconstruct.geometry.bind_gaussians import bind_gaussians
from drgs.render.film.resolve_frame import resolve_frame
from drgs.scene.asset import Asset
from drgs.scene.certainty import Certainty
from drgs.scene.edits import parse_edits
from drgs.scene.environment import Environment
from drgs.scene.mesh import TriangleMesh
from drgs.scene.posed_scene import PrimarySurface
from drgs_server.live.messages import LEAST_SHOWN_ERROR, NO_CERTAINTY, CameraMessage, Channel, Settings
from drgs_server.render.channels import HEAT_SRGB, heat
from drgs_server.render.drgs_renderer import LoadedAsset, Picture, Pose
from drgs_server.render.interface import AbstractPicture
from drgs_server.render.surfel_picture import NO_SURFELS
from tests.reconstruct.surfel_spheres import surfel_sphere
from tests.render.closed_form_scenes import constant_sky, mesh_of, sphere_mesh, sunny_sky, two_spheres

SIDE = 32
FRONT = ((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, -1.0, -6.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
"""Looks along +y at the origin."""


def posed(mesh: TriangleMesh, sky: Environment | None = None, **parts: object) -> Pose:
    asset = Asset(None, mesh, None, sky or constant_sky(), **parts)  # type: ignore[arg-type]
    return LoadedAsset(asset, Path("none")).pose([], None)


def picture_of(pose: Pose, channel: Channel, previous: AbstractPicture | None = None, camera=FRONT, fov: float = 40, **settings):
    message = CameraMessage(type="camera", world_from_camera=camera, fov_y_degrees=fov, width=SIDE, height=SIDE)
    picture = pose.begin(message, Settings(channel=channel, **settings), SIDE, SIDE, previous)
    while picture.samples < picture.samples_target:
        picture.refine()
    return picture


def seen(picture: AbstractPicture) -> np.ndarray:
    """(n, 3) colours of the pixels that the object covers wholly."""
    pixels = picture.resolve()
    return pixels[pixels[..., 3] == 255][:, :3].astype(float)


def test_a_ball_in_the_open_sees_all_of_the_sky_even_a_black_one_and_two_balls_hide_some_of_it() -> None:
    black_below = constant_sky()
    black_below.radiance[8:] = 0
    assert seen(picture_of(posed(sphere_mesh(), black_below), "visibility", spp_target=16)).min() == 255
    pair = seen(picture_of(posed(two_spheres()), "visibility", spp_target=64))
    assert pair.min() < 200 and pair.max() == 255


def test_the_floor_before_a_wall_sees_as_much_sky_as_its_form_factor_leaves() -> None:
    floor = trimesh.Trimesh([[-60, -60, 0], [60, -60, 0], [60, 0, 0], [-60, 0, 0]], [[0, 1, 2], [0, 2, 3]])
    wall = trimesh.Trimesh([[-60, 0, 0], [60, 0, 0], [60, 0, 2], [-60, 0, 2]], [[0, 1, 2], [0, 2, 3]])
    pose = posed(mesh_of(trimesh.util.concatenate([floor, wall]), 0.5, 0.5, 0.0), sunny_sky())
    distance, height = 0.5, 2.0
    above = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, -distance), (0.0, 0.0, 1.0, 1.5), (0.0, 0.0, 0.0, 1.0))
    values = seen(picture_of(pose, "visibility", camera=above, fov=1.0, spp_target=256))
    hidden = 0.5 * (1 - distance / math.hypot(distance, height))
    assert values.mean() / 255 == pytest.approx(1 - hidden, abs=0.01)


def test_a_ball_alone_has_no_indirect_light_and_between_two_it_is_what_bounces_add() -> None:
    assert seen(picture_of(posed(sphere_mesh(), sunny_sky()), "indirect", spp_target=16, bounces=2, denoise=False)).max() == 0
    pose, light = posed(two_spheres(), sunny_sky()), {"denoise": False, "spp_target": 16}  # four passes: the same rays for all three
    indirect = picture_of(pose, "indirect", **light)
    assert isinstance(indirect, Picture) and indirect.samples == 16
    whole, direct = (resolve_frame(picture_of(pose, "final", bounces=bounces, **light).state).radiance_linear for bounces in (1, 0))
    added = srgb_from_linear((whole - direct).clamp(0, 1)).numpy()
    shown = indirect.resolve()
    covered = shown[..., 3] == 255
    assert float((whole - direct).min()) > -1e-5 and np.abs(shown[covered][:, :3] / 255 - added[covered]).max() < 0.005
    assert seen(indirect).max() > 60
    # With no bounces set the channel still shows one: nothing else would be seen of it.
    assert seen(picture_of(posed(two_spheres()), "indirect", spp_target=16, bounces=0)).max() > 20


def test_the_noise_that_is_shown_falls_as_samples_add_up() -> None:
    pose = posed(two_spheres(), sunny_sky())
    errors = []
    for samples in (16, 256):
        picture = picture_of(pose, "variance", spp_target=samples)
        colors = torch.tensor(seen(picture)) / 255
        scale = heat(10.0 ** torch.linspace(-3, 0, 400))
        place = (colors[:, None] - scale).square().sum(-1).argmin(-1).double() / 399
        errors.append(float((10 ** (3 * place - 3)).mean()))
    assert errors[1] < 0.4 * errors[0] and errors[0] > 2 * LEAST_SHOWN_ERROR


def test_errors_become_colours_that_grow_brighter_from_end_to_end_of_the_scale() -> None:
    ends = heat(torch.tensor([0.0, LEAST_SHOWN_ERROR, 1.0, 50.0])) * 255
    assert torch.allclose(ends, torch.tensor([HEAT_SRGB[0], HEAT_SRGB[0], HEAT_SRGB[-1], HEAT_SRGB[-1]]).float(), atol=1e-3)
    brightness = heat(10.0 ** torch.linspace(-3, 0, 50)) @ torch.tensor([0.2126, 0.7152, 0.0722])
    assert bool((brightness.diff() > 0).all())


def test_surfels_are_shown_in_many_colours_and_the_next_picture_goes_on_with_the_one_before() -> None:
    asset = Asset(surfel_sphere(300), sphere_mesh(), None, constant_sky())
    pose = LoadedAsset(asset, Path("none")).pose([], None)
    final = picture_of(pose, "final", spp_target=16)
    surfels = picture_of(pose, "surfels", final)
    hues = {tuple(color) for color in (seen(surfels) // 64).tolist()}
    assert len(hues) > 8, "grey plastic has one colour"
    picked = surfels.pick(0.5, 0.5)
    assert picked is not None and picked.position[1] == pytest.approx(-1, abs=0.15) and surfels.pick(0.01, 0.01) is None
    again = pose.begin(
        CameraMessage(type="camera", world_from_camera=FRONT, fov_y_degrees=40, width=SIDE, height=SIDE),
        Settings(channel="final", spp_target=16), SIDE, SIDE, surfels,
    )  # fmt: skip
    assert isinstance(again, Picture) and again.samples == final.samples


def test_a_mesh_has_no_surfels_and_says_so() -> None:
    picture = picture_of(posed(sphere_mesh()), "surfels")
    assert picture.resolve().max() == 0 and picture.notes == (NO_SURFELS,)


def half_known(count: int) -> Certainty:
    """Shape known, albedo half, roughness well and metallic hardly."""
    return Certainty(*(torch.full((count,), value, dtype=torch.float16) for value in (1.0, 0.5, 0.75, 0.25)))


@pytest.mark.parametrize("primary", ["mesh", "gaussians"])
def test_certainty_is_shown_in_red_green_and_blue_and_a_pick_still_finds_the_paint(primary: PrimarySurface) -> None:
    mesh, surfels = sphere_mesh(), surfel_sphere(300)
    binding = bind_gaussians(surfels.centers, mesh)
    asset = Asset(surfels, mesh, binding, constant_sky(), primary=primary, certainty=half_known(len(mesh.vertices)))
    pose = LoadedAsset(asset, Path("none")).pose([], None)
    albedo = picture_of(pose, "albedo")
    picture = picture_of(pose, "certainty", albedo)
    np.testing.assert_allclose(seen(picture), np.broadcast_to([255, 127.5, 63.75], seen(picture).shape), atol=1)
    values = picture.linear()
    np.testing.assert_allclose(
        values[picture.resolve()[..., 3] == 255][:, :3], np.broadcast_to([1, 0.5, 0.25], seen(picture).shape), atol=2e-3
    )
    painted, picked = albedo.pick(0.5, 0.5), picture.pick(0.5, 0.5)
    assert painted is not None and picked is not None
    assert picked.albedo == pytest.approx(painted.albedo, abs=1e-3) and picked.roughness == pytest.approx(painted.roughness, abs=1e-3)
    np.testing.assert_array_equal(picture_of(pose, "albedo", picture).resolve(), albedo.resolve())


def test_certainty_is_of_the_place_and_moves_with_it() -> None:
    mesh = sphere_mesh()
    low = (mesh.vertices[:, 2] < 0).half()
    asset = Asset(None, mesh, None, constant_sky(), certainty=Certainty(low, low, low, low))
    twisted = parse_edits([{"op": "deform", "map": {"type": "stretch", "factor": 1.2}}])
    for edits in ([], twisted):
        shown = picture_of(LoadedAsset(asset, Path("none")).pose(edits, None), "certainty").resolve()
        assert shown[SIDE // 2 - 6, SIDE // 2, :3].max() == 0 and shown[SIDE // 2 + 6, SIDE // 2, :3].min() == 255


def test_an_asset_without_certainty_says_so_and_shows_nothing() -> None:
    pose = posed(sphere_mesh())
    picture = picture_of(pose, "certainty")
    assert picture.resolve().max() == 0 and picture.notes == (NO_CERTAINTY,)
    message = CameraMessage(type="camera", world_from_camera=FRONT, fov_y_degrees=40, width=SIDE, height=SIDE)
    with pytest.raises(ValueError, match="does not say what is certain"):
        pose.still(message, Settings(channel="certainty"), SIDE, SIDE, linear=False)


@pytest.mark.parametrize(
    ("change", "computed"),
    [
        ({"exposure_stops": 1.0, "tone_curve": "agx", "background": "transparent"}, ()),
        ({"spp_target": 64, "denoise": False}, ()),
        ({"channel": "variance"}, ()),
        ({"channel": "indirect"}, ("sums",)),
        ({"bounces": 2}, ("view", "materials", "plan", "first_rays", "sums")),
        ({"channel": "albedo"}, ("view", "materials", "plan", "first_rays", "sums")),
        ({"channel": "visibility"}, ("view", "materials", "environment_table", "light", "plan", "first_rays", "sums")),
    ],
    ids=lambda value: "+".join(value) if isinstance(value, dict) else "",
)
def test_a_change_of_settings_computes_what_the_renderers_table_says_and_nothing_else(change: dict, computed: tuple[str, ...]) -> None:
    pose = posed(two_spheres(), sunny_sky())
    final = picture_of(pose, "final", spp_target=16)
    message = CameraMessage(type="camera", number=7, world_from_camera=FRONT, fov_y_degrees=40, width=SIDE, height=SIDE)
    after = pose.begin(message, Settings(**{"channel": "final", "spp_target": 16, **change}), SIDE, SIDE, final)
    assert isinstance(after, Picture) and after.state.computed_parts == computed
    assert after.samples == (0 if "sums" in computed else final.samples)


def test_a_picture_of_a_moving_camera_shows_kept_light_and_is_never_the_last() -> None:
    pose, picture, camera = posed(two_spheres(), sunny_sky()), None, FRONT
    for step in range(12):
        camera = (*FRONT[:1], (0.0, 0.0, -1.0, -6.0 + 0.02 * step), *FRONT[2:])
        message = CameraMessage(type="camera", world_from_camera=camera, fov_y_degrees=40, width=SIDE, height=SIDE)
        picture = pose.begin(message, Settings(spp_target=4), SIDE, SIDE, picture)
        picture.refine()
    assert isinstance(picture, Picture) and picture.state.kept_samples is not None and bool(picture.state.kept_samples.any())
    assert any("kept on the mesh" in note for note in picture.notes)
    assert any("kept on the mesh" in why for _, why, _ in picture.explain().skipped)
    assert picture.samples < picture.samples_target == 4  # so whoever shows it goes on
    picture.refine()
    fresh = picture_of(pose, "final", camera=camera, spp_target=4)
    assert isinstance(fresh, Picture) and picture.samples == 4 and not any("kept on the mesh" in note for note in picture.notes)
    assert torch.equal(picture.state.sums.diffuse, fresh.state.sums.diffuse)
