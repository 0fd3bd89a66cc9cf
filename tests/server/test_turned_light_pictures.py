"""Light that stood still with the camera of the photographs turns with the viewer's, where it is asked for, and no other light does."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from drgs.scene.asset import Asset
from drgs.scene.camera import camera_from_opengl
from drgs.scene.edits import parse_edits
from drgs.scene.environment import Environment
from drgs_server.render.drgs_renderer import LoadedAsset, Picture
from tests.render.closed_form_scenes import constant_sky, sphere_mesh
from tests.server.test_channels import FRONT, picture_of

ABOVE = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 6.0), (0.0, 0.0, 0.0, 1.0))


def lamp_asset() -> Asset:
    """A ball, photographed first from the front, under a lamp."""
    sky = Environment(torch.full((16, 32, 3), 0.1))
    sky.radiance[3:6, 20:26] = 6.0
    first = camera_from_opengl(torch.tensor(FRONT, dtype=torch.float64), torch.eye(3), 8, 8, "first")
    return Asset(None, sphere_mesh(subdivisions=5), None, sky, cameras=(first,), light_frame="camera")


def pictures(asset: Asset, turn_light: bool, edits: list[dict] | None = None) -> list[np.ndarray]:
    """From the front and from above."""
    pose = LoadedAsset(asset, Path("none")).pose(parse_edits(edits or []), None)
    settings = {"turn_light": turn_light, "spp_target": 64, "background": "transparent"}
    return [picture_of(pose, "final", camera=camera, **settings).resolve()[..., :3].astype(float) for camera in (FRONT, ABOVE)]


def test_a_ball_looks_the_same_from_everywhere_under_light_that_turns_and_not_under_light_that_stands_still() -> None:
    front, above = pictures(lamp_asset(), True)
    front_still, above_still = pictures(lamp_asset(), False)
    assert np.abs(front - above).mean() < 1.5
    assert np.abs(front_still - above_still).mean() > 5
    assert np.abs(front - front_still).mean() < 1.5  # upright before the first camera


def test_light_that_stood_still_with_the_object_does_not_turn() -> None:
    asset = replace(lamp_asset(), light_frame="object")
    for asked, still in zip(pictures(asset, True), pictures(asset, False), strict=True):
        np.testing.assert_array_equal(asked, still)
    assert LoadedAsset(asset, Path("none")).light_camera is None


def test_a_turn_of_the_light_comes_before_that_of_the_camera() -> None:
    front, above = pictures(lamp_asset(), True, [{"op": "environment", "rotation": 60}])
    plain, _ = pictures(lamp_asset(), True)
    assert np.abs(front - plain).mean() > 5
    _, turned_still = pictures(lamp_asset(), False, [{"op": "environment", "rotation": 60}])
    assert np.abs(above - turned_still).mean() > 5


def test_while_the_camera_rests_a_picture_goes_on_and_hello_says_before_which_camera_the_light_is_upright() -> None:
    loaded = LoadedAsset(lamp_asset(), Path("none"))
    pose = loaded.pose([], None)
    first = picture_of(pose, "final", turn_light=True, spp_target=16)
    again = picture_of(pose, "final", first, turn_light=True, spp_target=16, exposure_stops=1.0)
    assert isinstance(first, Picture) and isinstance(again, Picture)
    assert again.state.inputs.scene is first.state.inputs.scene and again.state.samples == first.state.samples
    assert loaded.light_camera is not None
    np.testing.assert_allclose(loaded.light_camera, np.array(FRONT)[:3, :3], atol=1e-6)


def test_under_another_light_nothing_turns(tmp_path: Path) -> None:
    from drgs.exchange.exr import encode_environment

    (tmp_path / "sky.exr").write_bytes(encode_environment(constant_sky().radiance.numpy()))
    pose = LoadedAsset(lamp_asset(), tmp_path).pose(parse_edits([{"op": "environment", "file": "sky.exr"}]), None)
    assert isinstance(picture := picture_of(pose, "final", turn_light=True, spp_target=4), Picture)
    assert picture.state.inputs.scene is pose.scene
