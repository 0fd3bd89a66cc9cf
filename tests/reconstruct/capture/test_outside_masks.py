"""A ball, whose masks say exactly how far a place lies outside of them; a mask with a hole; a field that reaches out of them."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh

from drgs.reconstruct.capture.outside_masks import SLACK, OutsideMasks
from drgs.reconstruct.geometry.extract_mesh import DistanceField, MeshSettings
from drgs.reconstruct.geometry.extract_mesh.extract_mesh import field_inside, march
from drgs.scene.views import Views
from tests.reconstruct.capture.photographed import SIDE, photographed

RADIUS = 0.6
PIXEL = 3 / (1.3 * SIDE)
"""At the ball's middle [world units]."""


@pytest.fixture(scope="module")
def ball() -> Views:
    return photographed(trimesh.creation.icosphere(4, RADIUS))


def _at(distance: float, count: int = 200) -> torch.Tensor:
    directions = np.random.default_rng(0).normal(size=(count, 3))
    return torch.from_numpy(distance * directions / np.linalg.norm(directions, axis=1, keepdims=True)).float()


@pytest.mark.parametrize("beyond", [0.05, 0.1])
def test_distances_are_those_to_the_outline(beyond: float, ball: Views) -> None:
    found = OutsideMasks(ball)(_at(RADIUS + beyond)) + SLACK * PIXEL
    # From 36 cameras no place outside is seen exactly beside the ball, but nearly so from one of them.
    assert float(found.max()) < beyond + PIXEL
    assert float(found.median()) > 0.75 * beyond


def test_the_object_lies_inside(ball: Views) -> None:
    outside = OutsideMasks(ball)
    assert float(outside(_at(RADIUS - 0.01)).max()) < 0
    assert float(outside(_at(0.3)).max()) < -5 * PIXEL


def test_what_no_view_sees_is_not_outside(ball: Views) -> None:
    assert float(OutsideMasks(ball)(torch.tensor([[0.0, 0.0, 500.0]])).max()) < 0


def test_a_mask_that_contradicts_the_others_says_nothing() -> None:
    rod = trimesh.creation.cylinder(0.1, 1.0, transform=trimesh.transformations.rotation_matrix(np.pi / 2, [0, 1, 0]))
    views = photographed(rod, *(trimesh.creation.icosphere(3, 0.3).apply_translation([x, 0, 0]) for x in (-0.5, 0.5)))
    masks = [mask.clone() for mask in views.coverage]
    masks[7][SIDE // 2 - 9 : SIDE // 2 + 9, SIDE // 2 - 9 : SIDE // 2 + 9] = 0
    assert float(OutsideMasks(replace(views, coverage=tuple(masks)))(torch.zeros(1, 3))) < 0


def test_a_surface_is_cut_where_masks_end(ball: Views) -> None:
    # The field of a cube around the ball.
    count, voxel = 48, 2 / 47
    axis = torch.arange(count) * voxel - 1
    places = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1)
    settings = MeshSettings(resolution=47)
    cube = DistanceField(((places.abs().amax(-1) - 0.7) / (settings.truncation_voxels * voxel)).clamp(-1, 1), axis[[0, 0, 0]], voxel)
    vertices, _ = march(field_inside(cube, OutsideMasks(ball), settings))
    radii = vertices.norm(dim=1)
    assert float(march(cube)[0].norm(dim=1).max()) > 1.1
    # The hull of 36 silhouettes, the slack and half a voxel.
    assert float(radii.min()) > RADIUS - PIXEL and float(radii.max()) < RADIUS + 0.08
    assert abs(float(radii.median()) - RADIUS - SLACK * PIXEL) < 0.5 * voxel
