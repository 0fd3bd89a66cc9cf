"""Which way is up, from cameras that go around something and from the plane it stands on."""

import numpy as np
import pytest

from drgs.reconstruct.pose.upright_world import CAMERA_DISTANCE, upright_world
from tests.reconstruct.pose.textured_scene import orbit

TURN = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
TURN *= np.linalg.det(TURN)


def degrees_off(poses: np.ndarray, points: np.ndarray) -> tuple[float, str]:
    """Of up, for a world that was turned, moved and shrunk before."""
    found = poses.copy()
    found[:, :3, :3] = TURN @ poses[:, :3, :3]
    found[:, :3, 3] = 0.3 * poses[:, :3, 3] @ TURN.T + [5.0, -2.0, 1.0]
    similarity = upright_world(found, 0.3 * points @ TURN.T + [5.0, -2.0, 1.0], seed=0)
    moved = similarity.world_from_camera(found)
    assert np.linalg.norm(moved[:, :3, 3], axis=1).mean() == pytest.approx(CAMERA_DISTANCE, rel=0.05)
    assert abs(moved[0, 1, 3]) < 1e-9 and moved[0, 0, 3] > 0, "the first camera is on the side of +x"
    assert np.allclose(np.linalg.det(moved[:, :3, :3]), 1)
    return float(np.degrees(np.arccos(np.clip((similarity.rotation @ TURN)[2, 2], -1, 1)))), similarity.up_from


@pytest.fixture
def blob() -> np.ndarray:
    return np.random.default_rng(0).normal(size=(3000, 3)) * 0.5


def rolled(poses: np.ndarray, angle: float) -> np.ndarray:
    turn = np.eye(4)
    turn[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    return poses @ turn


def test_a_turntable_has_the_axis_that_the_cameras_circle(blob: np.ndarray):
    off, source = degrees_off(rolled(orbit(20), 0.3), blob)
    assert source == "circle" and off < 1e-3


def test_an_arc_at_several_heights_is_level(blob: np.ndarray):
    poses = np.concatenate([orbit(36, height)[:14] for height in (0.3, 1.5, 2.5)])
    off, source = degrees_off(poses, blob)
    assert source == "level cameras" and off < 1e-3


def test_the_plane_that_things_stand_on_refines_up(blob: np.ndarray):
    ground = np.column_stack([np.random.default_rng(1).uniform(-2, 2, (3000, 2)), np.full(3000, -1.0)])
    poses = rolled(np.concatenate([orbit(36, height)[:10] for height in (0.3, 1.5)]), 0.1)
    off, source = degrees_off(poses, np.concatenate([blob, ground]))
    assert source.endswith("plane of the points") and off < 0.5
    wall = np.roll(ground, 1, axis=1)
    assert degrees_off(poses, np.concatenate([blob, wall]))[1] == "level cameras", "a wall is no ground"


def test_cameras_side_by_side_look_at_the_points(blob: np.ndarray):
    poses = np.tile(orbit(1), (9, 1, 1))
    poses[:, :3, 3] += np.linspace(-0.5, 0.5, 9)[:, None] * poses[0, :3, 0]
    off, source = degrees_off(poses, blob)
    assert source == "mean of the cameras" and off < 35
