"""Real spherical harmonics to degree 3 in the basis, order and signs that 3D Gaussian splatting files use.

The functions are orthonormal over the sphere, ordered (0,0), (1,-1), (1,0), (1,1), (2,-2) ..., with the Condon-Shortley
phase kept: y, x and every odd order |m| carry a minus sign. Source: Ramamoorthi and Hanrahan 2001 for the polynomials;
Kerbl et al. 2023 for signs and the +0.5 offset (docs/sources.md). Directions run from the camera to the surfel.
"""

import math
from collections.abc import Callable

import torch
from torch import Tensor

from drgs.maths.sampling import sphere_lattice

SH_OFFSET = 0.5
"""Radiance of a surfel whose coefficients are all zero: files hold radiance minus this."""

PROBE_DIRECTIONS = 96
"""Directions in which functions are looked at before they are fitted again; 16 coefficients need well over 16."""

# Normalisations sqrt((2l+1)/(4 pi) ...) of the polynomials in `sh_basis`, by degree and |m|.
K00 = 0.5 / math.sqrt(math.pi)
K1 = math.sqrt(3 / (4 * math.pi))
K20, K21, K22 = math.sqrt(5 / (16 * math.pi)), math.sqrt(15 / (4 * math.pi)), math.sqrt(15 / (16 * math.pi))
K30, K31 = math.sqrt(7 / (16 * math.pi)), math.sqrt(21 / (32 * math.pi))
K32, K33 = math.sqrt(105 / (16 * math.pi)), math.sqrt(35 / (32 * math.pi))


def sh_basis(directions: Tensor, degree: int = 3) -> Tensor:
    """(..., (degree + 1)^2) values of the basis at unit directions (..., 3).

    Raises:
        ValueError: degree outside 0..3.
    """
    if degree not in (0, 1, 2, 3):
        raise ValueError(f"spherical harmonics degree {degree} is not supported; expected 0, 1, 2 or 3")
    x, y, z = directions.unbind(-1)
    basis = [torch.full_like(x, K00)]
    if degree >= 1:
        basis += [-K1 * y, K1 * z, -K1 * x]
    if degree >= 2:
        xx, yy, zz = x * x, y * y, z * z
        basis += [K21 * x * y, -K21 * y * z, K20 * (2 * zz - xx - yy), -K21 * x * z, K22 * (xx - yy)]
    if degree >= 3:
        basis += [
            -K33 * y * (3 * xx - yy), 2 * K32 * x * y * z, -K31 * y * (4 * zz - xx - yy), K30 * z * (2 * zz - 3 * xx - 3 * yy),
            -K31 * x * (4 * zz - xx - yy), K32 * z * (xx - yy), -K33 * x * (xx - 3 * yy),
        ]  # fmt: skip
    return torch.stack(basis, -1)


def evaluate_sh(sh: Tensor, directions: Tensor, degree: int = 3) -> Tensor:
    """(N, 3) sum of coefficients sh (N, >= (degree+1)^2, 3) times the basis at unit directions (N, 3), without the offset.

    Differentiable in both arguments; coefficients above `degree` are ignored (they get zero gradient).
    """
    basis = sh_basis(directions, degree)
    return (basis[..., None] * sh[..., : basis.shape[-1], :]).sum(-2)


def radiance_from_sh(sh: Tensor, directions: Tensor, degree: int = 3) -> Tensor:
    """(N, 3) linear radiance max(0, evaluate_sh + SH_OFFSET) that surfels send against unit `directions` (camera to surfel)."""
    return (evaluate_sh(sh, directions, degree) + SH_OFFSET).clamp(min=0)


def map_radiance(sh: Tensor, function: Callable[[Tensor], Tensor]) -> Tensor:
    """(N, 16, 3) coefficients of function(radiance) of the radiance that sh (N, 16, 3) stands for, by least squares over directions.

    The offset is part of what `function` gets and gives. Exact where the radiance is the same from everywhere.
    """
    basis = sh_basis(sphere_lattice(PROBE_DIRECTIONS))
    fit = torch.linalg.pinv(basis).to(sh)
    basis = basis.to(sh)
    return torch.cat([fit @ (function(basis @ chunk + SH_OFFSET) - SH_OFFSET) for chunk in sh.split(20_000)])


def rotate_sh(sh: Tensor, rotation: Tensor) -> Tensor:
    """(N, 16, 3) coefficients of what sh (N, 16, 3) stands for after a turn: in direction rotation @ d it is what it was in d.

    Exact: a turned polynomial of degree l has degree l, so that the least squares have no remainder.
    """
    directions = sphere_lattice(PROBE_DIRECTIONS)
    turn = torch.linalg.pinv(sh_basis(directions)) @ sh_basis(directions @ rotation.to(directions))
    return turn.to(sh) @ sh
