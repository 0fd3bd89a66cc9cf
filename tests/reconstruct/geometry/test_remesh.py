"""Meshing anew: the surface stays, its triangles get even, folds go, and what vertices carry arrives."""

import igl
import numpy as np
import pytest
import torch

from drgs.reconstruct.geometry.extract_mesh import MeshSettings
from drgs.reconstruct.geometry.extract_mesh.clean_mesh import is_watertight
from drgs.reconstruct.geometry.remesh import INSIDE, _inside, remesh
from tests.render.closed_form_scenes import sphere_mesh

SETTINGS = MeshSettings(resolution=48, face_limit=4000, smoothing_passes=0)


def smallest_angles(vertices: torch.Tensor, faces: torch.Tensor) -> torch.Tensor:
    """(face,) [degrees]"""
    corners = vertices[faces.long()]
    to_next = torch.nn.functional.normalize(corners.roll(-1, 1) - corners, dim=-1)
    to_last = torch.nn.functional.normalize(corners.roll(1, 1) - corners, dim=-1)
    return torch.rad2deg(torch.acos((to_next * to_last).sum(-1).clamp(-1, 1))).amin(1)


def test_a_sphere_stays_and_linear_values_arrive():
    old = sphere_mesh(subdivisions=4)
    new = remesh(old.vertices, old.faces, SETTINGS)
    assert is_watertight(len(new.vertices), new.faces.long().numpy()) and len(new.faces) <= SETTINGS.face_limit
    assert float((new.vertices.norm(dim=1) - 1).abs().max()) < 2e-3
    assert float((new.carried(old.vertices) - new.vertices).norm(dim=1).max()) < 2e-3
    assert torch.allclose(new.weights.sum(1), torch.ones(len(new.vertices)))


def test_faces_that_were_pushed_through_the_surface_are_gone():
    old = sphere_mesh(subdivisions=4)
    folded, faces = old.vertices.clone(), old.faces
    one = int(faces[0, 0])
    folded[one] = -1.3 * folded[one]  # a spike from here out of the other side
    assert float(smallest_angles(folded, faces).min()) < 5.0
    new = remesh(folded, faces, SETTINGS)
    assert is_watertight(len(new.vertices), new.faces.long().numpy())
    assert float(new.vertices.norm(dim=1).max()) < 1.005
    whole = (new.vertices @ old.vertices[one]).abs() < 0.9  # but for where it begins and came out
    assert float((new.vertices[whole].norm(dim=1) - 1).abs().median()) < 2e-3


def test_nodes_of_which_one_in_a_part_is_asked_are_where_winding_numbers_say():
    old = sphere_mesh(subdivisions=3)
    wild = old.vertices * (1 + 0.3 * torch.sin(7 * old.vertices[:, [1, 2, 0]]))  # folds, and passes through itself
    points, faces = wild.double().numpy(), old.faces.numpy().astype(np.int64)
    cell, origin = 0.05, points.min(0) - 0.3
    near = np.ones([int(n) for n in (points.max(0) - origin + 0.3) / cell], bool)
    at = origin + cell * np.argwhere(near)
    far = np.sqrt(igl.point_mesh_squared_distance(at, points, faces)[0]).reshape(near.shape) > cell
    inside = _inside(points, faces, near, at, far)
    assert 0 < inside.sum() < len(inside) and far.mean() > 0.5
    np.testing.assert_array_equal(inside, igl.fast_winding_number(points, faces, at) > INSIDE)


def test_a_surface_that_encloses_nothing_is_refused():
    flat = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    with pytest.raises(ValueError, match="encloses nothing"):
        remesh(flat, torch.tensor([[0, 1, 2]], dtype=torch.int32), SETTINGS)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_vertices_that_are_not_finite_are_refused(value: float):
    mesh = sphere_mesh(subdivisions=2)
    torn = mesh.vertices.clone()
    torn[[3, 7], 1] = value
    with pytest.raises(ValueError, match=rf"^2 of {len(torn)} vertices .* not finite, the first is number 3; expected"):
        remesh(torn, mesh.faces, SETTINGS)
