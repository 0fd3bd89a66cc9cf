"""Slow torch twins of drgs/reconstruct/fit/light/split_sum.py, at the precision of their inputs; the specification of the filter, the kernel and the table."""

import math

import torch
from torch import Tensor

from drgs.maths.brdf import ggx_d, smith_v
from drgs.reconstruct.fit.light.split_sum import IRRADIANCE_ROWS, LEVELS
from drgs.scene.environment import Environment, direction_from_uv, environment_radiance


def reduce_rows(table: Tensor, rows: int) -> Tensor:
    """(rows, 2 rows, 3) means by solid angle of a finer lat-long table."""
    factor = table.shape[0] // rows
    edges = torch.arange(table.shape[0] + 1, dtype=table.dtype) * (math.pi / table.shape[0])
    area = (edges[:-1].cos() - edges[1:].cos()).reshape(rows, factor, 1, 1, 1)
    blocks = table.reshape(rows, factor, 2 * rows, factor, 3)
    return (blocks * area).sum((1, 3)) / (area.sum(1).reshape(rows, 1, 1) * factor)


def filtered_radiance(table: Tensor, roughness: float | None, direction: Tensor) -> Tensor:
    """(n, 3): mean of a lat-long table weighted by D(h) cos over its texels, h halfway between direction (n, 3) and texel.

    Without a roughness the lobe is the cosine alone: irradiance over pi.
    """
    rows = table.shape[0]
    v, u = torch.meshgrid(
        (torch.arange(rows, dtype=table.dtype) + 0.5) / rows, (torch.arange(2 * rows, dtype=table.dtype) + 0.5) / (2 * rows), indexing="ij"
    )
    edges = torch.arange(rows + 1, dtype=table.dtype) * (math.pi / rows)
    area = (edges[:-1].cos() - edges[1:].cos()).repeat_interleave(2 * rows)
    cosine = (direction @ direction_from_uv(torch.stack([u, v], -1)).reshape(-1, 3).T).clamp(-1, 1)
    weight = cosine.clamp(min=0) * area
    if roughness is not None:
        # With n = wo = the lobe's axis, n.h is the cosine of half the angle.
        weight = weight * ggx_d(torch.cos(0.5 * torch.acos(cosine)), torch.tensor(roughness**2, dtype=table.dtype))
    return weight @ table.reshape(-1, 3) / weight.sum(1, keepdim=True)


def brdf_factors(n_dot_v: float, roughness: float, polar: int = 800, azimuth: int = 512) -> tuple[float, float]:
    """F1 and F2 by the midpoint rule over half vectors' polar angle (square-root spaced, dense at the peak) and azimuth."""
    s = (torch.arange(polar, dtype=torch.float64) + 0.5) / polar
    theta = s * s * (math.pi / 2)  # d theta = pi s ds
    phi = (torch.arange(azimuth, dtype=torch.float64) + 0.5) * (2 * math.pi / azimuth)
    theta, phi, s = theta[:, None], phi[None, :], s[:, None]
    sin_v = math.sqrt(1 - n_dot_v * n_dot_v)
    n_dot_h = theta.cos()
    v_dot_h = sin_v * theta.sin() * phi.cos() + n_dot_v * n_dot_h
    n_dot_l = 2 * v_dot_h * n_dot_h - n_dot_v
    lit = (v_dot_h > 0) & (n_dot_l > 0)
    alpha = torch.tensor(roughness**2, dtype=torch.float64)
    dv = ggx_d(n_dot_h, alpha, theta.sin() ** 2) * smith_v(n_dot_l.clamp(min=1e-9), torch.tensor(n_dot_v, dtype=torch.float64), alpha)
    # d omega_i = 4 v.h d omega_h
    measure = theta.sin() * (math.pi * s / polar) * (2 * math.pi / azimuth) * 4 * v_dot_h
    value = torch.where(lit, dv * n_dot_l * measure, torch.zeros_like(v_dot_h))
    fresnel = (1 - v_dot_h.clamp(0, 1)) ** 5
    return float((value * (1 - fresnel)).sum()), float((value * fresnel).sum())


def split_tables(tables: Tensor) -> tuple[list[Tensor], Tensor]:
    """The levels (rows, 2 rows, 3) of what filter_environment returns, and the table of irradiance over pi behind them."""
    parts = tables.split([2 * rows * rows for rows in (*(rows for _, rows in LEVELS), IRRADIANCE_ROWS)])
    *levels, irradiance = (part.reshape(math.isqrt(len(part) // 2), -1, 3) for part in parts)
    return levels, irradiance


def shade_split_sum(
    diffuse_albedo: Tensor,
    residual: Tensor,
    f0: Tensor,
    roughness: Tensor,
    normal: Tensor,
    wo: Tensor,
    tables: Tensor,
    factor_table: Tensor,
    transmittance: Tensor | None = None,
    hit_radiance: Tensor | None = None,
    open_share: Tensor | None = None,
) -> Tensor:
    """As drgs.reconstruct.fit.light.split_sum.shade_split_sum, with the table of F1 and F2, (2, roughness, n.v), as brdf_table returns it."""
    n_dot_v = (normal * wo).sum(-1)
    mirror = 2 * n_dot_v[:, None] * normal - wo
    tables_by_level, irradiance = split_tables(tables)
    reflected = [environment_radiance(Environment(level), mirror) for level in tables_by_level]
    steps = torch.tensor([r for r, _ in LEVELS], dtype=roughness.dtype)
    r = roughness.clamp(float(steps[0]), float(steps[-1]))
    below = (torch.searchsorted(steps, r.detach().contiguous(), right=True) - 1).clamp(0, len(LEVELS) - 2)
    fraction = ((r - steps[below]) / (steps[below + 1] - steps[below]))[:, None]
    levels = torch.stack(reflected, 1)
    index = torch.arange(len(r))
    lookup = levels[index, below] * (1 - fraction) + levels[index, below + 1] * fraction
    if transmittance is not None:
        lookup = lookup * transmittance[:, None]
    if hit_radiance is not None:
        lookup = lookup + hit_radiance
    f1, f2 = _bilinear(factor_table.to(roughness.dtype), roughness, n_dot_v)
    diffuse = diffuse_albedo * environment_radiance(Environment(irradiance), normal)
    if open_share is not None:
        diffuse = diffuse * open_share
    return diffuse + lookup * (f0 * f1[:, None] + f2[:, None]) + residual


def _bilinear(table: Tensor, row_place: Tensor, column_place: Tensor) -> tuple[Tensor, Tensor]:
    """Both layers of (2, size, size) at places in 0..1, between texel centres, clamped."""
    size = table.shape[-1]
    y, x = ((place * size - 0.5).clamp(0, size - 1) for place in (row_place, column_place))
    y0, x0 = (torch.floor(place.detach()).clamp(max=size - 2) for place in (y, x))
    fy, fx = y - y0, x - x0
    y0, x0 = y0.long(), x0.long()
    low = table[:, y0, x0] * (1 - fx) + table[:, y0, x0 + 1] * fx
    high = table[:, y0 + 1, x0] * (1 - fx) + table[:, y0 + 1, x0 + 1] * fx
    first, second = low * (1 - fy) + high * fy
    return first, second
