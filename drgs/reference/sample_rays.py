"""Slow torch twin of drgs/render/integrate/sample_rays.py, at the precision of its inputs; the specification of the kernels."""

import torch
from torch import Tensor

from drgs.maths.constants import F0, MIN_ROUGHNESS
from drgs.maths.sampling import cosine_pdf, ggx_vndf_pdf, hash_combine, sample_cosine, sample_ggx_vndf, sobol_2d, world_from_local
from drgs.render.integrate.environment_table import EnvironmentTable, environment_pdf, sample_environment
from drgs.render.records import Rays, SampleCounts, ShadingPoints


def split_at(points: ShadingPoints, counts: SampleCounts, by_material: bool) -> Tensor:
    """(point, 3) int64 numbers of cosine, GGX and environment samples."""
    if not by_material:
        return torch.tensor([counts.cosine, counts.ggx, counts.environment]).expand(len(points.pixel), 3)
    base = points.albedo.amax(-1)
    diffuse, specular = (1 - points.metallic) * base, F0 * (1 - points.metallic) + points.metallic * base
    share = diffuse / (diffuse + specular).clamp(min=1e-6)
    mirror = (1 - share) * (1 - 4 * points.roughness).clamp(0, 1)
    cosine = (counts.cosine * share + 0.5).long().clamp(max=counts.total - 1)
    environment = (counts.environment * (1 - mirror) + 0.5).long().clamp(min=1).clamp(max=counts.environment)
    return torch.stack([cosine, counts.total - cosine - environment, environment], -1)


def strategy_of(split: Tensor, samples_round: int, slot: Tensor) -> tuple[Tensor, Tensor]:
    """Strategy and index in its sequence of samples `slot` (...) of points with `split` (..., 3)."""
    ends = split.cumsum(-1)
    strategy = (slot[..., None] >= ends[..., :2]).sum(-1)
    size, end = (values.gather(-1, strategy[..., None])[..., 0] for values in (split, ends))
    return strategy, samples_round * size + slot - (end - size)


def strategy_seed(pixel: Tensor, strategy: Tensor, seed: int) -> Tensor:
    """Of the sequences of a pixel; int64, as the strategies."""
    return hash_combine(hash_combine(torch.full_like(strategy, seed & 0xFFFFFFFF), pixel.long()), strategy)


def balance_weights(direction: Tensor, points: ShadingPoints, table: EnvironmentTable, split: Tensor) -> Tensor:
    """(point, sample) 1 / sum_k n_k p_k; 0 below the horizon."""
    normal, wo = points.normal_world[:, None].expand_as(direction), points.wo_world[:, None].expand_as(direction)
    alpha = (points.roughness.clamp(min=MIN_ROUGHNESS) ** 2)[:, None].expand(direction.shape[:2])
    n_dot_l = (normal * direction).sum(-1)
    densities = [cosine_pdf(n_dot_l), ggx_vndf_pdf(direction, wo, normal, alpha), environment_pdf(table, direction)]
    density = (split[:, None] * torch.stack(densities, -1)).sum(-1)
    lit = (n_dot_l > 0) & ((normal * wo).sum(-1) > 0) & (density > 0)
    return torch.where(lit, 1 / density.clamp(min=1e-37), torch.zeros_like(density))


def sample_rays(
    points: ShadingPoints,
    environment_table: EnvironmentTable,
    counts: SampleCounts,
    seed: int,
    lift: float = 0.0,
    samples_round: int = 0,
    by_material: bool = False,
) -> Rays:
    """As drgs.render.integrate.sample_rays.sample_rays; void samples keep the direction they were drawn with."""
    normal, alpha = points.normal_world[:, None], (points.roughness.clamp(min=MIN_ROUGHNESS) ** 2)[:, None]
    split, dtype = split_at(points, counts, by_material), normal.dtype
    slot = torch.arange(counts.total).expand(len(points.pixel), counts.total)
    strategy, index = strategy_of(split[:, None].expand(-1, counts.total, 3), samples_round, slot)
    u = sobol_2d(index, strategy_seed(points.pixel[:, None], strategy, seed), dtype)
    frame = torch.stack([world_from_local(axis.expand_as(points.wo_world), points.normal_world) for axis in torch.eye(3, dtype=dtype)], -1)
    wo_local = torch.einsum("pij,pi->pj", frame, points.wo_world)[:, None].expand(-1, counts.total, 3)
    cosine = world_from_local(sample_cosine(u), normal)
    ggx = world_from_local(sample_ggx_vndf(u, wo_local, alpha.expand(-1, counts.total)), normal)
    environment, strategy = sample_environment(environment_table, u), strategy[..., None]
    direction = torch.where(strategy == 0, cosine, torch.where(strategy == 1, ggx, environment))
    return Rays(points.position_world + lift * points.normal_world, direction, balance_weights(direction, points, environment_table, split))
