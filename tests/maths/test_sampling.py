"""Samplers against their densities, and random numbers against the definition of a net."""

import math

import pytest
import torch
from scipy import stats

from drgs.maths.brdf import ggx_d
from drgs.maths.sampling import (
    cosine_pdf,
    ggx_vndf_pdf,
    hash_combine,
    sample_cosine,
    sample_ggx_vndf,
    sample_linear,
    shuffle_index,
    sobol_2d,
)

BINS_Z, BINS_AZIMUTH, SUB = 12, 16, 40


def hemisphere_grid() -> torch.Tensor:
    """(bin, SUB * SUB, 3) midpoints of bins of equal solid angle on the upper hemisphere, float64."""
    z = (torch.arange(BINS_Z * SUB, dtype=torch.float64) + 0.5) / (BINS_Z * SUB)
    azimuth = (torch.arange(BINS_AZIMUTH * SUB, dtype=torch.float64) + 0.5) / (BINS_AZIMUTH * SUB) * 2 * math.pi
    z, azimuth = torch.meshgrid(z, azimuth, indexing="ij")
    r = torch.sqrt(1 - z * z)
    grid = torch.stack([r * torch.cos(azimuth), r * torch.sin(azimuth), z], -1)
    return grid.reshape(BINS_Z, SUB, BINS_AZIMUTH, SUB, 3).permute(0, 2, 1, 3, 4).reshape(BINS_Z * BINS_AZIMUTH, SUB * SUB, 3)


def assert_samples_follow(direction: torch.Tensor, mass: torch.Tensor) -> None:
    """Chi-squared test of directions (n, 3) against the mass of each bin; what lies below the horizon is one more bin."""
    up = direction[direction[:, 2] > 0]
    row = (up[:, 2] * BINS_Z).long().clamp(max=BINS_Z - 1)
    column = (torch.atan2(up[:, 1], up[:, 0]) / (2 * math.pi) % 1 * BINS_AZIMUTH).long().clamp(max=BINS_AZIMUTH - 1)
    found = torch.bincount(row * BINS_AZIMUTH + column, minlength=len(mass)).double()
    found = torch.cat([found, torch.tensor([len(direction) - len(up)]).double()])
    expected = torch.cat([mass, (1 - mass.sum())[None].clamp(min=0)]) * len(direction)
    large = expected > 8
    found = torch.cat([found[large], found[~large].sum()[None]])
    expected = torch.cat([expected[large], expected[~large].sum()[None] + 1e-9])
    statistic = float(((found - expected) ** 2 / expected.clamp(min=1)).sum())
    assert stats.chi2.sf(statistic, len(expected) - 1) > 1e-4


def test_cosine_samples_follow_their_density() -> None:
    grid = hemisphere_grid()
    mass = cosine_pdf(grid[..., 2]).mean(1) * 2 * math.pi / len(grid)
    assert abs(float(mass.sum()) - 1) < 1e-4
    assert_samples_follow(sample_cosine(torch.rand(200_000, 2, dtype=torch.float64)), mass)


@pytest.mark.slow
@pytest.mark.parametrize("roughness", [0.5, 0.7, 1.0])
@pytest.mark.parametrize("polar_degrees", [0.0, 40.0, 75.0, 88.0])
def test_ggx_samples_follow_their_density(roughness: float, polar_degrees: float) -> None:
    theta = math.radians(polar_degrees)
    wo = torch.tensor([math.sin(theta), 0.0, math.cos(theta)], dtype=torch.float64)
    normal = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    alpha = torch.tensor(roughness**2, dtype=torch.float64)
    grid = hemisphere_grid()
    mass = ggx_vndf_pdf(grid, wo.expand_as(grid), normal.expand_as(grid), alpha.expand(grid.shape[:2])).mean(1) * 2 * math.pi / len(grid)
    assert float(mass.sum()) <= 1 + 1e-3
    wi = sample_ggx_vndf(torch.rand(200_000, 2, dtype=torch.float64), wo.expand(200_000, 3), alpha.expand(200_000))
    torch.testing.assert_close(wi.norm(dim=-1), torch.ones(200_000, dtype=torch.float64))
    assert_samples_follow(wi, mass)


def test_bounded_ggx_density_is_at_least_that_of_all_visible_normals() -> None:
    wi, wo = (torch.nn.functional.normalize(torch.randn(1000, 3, dtype=torch.float64), dim=-1).abs() for _ in range(2))
    normal = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand_as(wi)
    alpha = torch.rand(1000, dtype=torch.float64).clamp(min=0.01)
    h = torch.nn.functional.normalize(wi + wo, dim=-1)
    cos_o = wo[:, 2]
    g1 = 2 * cos_o / (cos_o + torch.sqrt(alpha**2 + (1 - alpha**2) * cos_o**2))
    unbounded = g1 * ggx_d(h[:, 2], alpha) / (4 * cos_o)
    assert bool((ggx_vndf_pdf(wi, wo, normal, alpha) >= unbounded * (1 - 1e-9)).all())


def test_ggx_peak_survives_float32() -> None:
    """At the smallest roughness, a quarter of a lobe's width off the mirror direction."""
    wo = torch.tensor([0.6, 0.0, 0.8], dtype=torch.float64)
    h = torch.nn.functional.normalize(torch.tensor([2e-4, 1e-4, 1.0], dtype=torch.float64), dim=-1)
    wi = 2 * (wo @ h) * h - wo
    normal, alpha = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64), torch.tensor(0.03**2, dtype=torch.float64)
    exact = ggx_vndf_pdf(wi, wo, normal, alpha)
    single = ggx_vndf_pdf(wi.float(), wo.float(), normal.float(), alpha.float())
    assert abs(float(single / exact) - 1) < 1e-3


def test_linear_samples_have_linear_density() -> None:
    u = (torch.arange(10_000, dtype=torch.float64) + 0.5) / 10_000
    for a, b in ((1.0, 3.0), (2.0, 0.0), (0.0, 1.0), (1.0, 1.0)):
        x = sample_linear(u, torch.tensor(a, dtype=torch.float64), torch.tensor(b, dtype=torch.float64))
        cdf = (a * x + 0.5 * (b - a) * x * x) / (0.5 * (a + b))
        torch.testing.assert_close(cdf, u, atol=1e-9, rtol=0)


@pytest.mark.parametrize("first", [0, 16, 4096])
def test_every_aligned_block_of_scrambled_points_is_a_net(first: int) -> None:
    for seed in (0, 1, 0xDEADBEEF):
        points = sobol_2d(torch.arange(first, first + 16), torch.tensor(seed), torch.float64)
        assert bool(((points >= 0) & (points < 1)).all())
        for columns in (1, 2, 4, 8, 16):  # every elementary rectangle of area 1/16 holds exactly one point
            cell = (points[:, 0] * columns).long() * (16 // columns) + (points[:, 1] * (16 // columns)).long()
            assert len(cell.unique()) == 16


def test_scrambled_points_of_different_seeds_are_uniform_and_uncorrelated() -> None:
    seeds = hash_combine(torch.tensor(7), torch.arange(40_000))
    points = sobol_2d(torch.tensor(3), seeds, torch.float64)
    for k in range(2):
        counts = torch.bincount((points[:, k] * 32).long(), minlength=32).double()
        assert stats.chi2.sf(float(((counts - 1250) ** 2 / 1250).sum()), 31) > 1e-4
    neighbours = points[:-1, 0] - 0.5, points[1:, 0] - 0.5
    assert abs(float((neighbours[0] * neighbours[1]).mean())) < 4 / 12 / math.sqrt(40_000)


def test_shuffled_indices_permute_blocks_and_stay_in_blocks() -> None:
    shuffled = shuffle_index(torch.arange(64), torch.tensor(99))
    assert len(shuffled.unique()) == 64
    for block in range(4):
        assert len((shuffled[16 * block : 16 * block + 16] >> 4).unique()) == 1
