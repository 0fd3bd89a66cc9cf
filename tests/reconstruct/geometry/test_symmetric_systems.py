"""Systems filled pair by pair and solved by conjugate gradients, against direct solves of the same matrices made by scipy."""

import numpy as np
import pytest
import torch
from scipy.sparse import csc_matrix, csr_matrix, diags

from drgs.reconstruct.geometry import symmetric_systems
from drgs.reconstruct.geometry.symmetric_systems import SymmetricPlaces, factored, solved

COUNT = 400
PAIRS = torch.tensor([[k, k + apart] for apart in (1, 20, 1) for k in range(COUNT - apart)])
"""Neighbours, twice, and what lies 20 apart."""


def weighted_chain(generator: torch.Generator, least: float) -> tuple[torch.Tensor, torch.Tensor, csc_matrix]:
    """Squared differences of PAIRS, weighed from `least` to 1, and a little of each unknown: beside the diagonal, the diagonal, and all by scipy."""
    weight = least + (1 - least) * torch.rand(len(PAIRS), dtype=torch.float64, generator=generator)
    diagonal = torch.full((COUNT,), 1e-3, dtype=torch.float64)
    for end in PAIRS.unbind(1):
        diagonal.index_add_(0, end, weight)
    row = np.arange(len(PAIRS))
    difference = csr_matrix((np.repeat([1.0, -1.0], len(PAIRS)), (np.tile(row, 2), PAIRS.T.flatten().numpy())), shape=(len(PAIRS), COUNT))
    whole = difference.T @ diags(weight.numpy()) @ difference + 1e-3 * diags(np.ones(COUNT))
    return SymmetricPlaces.of(PAIRS, COUNT).filled(-weight), diagonal, whole.tocsc()


@pytest.mark.parametrize("least", [0.3, 1e-6])
def test_solutions_are_those_of_factors(least: float):
    generator = torch.Generator().manual_seed(0)
    x = torch.zeros(COUNT, dtype=torch.float64)
    for _ in range(3):
        beside, diagonal, whole = weighted_chain(generator, least)
        right_side = torch.randn(COUNT, dtype=torch.float64, generator=generator)
        x = solved(beside, diagonal, right_side, x)
        exact = factored(whole).solve(right_side.numpy())
        assert np.abs(x.numpy() - exact).max() < 1e-3 * np.abs(exact).max()


def test_a_pair_adds_to_both_its_places():
    beside = SymmetricPlaces.of(torch.tensor([[0, 2], [2, 0], [1, 2]]), 4).filled(torch.tensor([1.0, 10.0, 100.0], dtype=torch.float64))
    wanted = torch.zeros(4, 4, dtype=torch.float64)
    wanted[0, 2] = wanted[2, 0] = 11
    wanted[1, 2] = wanted[2, 1] = 100
    assert torch.equal(beside.to_dense(), wanted)


def test_what_takes_too_many_steps_is_factored(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(symmetric_systems, "MOST_STEPS", 3)
    generator = torch.Generator().manual_seed(1)
    beside, diagonal, whole = weighted_chain(generator, 1e-6)
    right_side = torch.randn(COUNT, dtype=torch.float64, generator=generator)
    x = solved(beside, diagonal, right_side, torch.zeros_like(right_side))
    np.testing.assert_allclose(x.numpy(), factored(whole).solve(right_side.numpy()), rtol=1e-9, atol=1e-15)


def test_nothing_to_solve_for_is_nothing():
    beside, diagonal, _ = weighted_chain(torch.Generator().manual_seed(2), 0.3)
    zero = torch.zeros_like(diagonal)
    assert torch.equal(solved(beside, diagonal, zero, zero), zero)
