"""Vertex normals are of unit length, however small the object is."""

import pytest
import torch

from drgs.scene.mesh import vertex_normals
from tests.render.closed_form_scenes import sphere_mesh


@pytest.mark.parametrize("scale", [1e-8, 1.0, 1e8])
def test_normals_are_unit_in_any_unit_of_the_world(scale: float):
    mesh = sphere_mesh(subdivisions=3)
    normals = vertex_normals(scale * mesh.vertices, mesh.faces)
    torch.testing.assert_close(normals.norm(dim=-1), torch.ones(len(normals)))
    assert float((normals * mesh.vertices).sum(-1).min()) > 0.99
