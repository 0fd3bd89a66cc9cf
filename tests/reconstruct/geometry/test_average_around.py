"""Means over neighbourhoods of a mesh."""

import torch

from drgs.reconstruct.geometry.average_around import averaged, averaging_matrix
from drgs.reconstruct.geometry.mesh_edges import mesh_edges

FACES = torch.tensor([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]], dtype=torch.int32)
"""A tetrahedron."""
VALUES = torch.tensor([[0.0], [1.0], [2.0], [6.0]])


def test_the_mean_is_of_a_vertex_and_those_at_its_edges() -> None:
    found = averaged(averaging_matrix(mesh_edges(FACES), 4), VALUES, 1)
    torch.testing.assert_close(found, torch.full((4, 1), 2.25))


def test_neighbours_count_by_the_weights_of_their_edges() -> None:
    edges = mesh_edges(FACES)
    weight = (edges.vertices == 0).any(1).float() * 0.5
    found = averaged(averaging_matrix(edges, 4, weight), VALUES, 1)
    torch.testing.assert_close(found, torch.tensor([[4.5 / 2.5], [1 / 1.5], [2 / 1.5], [6 / 1.5]]))
