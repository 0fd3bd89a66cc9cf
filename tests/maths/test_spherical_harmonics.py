"""Spherical harmonics against their defining integrals and a few closed values."""

import math

import pytest
import torch

from drgs.maths.spherical_harmonics import SH_OFFSET, evaluate_sh, map_radiance, radiance_from_sh, rotate_sh, sh_basis


def sphere_quadrature(rings: int = 24, sectors: int = 48) -> tuple[torch.Tensor, torch.Tensor]:
    """Gauss-Legendre in z times equal angles: exact for the polynomials used here."""
    import numpy as np

    z, weight = np.polynomial.legendre.leggauss(rings)
    phi = (np.arange(sectors) + 0.5) * 2 * math.pi / sectors
    z, phi = np.meshgrid(z, phi, indexing="ij")
    ring = np.sqrt(1 - z * z)
    directions = np.stack([ring * np.cos(phi), ring * np.sin(phi), z], -1).reshape(-1, 3)
    weights = np.broadcast_to(weight[:, None] * 2 * math.pi / sectors, (rings, sectors)).reshape(-1)
    return torch.from_numpy(directions.copy()), torch.from_numpy(weights.copy())


def test_basis_is_orthonormal_over_the_sphere():
    directions, weights = sphere_quadrature()
    basis = sh_basis(directions, 3)
    gram = basis.T @ (weights[:, None] * basis)
    torch.testing.assert_close(gram, torch.eye(16, dtype=torch.float64), atol=1e-12, rtol=0)


def test_basis_has_the_signs_of_splatting_files():
    axes = sh_basis(torch.eye(3, dtype=torch.float64), 3)
    assert axes[0, 3] == pytest.approx(-0.4886025119029199)  # x
    assert axes[1, 1] == pytest.approx(-0.4886025119029199)  # y
    assert axes[2, 2] == pytest.approx(0.4886025119029199)  # z
    assert axes[2, 6] == pytest.approx(0.31539156525252005 * 2)
    assert axes[2, 12] == pytest.approx(0.3731763325901154 * 2)
    assert axes[0, 15] == pytest.approx(-0.5900435899266435)
    diagonal = sh_basis(torch.full((1, 3), 3**-0.5, dtype=torch.float64), 3)[0]
    assert diagonal[4] == pytest.approx(1.0925484305920792 / 3)
    assert diagonal[10] == pytest.approx(2.890611442640554 / 3**1.5)


def test_lower_degree_ignores_higher_coefficients():
    generator = torch.Generator().manual_seed(0)
    sh = torch.randn(5, 16, 3, dtype=torch.float64, generator=generator)
    directions = torch.nn.functional.normalize(torch.randn(5, 3, dtype=torch.float64, generator=generator), dim=-1)
    truncated = sh.clone()
    truncated[:, 4:] = 0
    torch.testing.assert_close(evaluate_sh(sh, directions, 1), evaluate_sh(truncated, directions, 3))


def test_gradients_match_finite_differences():
    generator = torch.Generator().manual_seed(1)
    sh = torch.randn(3, 16, 3, dtype=torch.float64, generator=generator, requires_grad=True)
    directions = torch.nn.functional.normalize(torch.randn(3, 3, dtype=torch.float64, generator=generator), dim=-1).requires_grad_()
    assert torch.autograd.gradcheck(evaluate_sh, (sh, directions))


def test_zero_coefficients_give_the_offset_and_radiance_is_never_negative():
    directions = torch.tensor([[0.0, 0.0, 1.0]])
    assert torch.equal(radiance_from_sh(torch.zeros(1, 16, 3), directions), torch.full((1, 3), SH_OFFSET))
    assert torch.equal(radiance_from_sh(torch.full((1, 16, 3), -9.0), directions), torch.zeros(1, 3))


def test_unknown_degree_is_refused():
    with pytest.raises(ValueError, match="degree 4"):
        sh_basis(torch.zeros(1, 3), 4)


def test_turned_harmonics_say_in_turned_directions_what_they_said():
    generator = torch.Generator().manual_seed(2)
    sh = torch.randn(6, 16, 3, dtype=torch.float64, generator=generator)
    directions = torch.nn.functional.normalize(torch.randn(6, 3, dtype=torch.float64, generator=generator), dim=-1)
    turn, _ = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64, generator=generator))
    turn = turn * torch.linalg.det(turn)
    turned = rotate_sh(sh, turn)
    torch.testing.assert_close(evaluate_sh(turned, directions @ turn.T), evaluate_sh(sh, directions))
    assert torch.allclose(turned[:, 1:4].square().sum(), sh[:, 1:4].square().sum()), "degrees stay apart"


def test_mapped_radiance_is_exact_where_harmonics_hold_it():
    generator = torch.Generator().manual_seed(3)
    sh = torch.randn(6, 16, 3, dtype=torch.float64, generator=generator)
    doubled = map_radiance(sh, lambda radiance: 2 * radiance)
    directions = torch.nn.functional.normalize(torch.randn(6, 3, dtype=torch.float64, generator=generator), dim=-1)
    wanted = 2 * (evaluate_sh(sh, directions) + SH_OFFSET)
    torch.testing.assert_close(evaluate_sh(doubled, directions) + SH_OFFSET, wanted)
    assert len(map_radiance(sh[:0], torch.sqrt)) == 0
