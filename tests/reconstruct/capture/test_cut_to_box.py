"""What lies outside the build's box is in no mask, on no hull and in no asset, and what it hides is not asked for."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from drgs.reconstruct.capture.build_box import BuildBox
from drgs.reconstruct.capture.cut_to_box import CutMask, chosen_views, cut_to_box, shown_views, views_of
from drgs.reconstruct.capture.initial_points import initial_points
from drgs.reconstruct.capture.load_views import load_views
from drgs.reconstruct.capture.load_views.checks import CaptureFault
from drgs.reconstruct.capture.open_capture import open_capture
from drgs.reconstruct.capture.visual_hull import visual_hull
from drgs.scene.camera import pixel_rays_world
from drgs.scene.views import Views
from tests.reconstruct.tiny_capture import SPHERE_CENTER, SPHERE_RADIUS, hits_sphere, write_nerf_synthetic

X, Y, Z = SPHERE_CENTER.tolist()
ALL = BuildBox((-2.0, -2.0, -2.0), (2.0, 2.0, 2.0))
ABOVE = BuildBox((-2.0, -2.0, Z), (2.0, 2.0, 2.0))
"""Holds the upper half of the ball."""


@pytest.fixture(scope="module")
def ball(tmp_path_factory: pytest.TempPathFactory) -> Views:
    return load_views(write_nerf_synthetic(tmp_path_factory.mktemp("ball")))


@pytest.mark.parametrize(
    ("low", "high"), [((0, 0, 0), (1, 1, 0)), ((0, 0, 0), (1, -1, 1)), ((0, 0, float("nan")), (1, 1, 1)), ((0, 0, 0), (1, 1, float("inf")))]
)
def test_corners_that_span_no_box_are_refused(low: tuple[float, float, float], high: tuple[float, float, float]) -> None:
    with pytest.raises(ValueError, match="expected two finite corners"):
        BuildBox(low, high)


def test_a_box_holds_its_sides_and_moves_others_to_them() -> None:
    box = BuildBox((0, 0, 0), (1, 2, 3))
    points = torch.tensor([[0.0, 2.0, 3.0], [0.5, 1.0, 3.1], [-1.0, 5.0, 1.0], [float("nan"), 1.0, 1.0]])
    assert box.holds(points).tolist() == [True, False, False, False]
    assert box.clamped(points[:3]).tolist() == [[0, 2, 3], [0.5, 1, 3], [0, 2, 1]]
    assert (box.center, box.longest_half, box.radius) == ((0.5, 1.0, 1.5), 1.5, pytest.approx(14**0.5 / 2))


@pytest.mark.slow
def test_a_hull_is_cut_flat(ball: Views) -> None:
    whole, half = visual_hull(ball), visual_hull(ball, box=ABOVE)
    assert whole is not None and half is not None
    assert half.vertices_world[:, 2].min() == np.float32(Z)
    assert half.vertices_world.max(0) == pytest.approx(whole.vertices_world.max(0), abs=2 * whole.cell)
    corners = half.vertices_world[half.faces].astype(float)
    volume = np.einsum("fi,fi->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6
    # Closed, and as large as half a ball; the hull of 24 views is a little larger than the ball.
    assert volume == pytest.approx(2 / 3 * np.pi * SPHERE_RADIUS**3, rel=0.12)
    assert visual_hull(ball, box=BuildBox((3, 3, 3), (4, 4, 4))) is None


@pytest.mark.slow
def test_masks_show_what_is_seen_in_the_box(ball: Views) -> None:
    cut = cut_to_box(ball, ABOVE)
    assert 8 <= len(cut.cameras) < len(ball.cameras), "from below, the lower half hides the upper"
    wrong = shown = 0
    for camera, coverage in zip(cut.cameras, cut.coverage, strict=True):
        origin, directions = pixel_rays_world(camera)
        distance = hits_sphere(origin.numpy(), directions.numpy())
        upper = np.nan_to_num(origin.numpy()[2] + distance * directions.numpy()[..., 2], nan=-9) > Z
        wrong += int(((coverage.numpy() > 127) != upper).sum())
        shown += int(upper.sum())
    assert wrong < 0.05 * shown


@pytest.mark.slow
def test_a_box_around_all_changes_nothing(ball: Views) -> None:
    cut = cut_to_box(ball, ALL)
    assert len(cut.cameras) == len(ball.cameras)
    assert all(torch.equal(before, after) for before, after in zip(ball.coverage, cut.coverage, strict=True))


def test_a_box_beside_the_object_is_refused_with_where_the_object_is(ball: Views) -> None:
    with pytest.raises(CaptureFault, match=r"holds nothing of the object, expected it about .* \(-0\.4"):
        cut_to_box(ball, BuildBox((1, 1, 1), (1.5, 1.5, 1.5)))


def test_views_in_which_the_rest_hides_the_content_are_left_out(ball: Views) -> None:
    cut = [CutMask(mask, 0.5 if index % 3 == 0 else 0.0) for index, mask in enumerate(ball.coverage)]
    numbers = tuple(map(float, range(len(cut))))
    left = shown_views(replace(ball, gains=numbers, tints=tuple((number, 1.0, 1.0) for number in numbers)), cut, ALL)
    assert [camera.name for camera in left.cameras] == [camera.name for k, camera in enumerate(ball.cameras) if k % 3]
    assert left.gains == tuple(float(k) for k in range(len(cut)) if k % 3)
    assert left.tints == tuple((float(k), 1.0, 1.0) for k in range(len(cut)) if k % 3)
    assert [camera.name for camera in views_of(ball, left).cameras] == [camera.name for camera in left.cameras]
    with pytest.raises(CaptureFault, match="in 20 of 24 pictures something outside the box"):
        shown_views(ball, [replace(mask, hidden_share=0.5 * (k >= 4)) for k, mask in enumerate(cut)], ALL)
    with pytest.raises(CaptureFault, match="holds nothing that the pictures show"):
        shown_views(ball, [CutMask(torch.zeros_like(mask.coverage), 0.0) for mask in cut], ALL)


@pytest.mark.slow
def test_the_box_is_that_of_the_turned_world(tmp_path: Path) -> None:
    folder = write_nerf_synthetic(tmp_path / "capture")
    up = (1.0, 0.0, 0.0)
    _, whole, about = open_capture(folder, None, 300, 0, up)
    x, y, z = about.bounds_center.tolist()
    _, views, points = open_capture(folder, None, 300, 0, up, BuildBox((x - 1, y - 1, z), (x + 1, y + 1, z + 1)))
    assert points.hull_vertices is not None
    assert float(points.hull_vertices[:, 2].amin()) == pytest.approx(z) and float(points.points_world[:, 2].amin()) >= z - 1e-6
    assert len(views.cameras) < len(whole.cameras) == len(chosen_views(whole, list(range(24))).cameras)


def test_without_masks_the_box_says_where_points_begin(tmp_path: Path, ball: Views) -> None:
    bare = replace(ball, has_masks=False, coverage=tuple(torch.full_like(mask, 255) for mask in ball.coverage))
    points = initial_points(bare, 500, seed=0, box=ABOVE)
    assert points.bounds_center.tolist() == pytest.approx(ABOVE.center) and points.bounds_radius == pytest.approx(ABOVE.radius)
