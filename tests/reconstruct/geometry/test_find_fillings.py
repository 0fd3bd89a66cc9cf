"""Fillings of narrow hollows are found beside concave creases, and what is emptied has the walls of the hollow."""

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from drgs.reconstruct.geometry.average_around import averaging_matrix
from drgs.reconstruct.geometry.find_fillings import Filling, FillingSettings, emptied, find_fillings
from drgs.reconstruct.geometry.mesh_edges import mesh_edges
from drgs.scene.mesh import vertex_normals

STEP = 0.008
"""Of the grid; the object's radius is 1."""
SLOPE = 0.7
"""By which the sheet falls towards the crease at x = 0."""
WIDTH = 0.08


def sheet_and_lip(x: Tensor) -> Tensor:
    """Heights of a sloping sheet, a level cap and the far side of a lip, which is steep."""
    return torch.where(x < 0, -SLOPE * x, torch.zeros_like(x)) - 1.5 * (x - WIDTH).clamp(min=0)


def surface(height: Callable[[Tensor], Tensor]) -> tuple[Tensor, Tensor]:
    """Vertices and faces of a strip along y with heights over x."""
    x, y = torch.arange(-0.2, 0.2, STEP), torch.arange(-0.08, 0.08, STEP)
    grid = torch.stack(torch.meshgrid(x, y, indexing="ij"), -1).reshape(-1, 2)
    number = torch.arange(len(grid)).reshape(len(x), len(y))
    a, b, c, d = (corner.flatten() for corner in (number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]))
    faces = torch.cat([torch.stack([a, b, c], 1), torch.stack([a, c, d], 1)]).int()
    return torch.cat([grid, height(grid[:, :1])], 1), faces


def fillings_of(height: Callable[[Tensor], Tensor]) -> tuple[Tensor, Tensor, list[Filling]]:
    vertices, faces = surface(height)
    return vertices, faces, find_fillings(vertices, faces, vertex_normals(vertices, faces), 1.0, FillingSettings())


def test_a_cap_beside_a_sloping_sheet_is_a_filling_as_wide_as_it_is():
    _, _, found = fillings_of(sheet_and_lip)
    assert len(found) >= 5
    for filling in found:
        assert abs(filling.width - WIDTH) < 1.5 * STEP
        assert abs(filling.crease[0]) < 1.5 * STEP
        expected = np.array([1.0, 0.0, -SLOPE]) / np.hypot(1.0, SLOPE)
        assert filling.onward @ expected > 0.99


def test_emptied_the_sheet_goes_on_for_its_share_and_then_rises_to_the_far_edge():
    vertices, faces, found = fillings_of(sheet_and_lip)
    around = averaging_matrix(mesh_edges(faces), len(vertices))
    share = 0.6
    places, filled = emptied(vertices, found, share, around)
    middle = filled & (vertices[:, 1].abs() < 0.04)
    end_x, end_z = share * WIDTH / np.hypot(1.0, SLOPE), -SLOPE * share * WIDTH / np.hypot(1.0, SLOPE)
    x, z = places[middle][:, 0], places[middle][:, 2]
    wall = end_z * (WIDTH - x) / (WIDTH - end_x)
    off = (z - torch.maximum(-SLOPE * x, wall)).abs()
    assert float(z.min()) < 0.8 * end_z
    assert float(off.mean()) < 0.003 and float(off.max()) < 0.01
    far = (vertices[:, 0] < -0.03) | (vertices[:, 0] > WIDTH + 0.03)
    assert not filled[far].any() and torch.equal(places[far], vertices[far])


def test_ridges_flat_places_and_corners_without_a_cap_have_no_fillings():
    for height in (lambda x: -x.abs(), torch.zeros_like, lambda x: SLOPE * x.abs()):
        assert fillings_of(height)[2] == []
