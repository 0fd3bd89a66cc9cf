"""A film's camera: through its views at their times, around what it looks at, never jerking; and as the page previews it."""

import json
from pathlib import Path

import numpy as np
import pytest

from drgs_worker.jobs.camera_path import path_views
from drgs_worker.jobs.requests import CameraKeyframe, CameraPath, path_frames

FIXTURES = Path(__file__).parents[2] / "web" / "tests" / "stage" / "camera"
"""Keyframes and the cameras between them; vitest holds the page's twin to the same files."""


def path_of(*keyframes: tuple) -> CameraPath:
    """Of (eye, target, seconds)."""
    return CameraPath(keyframes=[CameraKeyframe(eye=eye, target=target, seconds=seconds) for eye, target, seconds in keyframes])


def eyes(path: CameraPath, fps: float) -> np.ndarray:
    return np.stack([matrix[:3, 3] for matrix, _ in path_views(path, fps)])


UP, SIDE, TURN = ((0, -3, 1), (0, 0, 0.5), 1), ((2, 0, 2), (0, 0, 0.5), 1), ((0, 4, 0), (0.5, 0, 0), 2)


def test_every_view_is_passed_at_its_time_with_z_up_and_its_target_straight_ahead() -> None:
    path = path_of(UP, SIDE, TURN)
    views = path_views(path, 4)
    assert len(views) == path_frames(path, 4) == 13
    for index, keyframe in zip((0, 4, 12), path.keyframes, strict=True):
        matrix, fov = views[index]
        np.testing.assert_allclose(matrix[:3, 3], keyframe.eye, atol=1e-9)
        ahead = np.subtract(keyframe.target, keyframe.eye)
        np.testing.assert_allclose(-matrix[:3, 2], ahead / np.linalg.norm(ahead), atol=1e-9)
        assert matrix[2, 0] == 0 and matrix[2, 1] > 0 and fov == 40
    for matrix, _ in views:
        np.testing.assert_allclose(matrix[:3, :3] @ matrix[:3, :3].T, np.eye(3), atol=1e-12)
        assert np.linalg.det(matrix[:3, :3]) == pytest.approx(1)


def test_between_opposite_views_the_camera_goes_round_the_object_and_not_through_it() -> None:
    way = eyes(path_of(((3, 0, 0), (0, 0, 0), 1), ((-3, 0, 0), (0, 0, 0), 2)), 10)
    np.testing.assert_allclose(np.linalg.norm(way, axis=1), 3)
    np.testing.assert_allclose(way[10], [0, 3, 0], atol=1e-9)  # counter-clockwise


def test_the_shorter_way_is_taken_across_the_seam_of_the_azimuth() -> None:
    angles = np.radians([170, -170, 160])
    way = eyes(path_of(*(((np.cos(a), np.sin(a), 0), (0, 0, 0), 1) for a in angles)), 8)
    assert way[:, 0].max() < -0.9


def test_the_camera_rests_at_both_ends_and_never_jerks() -> None:
    way = eyes(path_of(UP, SIDE, TURN), 400)
    speed = np.linalg.norm(np.diff(way, axis=0), axis=1) * 400
    assert speed[0] < 0.05 and speed[-1] < 0.05 and speed.max() > 2
    assert np.abs(np.diff(speed)).max() < 0.02 * speed.max(), "speed changes by degrees"


def test_a_view_that_is_held_stands_still_and_none_is_overshot() -> None:
    low, high = ((0, -2, 0), (0, 0, 0), 1), ((0, -2, 2), (0, 0, 0), 0.5)
    way = eyes(path_of(low, high, high, low), 100)
    held = way[50:101]
    assert np.ptp(held, axis=0).max() < 1e-9
    assert way[:, 2].max() < 2 + 1e-9 and way[:, 2].min() > -1e-9


def closed_path(*keyframes: tuple) -> CameraPath:
    return path_of(*keyframes).model_copy(update={"closed": True})


def test_a_closed_path_comes_back_to_its_first_view_which_it_shows_once() -> None:
    path = closed_path(UP, SIDE, TURN)
    way = eyes(path, 4)
    assert len(way) == path_frames(path, 4) == 16, "four seconds, one of them back to the first view"
    for index, keyframe in zip((0, 4, 12), path.keyframes, strict=True):
        np.testing.assert_allclose(way[index], keyframe.eye, atol=1e-9)


def test_a_closed_path_goes_through_its_seam_as_through_any_view() -> None:
    """Four views a quarter of a turn apart, a second each: a circle at one speed, seam included."""
    corners = [((3 * np.cos(a), 3 * np.sin(a), 1), (0, 0, 1), 1) for a in np.radians([0, 90, 180, 270])]
    way = eyes(closed_path(*corners), 50)
    once_more = np.concatenate([way, way[:2]])
    speed = np.linalg.norm(np.diff(once_more, axis=0), axis=1) * 50
    assert len(way) == 200
    np.testing.assert_allclose(speed, 3 * np.pi / 2, rtol=1e-3)


def test_a_closed_path_of_two_views_goes_there_and_back() -> None:
    way = eyes(closed_path(((0, -2, 0), (0, 0, 0), 1), ((0, -2, 2), (0, 0, 0), 1)), 10)
    assert len(way) == 20
    np.testing.assert_allclose(way[1:10], way[11:][::-1], atol=1e-9)


@pytest.mark.parametrize("name", ["camera_path.json", "camera_path_closed.json"])
def test_the_numbers_are_those_that_the_page_previews(name: str) -> None:
    stored = json.loads((FIXTURES / name).read_text())
    views = path_views(CameraPath(keyframes=stored["keyframes"], closed=stored.get("closed", False)), stored["fps"])
    assert len(views) == len(stored["views"]) > 10
    for (matrix, fov), wanted in zip(views, stored["views"], strict=True):
        np.testing.assert_allclose(matrix, wanted["world_from_camera"], atol=1e-9)
        assert fov == pytest.approx(wanted["fov_y_degrees"], abs=1e-9)
