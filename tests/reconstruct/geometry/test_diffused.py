"""Diffused values at a mesh's vertices: against the linear system solved in float64."""

import numpy as np
import pytest
import torch
from scipy.sparse import csr_matrix, diags
from scipy.sparse.linalg import spsolve

from drgs.reconstruct.geometry.diffused import Diffusion
from drgs.reconstruct.geometry.mesh_edges import MeshEdges, mesh_edges
from tests.render.closed_form_scenes import sphere_mesh


def solved(edges: MeshEdges, values: torch.Tensor, strength: float) -> np.ndarray:
    start, end = edges.vertices.numpy().T
    count = len(values)
    ends = (np.concatenate([start, end]), np.concatenate([end, start]))
    neighbours = csr_matrix((np.ones(2 * len(start)), ends), shape=(count, count))
    laplacian = diags(np.asarray(neighbours.sum(1)).ravel()) - neighbours
    return spsolve((diags(np.ones(count)) + strength * laplacian).tocsc(), values.double().numpy())


@pytest.mark.parametrize("strength", [0.3, 1.0])
def test_it_solves_the_system(strength: float):
    mesh = sphere_mesh(subdivisions=3)
    edges, values = mesh_edges(mesh.faces), torch.randn(len(mesh.vertices), generator=torch.Generator().manual_seed(1))
    expected = solved(edges, values, strength)
    found = Diffusion(edges, len(values), strength)(values).numpy()
    assert np.abs(found - expected).max() < 5e-3 * np.abs(expected).max()


def test_what_is_even_stays_and_a_peak_spreads_over_its_neighbours():
    mesh = sphere_mesh(subdivisions=3)
    diffusion = Diffusion(mesh_edges(mesh.faces), len(mesh.vertices), 1.0)
    even = torch.full((len(mesh.vertices),), 0.7)
    assert torch.allclose(diffusion(even), even, atol=2e-3)
    peak = torch.zeros_like(even)
    peak[5] = 1
    spread = diffusion(peak)
    beside = mesh.faces[(mesh.faces == 5).any(1)].unique().long()
    assert 0.15 < float(spread[5]) < 0.35 and float(spread[beside].min()) > 0.02
    assert float(spread.sum()) == pytest.approx(1, abs=5e-3)


def test_its_gradient_is_its_transpose():
    mesh = sphere_mesh(subdivisions=2)
    diffusion, generator = Diffusion(mesh_edges(mesh.faces), len(mesh.vertices), 1.0), torch.Generator().manual_seed(2)
    values, others = (torch.randn(len(mesh.vertices), generator=generator) for _ in range(2))
    values.requires_grad_()
    (diffusion(values) * others).sum().backward()
    assert values.grad is not None
    # <S x, y> = <x, S y>, and the gradient of <S x, y> by x is S^T y
    assert torch.allclose(values.grad, diffusion(others), atol=1e-6)
    assert float((diffusion(values.detach()) * others).sum()) == pytest.approx(float((values.detach() * diffusion(others)).sum()), rel=1e-4)


def test_a_mesh_without_edges_keeps_its_values():
    nothing = mesh_edges(torch.zeros(0, 3, dtype=torch.int32))
    values = torch.tensor([1.0, -2.0])
    assert torch.equal(Diffusion(nothing, 2, 1.0)(values), values)
