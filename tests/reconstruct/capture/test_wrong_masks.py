"""Two balls on a rod, photographed exactly, and a slit that few views see through."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh

from drgs.reconstruct.capture.mask_stack import MaskStack
from drgs.reconstruct.capture.visual_hull import HULL, VisualHull, visual_hull
from drgs.reconstruct.capture.wrong_masks import wrong_masks
from drgs.scene.views import Views
from tests.reconstruct import tiny_capture as tiny
from tests.reconstruct.capture.photographed import SIDE, VIEWS, photographed

SMALL = replace(HULL, fine_cells=96, wrong_mask_cells=96)


@pytest.fixture(scope="module")
def dumbbell() -> Views:
    rod = trimesh.creation.cylinder(0.1, 1.0, transform=trimesh.transformations.rotation_matrix(math.pi / 2, [0, 1, 0]))
    balls = [trimesh.creation.icosphere(3, 0.3).apply_translation([x, 0, 0]) for x in (-0.5, 0.5)]
    return photographed(rod, *balls)


def _wrong(views: Views, most: int = 3) -> list[int]:
    """Asked of the cube of side 2."""
    cell = 2 / 96
    axis = (torch.arange(96) + 0.5) * cell - 1
    points = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    return wrong_masks(MaskStack.of(views), points, cell, HULL.level, 3, most)


def _with_holes(views: Views, numbers: tuple[int, ...], half: int = 9) -> Views:
    """Masks that leave out a square around what is in the middle: the rod."""
    masks = [mask.clone() for mask in views.coverage]
    for number in numbers:
        masks[number][SIDE // 2 - half : SIDE // 2 + half, SIDE // 2 - half : SIDE // 2 + half] = 0
    return replace(views, coverage=tuple(masks))


def _rod(hull: VisualHull | None) -> int:
    """Vertices of the hull half-way between the balls."""
    assert hull is not None
    vertices = hull.vertices_world
    return int(((np.abs(vertices[:, 0]) < 0.05) & (np.hypot(vertices[:, 1], vertices[:, 2]) < 0.16)).sum())


def test_of_exact_masks_none_is_wrong(dumbbell: Views) -> None:
    assert _wrong(dumbbell) == []


def test_masks_that_bore_through_what_others_need_are_found(dumbbell: Views) -> None:
    assert sorted(_wrong(_with_holes(dumbbell, (7, 20)))) == [7, 20]
    assert _wrong(_with_holes(dumbbell, (7, 20)), most=1)[0] in (7, 20)


def test_the_hull_leaves_them_out(dumbbell: Views) -> None:
    exact, bored = (_rod(visual_hull(views, SMALL)) for views in (dumbbell, _with_holes(dumbbell, (7,))))
    assert exact > 20
    assert bored > 0.9 * exact


def test_what_many_masks_leave_out_is_not_there(dumbbell: Views) -> None:
    assert _rod(visual_hull(_with_holes(dumbbell, tuple(range(0, VIEWS, 3))), SMALL)) == 0


def test_of_few_views_none_is_left_out(dumbbell: Views) -> None:
    few = list(range(0, VIEWS, 4))
    bored = _with_holes(dumbbell, (few[2],))
    few_of = {name: tuple(getattr(bored, name)[view] for view in few) for name in ("cameras", "images_srgb", "coverage")}
    assert _rod(visual_hull(replace(bored, **few_of), SMALL)) == 0


def test_a_slit_that_one_view_sees_through_is_open() -> None:
    # Plates stand apart by a little more than a pixel, and only the view along the slit sees light between them.
    plates = [trimesh.creation.box((0.9, 0.1, 0.9)).apply_translation([0, y, 0]) for y in (-0.09, 0.09)]
    towards = np.array([3.0, 0.0, 0.0])
    views = photographed(*plates)
    along = replace(views.cameras[0], camera_from_world=torch.from_numpy(tiny.look_at(towards)).float())
    rows, columns = torch.meshgrid(torch.arange(SIDE), torch.arange(SIDE), indexing="ij")
    x = (columns + 0.5 - SIDE / 2).abs() / (1.3 * SIDE)
    y = (rows + 0.5 - SIDE / 2).abs() / (1.3 * SIDE)
    shown = ((x > 0.04 / 3.45) & (x < 0.14 / 2.55) & (y < 0.45 / 2.55)).to(torch.uint8) * 255
    views = replace(
        views, cameras=(*views.cameras, along), images_srgb=(*views.images_srgb, views.images_srgb[0]), coverage=(*views.coverage, shown)
    )
    hull = visual_hull(views, SMALL)
    assert hull is not None
    inside = np.abs(hull.vertices_world).max(1) < 0.3
    assert np.abs(hull.vertices_world[inside, 1]).min() < 0.06
