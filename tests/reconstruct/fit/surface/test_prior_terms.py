"""What neighbours cost and its gradient, against the differences of all edges in float64."""

import pytest
import torch

from drgs.reconstruct.fit.surface.prior_terms import prior_terms
from drgs.reconstruct.geometry.mesh_edges import mesh_edges
from tests.reconstruct.fit.painted_sphere import placed_sphere

BEND, SMOOTH, METAL = 0.05, 0.3, 0.2


def test_costs_and_gradients_are_those_of_the_differences_along_edges(device: str):
    faces = placed_sphere(subdivisions=2).faces.to(device)
    edges, generator = mesh_edges(faces), torch.Generator().manual_seed(1)
    count = int(faces.max()) + 1
    values = torch.rand(count, 8, generator=generator, dtype=torch.float64)
    values[:20] = values[0]  # alike: no slope
    evidence = torch.rand(count, generator=generator, dtype=torch.float64) - 0.5
    sky = torch.ones(4, 8, 3, device=device)

    exact = values.clone().requires_grad_(True)
    start, end = (exact[corner] for corner in edges.vertices.cpu().unbind(1))
    across = start - end
    wanted = {
        "bend": BEND * across[:, :3].norm(dim=1).mean(),
        "smooth": SMOOTH * (across[:, 3:6].abs().mean() + across[:, 6].abs().mean() + across[:, 7].abs().mean()),
        "metal": METAL * (evidence.abs() * (exact[:, 7] - (evidence > 0).double()).abs()).mean(),
    }
    surface = values.float().to(device).requires_grad_(True)
    terms = prior_terms(edges, sky, surface, evidence.float().to(device), BEND, SMOOTH, METAL, 1.0, 1.0)
    assert float(terms["white_light"].detach()) == 0 and float(terms["rough_light"].detach()) == 0
    for name, expected in wanted.items():
        assert float(terms[name].detach()) == pytest.approx(float(expected.detach()), rel=1e-5)
        (found,) = torch.autograd.grad(terms[name], surface, retain_graph=True)
        (slope,) = torch.autograd.grad(expected, exact, retain_graph=True)
        assert torch.allclose(found.cpu().double(), slope, atol=1e-7), name


def test_a_mesh_without_shared_edges_costs_nothing():
    surface = torch.rand(3, 8).requires_grad_(True)
    edges = mesh_edges(torch.tensor([[0, 1, 2]], dtype=torch.int32))
    terms = prior_terms(edges, torch.ones(4, 8, 3), surface, torch.zeros(3), BEND, SMOOTH, METAL, 0.0, 0.0)
    torch.stack(list(terms.values())).sum().backward()
    assert surface.grad is not None
    assert float(terms["bend"].detach()) == 0 and float(surface.grad.abs().max()) == 0
