"""Slow torch twin of drgs/render/film/denoise/svgf.py on whole maps; the specification of its kernels."""

import torch
from torch import Tensor

from drgs.maths.brdf import f0_from_base
from drgs.maths.color import luminance
from drgs.render.film.denoise.svgf import NEIGHBOUR_VARIANCE, NORMAL_POWER, SIGMA_LUMINANCE, SIGMA_PLANE
from drgs.render.progressive.demodulate_albedo import MIN_REFLECTANCE
from drgs.render.records import GBuffer


def reflectances(gbuffer: GBuffer) -> tuple[Tensor, Tensor]:
    """(height, width, 3) factors of the diffuse and the specular part that textures carry."""
    diffuse = (1 - gbuffer.metallic)[..., None] * gbuffer.albedo
    return diffuse.clamp(min=MIN_REFLECTANCE), f0_from_base(gbuffer.albedo, gbuffer.metallic).clamp(min=MIN_REFLECTANCE)


def shifted(values: Tensor, dx: int, dy: int) -> Tensor:
    """values at (x + dx, y + dy), 0 outside; (height, width, ...)."""
    height, width = values.shape[:2]
    result = torch.zeros_like(values)
    ys, xs = slice(max(0, -dy), min(height, height - dy)), slice(max(0, -dx), min(width, width - dx))
    result[ys, xs] = values[max(0, dy) : min(height, height + dy), max(0, dx) : min(width, width + dx)]
    return result


def smooth_variance(variance: Tensor, coverage: Tensor, step: int) -> Tensor:
    """(height, width, 2) binomial mean over covered pixels."""
    total, weights = torch.zeros_like(variance), torch.zeros_like(coverage)
    for dy in range(-2, 3):
        for dx in range(-2, 3):
            w = (3 - abs(dx)) * (3 - abs(dy)) * (shifted(coverage, dx * step, dy * step) > 0)
            total += w[..., None] * shifted(variance, dx * step, dy * step)
            weights += w
    return total / weights.clamp(min=1e-12)[..., None]


def filter_level(
    parts: tuple[Tensor, Tensor],
    variance: Tensor,
    gbuffer: GBuffer,
    footprint: float,
    step: int,
    sigma_luminance: float = SIGMA_LUMINANCE,
    neighbour_variance: float = NEIGHBOUR_VARIANCE,
) -> tuple[tuple[Tensor, ...], Tensor]:
    """One round on demodulated parts (height, width, 3) with variances (height, width, 2); covered pixels only mean something."""
    row = {0: 0.375, 1: 0.25, 2: 0.0625}
    smooth = smooth_variance(variance, gbuffer.coverage, step)
    sums = [torch.zeros_like(part) for part in parts]
    weights = torch.zeros_like(variance)
    sum_variance = torch.zeros_like(variance)
    plane = SIGMA_PLANE * footprint * torch.where(torch.isfinite(gbuffer.depth), gbuffer.depth, 0.0) * step
    for dy in range(-2, 3):
        for dx in range(-2, 3):
            at = (dx * step, dy * step)
            coverage = shifted(gbuffer.coverage, *at)
            alike = (gbuffer.normal_world * shifted(gbuffer.normal_world, *at)).sum(-1).clamp(min=0)
            off = (gbuffer.normal_world * (shifted(gbuffer.position_world, *at) - gbuffer.position_world)).sum(-1).abs() / plane.clamp(
                min=1e-12
            )
            shared = row[abs(dx)] * row[abs(dy)] * alike ** float(NORMAL_POWER) * coverage * (coverage > 0)
            both = smooth + neighbour_variance * shifted(smooth, *at)
            for k, part in enumerate(parts):
                other = shifted(part, *at)
                difference = (luminance(other) - luminance(part)).abs() / (sigma_luminance**2 * both[..., k] + 1e-12).sqrt()
                w = shared * torch.exp(-off - difference)
                sums[k] += w[..., None] * other
                sum_variance[..., k] += w * w * shifted(variance, *at)[..., k]
                weights[..., k] += w
    filtered = tuple(total / weights[..., k].clamp(min=1e-20)[..., None] for k, total in enumerate(sums))
    return filtered, sum_variance / weights.square().clamp(min=1e-30)
