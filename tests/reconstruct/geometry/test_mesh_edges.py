"""Edges and the faces on both of their sides."""

import torch

from drgs.reconstruct.geometry.mesh_edges import mesh_edges
from tests.render.closed_form_scenes import sphere_mesh


def test_a_closed_mesh_has_three_halves_as_many_edges_as_faces_each_between_two():
    faces = sphere_mesh(subdivisions=1).faces
    edges = mesh_edges(faces)
    assert len(edges.vertices) == 3 * len(faces) // 2
    for (a, b), (f, g) in zip(edges.vertices.tolist(), edges.faces.tolist(), strict=True):
        assert a < b and f != g and {a, b} <= set(faces[f].tolist()) and {a, b} <= set(faces[g].tolist())


def test_borders_are_left_out():
    edges = mesh_edges(torch.tensor([[0, 1, 2], [2, 1, 3]], dtype=torch.int32))
    assert edges.vertices.tolist() == [[1, 2]] and sorted(edges.faces[0].tolist()) == [0, 1]
