"""Deferred reflection-aware shading for stage 1: the split-sum approximation under a learned HDR environment.

    L_o = c_d I(n) + S(omega_r, r) (F0 F1 + F2) + residual

c_d = (1 - m) a is the diffuse albedo and I the irradiance over pi, both S and I unshadowed: the residual takes up shadows and
inter-reflection. S is the environment filtered by the GGX lobe of roughness r about the mirror direction, F1 and F2 the usual two integrals of the BRDF
over (n.v, r). On a lat-long table the filter commutes with turns about z: it is a circular convolution along u, so one small matrix a
frequency, computed once. The lookup is a Warp kernel, differentiated by hand (split_sum_kernels.py). All radiance is linear. Stage 1 and the
surface's fit: the renderer and stage 2 integrate the full equation instead.
Source: Karis 2013, with the BRDF of drgs/maths/brdf.py (docs/sources.md: karis2013); its use for Gaussians: yao2025.
"""

import math
from collections.abc import Sequence
from functools import cache
from typing import Any

import torch
import warp as wp
from jaxtyping import Float
from torch import Tensor

from drgs.maths.brdf import ggx_d, smith_v
from drgs.reconstruct.fit.light.split_sum_kernels import (
    IRRADIANCE_ROWS,
    LEVELS,
    OFFSETS,
    TABLE_SIZE,
    split_sum_adjoint,
    split_sum_kernel,
)
from drgs.scene.environment import direction_from_uv
from drgs.warp_torch import launch, launch_adding, warp_argument, warp_device

ENVIRONMENT_SIZE = (128, 256)
"""Rows and columns of the learned table."""


def texel_directions(rows: int) -> Float[Tensor, "{rows} 2*{rows} 3"]:
    """(rows, 2 rows, 3) unit directions through the texel centres."""
    v = (torch.arange(rows) + 0.5) / rows
    u = (torch.arange(2 * rows) + 0.5) / (2 * rows)
    return direction_from_uv(torch.stack([u.expand(rows, -1), v[:, None].expand(-1, 2 * rows)], -1))


def texel_solid_angles(rows: int) -> Float[Tensor, "{rows}"]:
    """(rows,) solid angle of one texel of each row [sr]."""
    edges = torch.arange(rows + 1, dtype=torch.float64) * math.pi / rows
    return ((edges[:-1].cos() - edges[1:].cos()) * (math.pi / rows)).float()


@cache
def _filter_spectra(roughness: float | None, rows: int) -> Float[Tensor, "frequency {rows} {rows}"]:
    """(frequency, rows in, rows out) real: the lobe's weights, Fourier-transformed along u (they are even in u); None: the cosine lobe."""
    directions = texel_directions(rows).double()
    target = directions[:, 0]  # one column of output texels stands for all
    cosine = torch.einsum("ic,jkc->ijk", target, directions).clamp(-1, 1)
    weight = cosine.clamp(min=0) * texel_solid_angles(rows).double()[None, :, None]
    if roughness is not None:
        weight = weight * ggx_d(((1 + cosine) / 2).sqrt(), torch.tensor(roughness**2, dtype=torch.float64))
    weight = weight / weight.sum((1, 2), keepdim=True)
    return torch.fft.rfft(weight, dim=-1).real.permute(2, 1, 0).float().contiguous()


@cache
def _exchanged_spectra(roughness: float | None, rows: int) -> Float[Tensor, "frequency {rows} {rows}"]:
    """_filter_spectra, (frequency, rows out, rows in)."""
    return _filter_spectra(roughness, rows).mT.contiguous()


def filter_environment(radiance: Float[Tensor, "128 256 3"]) -> Float[Tensor, "texel 3"]:
    """(texel, 3): the tables of LEVELS and the irradiance over pi, one after the other, of a table (128, 256, 3) of linear radiance; differentiable."""
    pyramid = {ENVIRONMENT_SIZE[0]: radiance.permute(2, 0, 1)}
    for rows in (64, 32, 16):
        # Area weights matter only near the poles, where neighbouring rows differ in size.
        area = texel_solid_angles(2 * rows).to(radiance.device)[:, None]
        fine = pyramid[2 * rows] * area
        pyramid[rows] = torch.nn.functional.avg_pool2d(fine, 2) / torch.nn.functional.avg_pool2d(area[None], (2, 1))
    filtered = [_Filtered.apply(pyramid[rows], roughness) for roughness, rows in (*LEVELS[1:], (None, IRRADIANCE_ROWS))]
    return torch.cat([radiance.reshape(-1, 3), *(table.permute(1, 2, 0).reshape(-1, 3) for table in filtered)])


def _convolved(table: Float[Tensor, "3 rows columns"], operator: Float[Tensor, "frequency rows rows"]) -> Float[Tensor, "3 rows columns"]:
    """Along u with the weights whose spectra the operator holds, for each row in and out."""
    spectrum = torch.fft.rfft(table, dim=-1)  # (3, rows, frequency)
    # Few rows times a matrix, laid out one after the other: half the time of the matrix times few columns, a tenth of strided ones.
    both = torch.cat([spectrum.real, spectrum.imag]).permute(2, 0, 1).contiguous()  # (frequency, 6, rows in)
    filtered = (both @ operator).permute(1, 2, 0)
    return torch.fft.irfft(torch.complex(filtered[:3], filtered[3:]), n=table.shape[-1], dim=-1)


class _Filtered(torch.autograd.Function):
    """_convolved by a lobe. The weights are even in u, so the gradient is convolved by the same ones, rows in and out exchanged: left to autograd, that
    went matrix by matrix and took 5.3 ms where this takes 2.9."""

    @staticmethod
    def forward(ctx: Any, table: Tensor, roughness: float | None) -> Tensor:
        ctx.roughness = roughness
        return _convolved(table.detach(), _filter_spectra(roughness, table.shape[1]).to(table.device))

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        return _convolved(gradient.contiguous(), _exchanged_spectra(ctx.roughness, gradient.shape[1]).to(gradient.device)), None


def level_table(tables: Float[Tensor, "texel 3"], level: int) -> Float[Tensor, "rows columns 3"]:
    """The table of one of LEVELS, of what filter_environment gave."""
    rows, start = LEVELS[level][1], OFFSETS[level]
    return tables[start : start + 2 * rows * rows].view(rows, 2 * rows, 3)


@cache
def brdf_table(size: int = TABLE_SIZE, samples: int = 1024) -> Float[Tensor, "2 {size} {size}"]:
    """(2, roughness, n.v): F1 and F2 with reflectance = F0 F1 + F2, by GGX-distributed half vectors (stratified), texel centres."""
    centers = (torch.arange(size, dtype=torch.float64) + 0.5) / size
    n_dot_v = centers[None, :, None]
    alpha = (centers**2)[:, None, None]
    k = torch.arange(samples, dtype=torch.float64)
    u1, u2 = (k + 0.5) / samples, (k * 0.6180339887498949) % 1
    cos_h = ((1 - u1) / (1 + (alpha * alpha - 1) * u1)).sqrt()
    sin_h = (1 - cos_h * cos_h).clamp(min=0).sqrt()
    sin_v = (1 - n_dot_v * n_dot_v).sqrt()
    v_dot_h = (sin_v * sin_h * (2 * math.pi * u2).cos() + n_dot_v * cos_h).clamp(min=0)
    n_dot_l = 2 * v_dot_h * cos_h - n_dot_v
    visible = torch.where(n_dot_l > 0, 4 * smith_v(n_dot_l.clamp(min=1e-6), n_dot_v, alpha) * n_dot_l * v_dot_h / cos_h, 0.0)
    fresnel = (1 - v_dot_h) ** 5
    return torch.stack([((1 - fresnel) * visible).mean(-1), (fresnel * visible).mean(-1)]).float()


@cache
def factor_table(device: torch.device) -> Float[Tensor, "texel 2"]:
    """brdf_table as kernels read it."""
    return brdf_table(TABLE_SIZE).permute(1, 2, 0).reshape(-1, 2).contiguous().to(device)


class _SplitSum(torch.autograd.Function):
    @staticmethod
    def forward(ctx, diffuse_albedo, residual, f0, roughness, normal, wo, transmittance, hit_radiance, open_share, tables, factor_table):
        inputs = [
            x.detach().contiguous()
            for x in (diffuse_albedo, residual, f0, roughness, normal, wo, transmittance, hit_radiance, open_share, tables, factor_table)
        ]
        ctx.save_for_backward(*inputs)
        radiance = torch.empty_like(inputs[0])
        launch(split_sum_kernel, len(radiance), _arguments(inputs), [warp_argument(radiance, wp.vec3)], warp_device(radiance))
        return radiance

    @staticmethod
    def backward(ctx, gradient):
        inputs, gradient = ctx.saved_tensors, gradient.contiguous()
        points = [torch.empty_like(inputs[k]) for k in (0, 2, 3, 4)]
        given = [*_arguments(inputs), warp_argument(gradient, wp.vec3)]
        outputs = [warp_argument(x, dtype) for x, dtype in zip(points, _POINT_TYPES, strict=True)]
        (tables,) = launch_adding(split_sum_adjoint, len(gradient), given, outputs, [(inputs[9], wp.vec3)], warp_device(gradient))
        diffuse, f0, roughness, normal = points
        return diffuse, gradient, f0, roughness, normal, None, None, None, None, tables, None


_DTYPES = (wp.vec3, wp.vec3, wp.vec3, wp.float32, wp.vec3, wp.vec3, wp.float32, wp.vec3, wp.vec3, wp.vec3, wp.vec2)
_POINT_TYPES = (wp.vec3, wp.vec3, wp.float32, wp.vec3)


def _arguments(inputs: Sequence[Tensor]) -> list:
    return [warp_argument(x, dtype) for x, dtype in zip(inputs, _DTYPES, strict=True)]


def shade_split_sum(
    diffuse_albedo: Float[Tensor, "point 3"],
    residual: Float[Tensor, "point 3"],
    f0: Float[Tensor, "point 3"],
    roughness: Float[Tensor, "point"],
    normal: Float[Tensor, "point 3"],
    wo: Float[Tensor, "point 3"],
    tables: Float[Tensor, "texel 3"],
    transmittance: Float[Tensor, "point"] | None = None,
    hit_radiance: Float[Tensor, "point 3"] | None = None,
    open_share: Float[Tensor, "point 3"] | None = None,
    light_from_world: Float[Tensor, "3 3"] | None = None,
) -> Float[Tensor, "point 3"]:
    """(point, 3) linear radiance towards wo; differentiable in all but wo. May be negative where the residual is.

    Args:
        diffuse_albedo: (point, 3) (1 - m) a. residual: (point, 3) radiance. f0: (point, 3). roughness: (point,).
        normal, wo: (point, 3) unit, world. tables: of filter_environment.
        transmittance: 1 where a mirrored ray sees the environment; hit_radiance: what it meets elsewhere, 0 where it does not. None: nothing is met.
        open_share: of the open sky's irradiance that arrives; None: all of it.
        light_from_world: rotation of directions in the world to those of the tables; None: the same.
    """
    if light_from_world is not None:
        normal, wo = normal @ light_from_world.T, wo @ light_from_world.T
    if transmittance is None:
        transmittance = torch.ones_like(roughness)
    if hit_radiance is None:
        hit_radiance = torch.zeros_like(f0)
    if open_share is None:
        open_share = torch.ones_like(f0)
    return _SplitSum.apply(
        diffuse_albedo, residual, f0, roughness, normal, wo, transmittance, hit_radiance, open_share, tables, factor_table(f0.device)
    )
