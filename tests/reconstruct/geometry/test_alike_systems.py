"""Systems solved before the factors of another one, against direct solves."""

import numpy as np
import pytest
from scipy.sparse import csc_matrix, diags, eye

from drgs.reconstruct.geometry import alike_systems
from drgs.reconstruct.geometry.alike_systems import AlikeSystems, factored

COUNT = 400


def weighted_chain(generator: np.random.Generator, least: float) -> csc_matrix:
    """Differences of neighbours and of what lies 20 apart, weighed from `least` to 1, and a little of each unknown."""
    total = 1e-3 * eye(COUNT)
    for apart in (1, 20):
        difference = diags([-np.ones(COUNT), np.ones(COUNT)], [0, apart], shape=(COUNT - apart, COUNT))
        total = total + difference.T @ diags(generator.uniform(least, 1, COUNT - apart)) @ difference
    return total.tocsc()


@pytest.fixture
def factorisations(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    made: list[int] = []

    def counted(matrix: csc_matrix):
        made.append(matrix.shape[0])
        return factored(matrix)

    monkeypatch.setattr(alike_systems, "factored", counted)
    return made


def test_what_resembles_the_first_is_solved_as_exactly_without_being_factored(factorisations: list[int]):
    generator = np.random.default_rng(0)
    systems, x = AlikeSystems(), np.zeros(COUNT)
    for _ in range(4):
        matrix, right_side = weighted_chain(generator, 0.3), generator.normal(size=COUNT)
        x = systems.solved(matrix, right_side, x)
        exact = factored(matrix).solve(right_side)
        assert np.abs(x - exact).max() < 1e-5 * np.abs(exact).max()
    assert len(factorisations) == 1


def test_what_is_not_alike_is_factored_itself(factorisations: list[int]):
    generator = np.random.default_rng(1)
    systems = AlikeSystems()
    systems.solved(weighted_chain(generator, 1e-6), generator.normal(size=COUNT), np.zeros(COUNT))
    matrix, right_side = 1e4 * weighted_chain(generator, 1e-6) + diags(generator.uniform(0, 1e6, COUNT)), generator.normal(size=COUNT)
    x = systems.solved(matrix.tocsc(), right_side, np.zeros(COUNT))
    np.testing.assert_allclose(x, factored(matrix.tocsc()).solve(right_side), rtol=1e-9, atol=1e-15)
    assert len(factorisations) == 2
