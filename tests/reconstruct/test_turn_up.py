"""A capture's world is turned so that what was said points up; what cameras see stays what it is."""

from pathlib import Path

import numpy as np
import pytest
import torch

from drgs.reconstruct.build_asset import BuildSettings, build_asset
from drgs.reconstruct.capture.load_views import read_capture
from drgs.reconstruct.capture.open_capture import open_capture
from drgs.reconstruct.capture.turn_up import UP, rotation_to_up, turn_up, up_of_cameras
from drgs.scene.camera import opengl_from_camera
from tests.reconstruct.tiny_capture import SPHERE_CENTER, write_colmap, write_nerf_synthetic

DIRECTIONS = [(0, 0, 1), (0, 0, -1), (0, 1, 0), (-1, 0, 0), (0.3, -0.5, 0.2), (1e-7, 0, -1), (1e-4, 1e-4, -1), (0, 0, 5)]


@pytest.mark.parametrize("up", DIRECTIONS)
def test_the_direction_becomes_up_by_a_rotation(up: tuple[float, float, float]) -> None:
    rotation = rotation_to_up(up)
    assert rotation @ np.array(up) == pytest.approx(np.array([0, 0, np.linalg.norm(up)]), abs=1e-12)
    assert rotation @ rotation.T == pytest.approx(np.eye(3), abs=1e-12) and np.linalg.det(rotation) == pytest.approx(1)
    # The smallest one turns by the angle between the two.
    assert np.trace(rotation) == pytest.approx(1 + 2 * up[2] / np.linalg.norm(up), abs=1e-6)


@pytest.mark.parametrize("up", [(0.0, 0.0, 0.0), (float("nan"), 0.0, 1.0), (0.0, float("inf"), 1.0), (0.0, 1e-9, 0.0)])
def test_what_is_no_direction_is_refused(up: tuple[float, float, float]) -> None:
    with pytest.raises(ValueError, match="is no direction"):
        rotation_to_up(up)
    with pytest.raises(ValueError, match="is no direction"):
        build_asset(Path("none"), Path("none"), BuildSettings(up=up))


def test_pixels_see_the_same_points_of_the_turned_world(tmp_path: Path) -> None:
    capture = read_capture(write_colmap(tmp_path / "capture", binary=True))
    turned = turn_up(capture, (0.3, -0.5, 0.2))
    rotation = rotation_to_up((0.3, -0.5, 0.2))
    assert capture.points_world is not None and turned.points_world is not None
    for before, after in zip(capture.photographs, turned.photographs, strict=True):
        seen, still = (
            photograph.camera_from_world[:3, :3] @ point + photograph.camera_from_world[:3, 3]
            for photograph, point in ((before, SPHERE_CENTER), (after, rotation @ SPHERE_CENTER))
        )
        assert still == pytest.approx(seen, abs=1e-9)
    assert turned.points_world == pytest.approx(capture.points_world @ rotation.T, abs=1e-5)
    assert turn_up(capture, UP) is capture


def test_cameras_that_are_held_level_tell_which_way_is_up(tmp_path: Path) -> None:
    folder = write_nerf_synthetic(tmp_path / "capture")
    _, views, _ = open_capture(folder, None, 100, 0, (0.0, 1.0, 0.0))
    poses = np.stack([opengl_from_camera(camera).numpy() for camera in views.cameras])
    # They were level before, with z up; that is now where the turn took it.
    assert up_of_cameras(poses) == pytest.approx(rotation_to_up((0.0, 1.0, 0.0)) @ [0, 0, 1], abs=0.2)


@pytest.mark.slow
def test_the_hull_of_a_turned_capture_is_turned(tmp_path: Path) -> None:
    folder = write_nerf_synthetic(tmp_path / "capture")
    plain, turned = (open_capture(folder, None, 500, 0, up)[2].bounds_center for up in (UP, (1.0, 0.0, 0.0)))
    assert torch.allclose(turned, torch.from_numpy(rotation_to_up((1.0, 0.0, 0.0))).float() @ plain, atol=0.02)
