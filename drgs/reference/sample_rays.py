"""Slow torch twin of drgs/render/sample_rays.py, at the precision of its inputs; the specification of the kernels."""

import torch
from torch import Tensor

from drgs.maths.brdf import MIN_ROUGHNESS
from drgs.maths.sampling import cosine_pdf, ggx_vndf_pdf, hash_combine, sample_cosine, sample_ggx_vndf, sobol_2d, world_from_local
from drgs.render.environment_table import EnvironmentTable, environment_pdf, sample_environment
from drgs.render.records import Rays, ShadingPoints
from drgs.render.sample_rays import SampleCounts


def strategy_numbers(points: ShadingPoints, strategy: int, count: int, seed: int, samples_round: int) -> Tensor:
    """(point, count, 2) numbers of one strategy's samples."""
    seeds = hash_combine(torch.full((len(points.pixel),), seed & 0xFFFFFFFF, dtype=torch.int64), points.pixel.long())
    seeds = hash_combine(seeds, torch.full_like(seeds, strategy))
    index = torch.arange(count) + samples_round * count
    return sobol_2d(index[None, :], seeds[:, None], points.normal_world.dtype)


def balance_weights(direction: Tensor, points: ShadingPoints, table: EnvironmentTable, counts: SampleCounts) -> Tensor:
    """(point, sample) 1 / sum_k n_k p_k; 0 below the horizon."""
    normal, wo = points.normal_world[:, None].expand_as(direction), points.wo_world[:, None].expand_as(direction)
    alpha = (points.roughness.clamp(min=MIN_ROUGHNESS) ** 2)[:, None].expand(direction.shape[:2])
    n_dot_l = (normal * direction).sum(-1)
    density = counts.cosine * cosine_pdf(n_dot_l)
    density = density + counts.ggx * ggx_vndf_pdf(direction, wo, normal, alpha)
    density = density + counts.environment * environment_pdf(table, direction)
    lit = (n_dot_l > 0) & ((normal * wo).sum(-1) > 0) & (density > 0)
    return torch.where(lit, 1 / density.clamp(min=1e-37), torch.zeros_like(density))


def sample_rays(
    points: ShadingPoints, environment_table: EnvironmentTable, counts: SampleCounts, seed: int, lift: float = 0.0, samples_round: int = 0
) -> Rays:
    """As drgs.render.sample_rays.sample_rays; void samples keep the direction they were drawn with."""
    dtype = points.normal_world.dtype
    normal, wo = points.normal_world[:, None], points.wo_world[:, None]
    alpha = (points.roughness.clamp(min=MIN_ROUGHNESS) ** 2)[:, None]
    numbers = [strategy_numbers(points, k, n, seed, samples_round) for k, n in enumerate((counts.cosine, counts.ggx, counts.environment))]
    cosine = world_from_local(sample_cosine(numbers[0]), normal)
    frame = torch.stack(
        [world_from_local(torch.eye(3, dtype=dtype)[k].expand_as(points.wo_world), points.normal_world) for k in range(3)], -1
    )
    wo_local = (wo @ frame).expand(-1, counts.ggx, 3)
    ggx = world_from_local(sample_ggx_vndf(numbers[1], wo_local, alpha.expand(-1, counts.ggx)), normal)
    environment = sample_environment(environment_table, numbers[2])
    direction = torch.cat([cosine, ggx, environment], 1)
    return Rays(
        points.position_world + lift * points.normal_world, direction, balance_weights(direction, points, environment_table, counts)
    )
