"""Wishes along edges against the dense solution, and what they must do in the limits."""

import torch

from drgs.reconstruct.geometry.agree_along_edges import agree_along_edges
from drgs.reconstruct.geometry.mesh_edges import mesh_edges
from tests.render.closed_form_scenes import sphere_mesh


def test_it_is_the_least_of_the_sum_that_it_names():
    edges, generator = mesh_edges(sphere_mesh(subdivisions=1).faces), torch.Generator().manual_seed(3)
    weight, wish = torch.rand(2, 42, generator=generator, dtype=torch.float64)
    start, end = edges.vertices.unbind(1)
    difference = torch.zeros(len(start), 42, dtype=torch.float64)
    row = torch.arange(len(start))
    difference[row, start], difference[row, end] = 1.0, -1.0
    expected = torch.linalg.solve(torch.diag(weight) + 0.7 * difference.T @ difference, weight * wish)
    assert torch.allclose(agree_along_edges(edges.vertices, weight, wish, 0.7), expected, atol=1e-12)
    together = torch.rand(len(start), generator=generator, dtype=torch.float64)
    expected = torch.linalg.solve(torch.diag(weight) + difference.T @ (together[:, None] * difference), weight * wish)
    assert torch.allclose(agree_along_edges(edges.vertices, weight, wish, together), expected, atol=1e-12)


def test_a_vertex_without_a_wish_takes_its_surroundings():
    edges = mesh_edges(sphere_mesh(subdivisions=2).faces)
    weight = torch.zeros(162)
    weight[5] = 1.0
    assert torch.allclose(agree_along_edges(edges.vertices, weight, torch.full((162,), 0.4), 1.0), torch.full((162,), 0.4), atol=1e-5)
