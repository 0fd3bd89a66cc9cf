"""Deferred reflection-aware shading for stage 1: the split-sum approximation under a learned HDR environment.

    L_o = c_d I(n) + S(omega_r, r) (F0 F1 + F2) + residual

c_d = (1 - m) a is the diffuse albedo and I the irradiance over pi, both S and I unshadowed: the residual takes up shadows and
inter-reflection. S is the environment filtered by the GGX lobe of roughness r about the mirror direction, F1 and F2 the usual two integrals of the BRDF
over (n.v, r). On a lat-long table the filter commutes with turns about z: it is a circular convolution along u, so one small matrix a
frequency, computed once. The lookup is a Warp kernel, differentiated by Warp. All radiance is linear. Stage 1 only: the renderer and stage 2 integrate the full equation instead.
Source: Karis 2013, with the BRDF of drgs/maths/brdf.py (docs/sources.md: karis2013); its use for Gaussians: yao2025.
"""

import math
from functools import cache
from typing import Any

import torch
import warp as wp
from jaxtyping import Float
from torch import Tensor

from drgs.maths.brdf import ggx_d, smith_v
from drgs.scene.environment import direction_from_uv
from drgs.warp_torch import FEWEST_FOR_THREADS, gradient_slices, in_gradient_slices, load_kernel, warp_argument, warp_device

ENVIRONMENT_SIZE = (128, 256)
"""Rows and columns of the learned table."""
LEVELS = ((0.05, 128), (0.2, 128), (0.35, 64), (0.5, 32), (0.7, 16), (1.0, 16))
"""(roughness, rows) of each filtered table; between them the lookup is linear in roughness. The first is the environment itself."""
IRRADIANCE_ROWS = 16
"""Of the last table: the cosine-weighted mean of the environment about a normal."""
_OFFSETS = tuple(sum(2 * rows * rows for _, rows in LEVELS[:k]) for k in range(len(LEVELS)))
IRRADIANCE_START = sum(2 * rows * rows for _, rows in LEVELS)
_ROUGHNESS = wp.constant(wp.types.vector(length=len(LEVELS), dtype=float)(*(r for r, _ in LEVELS)))
_ROWS = wp.constant(wp.types.vector(length=len(LEVELS), dtype=wp.int32)(*(rows for _, rows in LEVELS)))
_OFFSET = wp.constant(wp.types.vector(length=len(LEVELS), dtype=wp.int32)(*_OFFSETS))
_LEVEL_COUNT = wp.constant(len(LEVELS))
_IRRADIANCE_ROWS = wp.constant(IRRADIANCE_ROWS)
_IRRADIANCE_START = wp.constant(IRRADIANCE_START)
_TABLE_SIZE = 32


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


def filter_environment(radiance: Float[Tensor, "128 256 3"]) -> Float[Tensor, "texel 3"]:
    """(texel, 3): the tables of LEVELS and the irradiance over pi, one after the other, of a table (128, 256, 3) of linear radiance; differentiable."""
    pyramid = {ENVIRONMENT_SIZE[0]: radiance.permute(2, 0, 1)}
    for rows in (64, 32, 16):
        # Area weights matter only near the poles, where neighbouring rows differ in size.
        area = texel_solid_angles(2 * rows).to(radiance.device)[:, None]
        fine = pyramid[2 * rows] * area
        pyramid[rows] = torch.nn.functional.avg_pool2d(fine, 2) / torch.nn.functional.avg_pool2d(area[None], (2, 1))
    tables = [radiance.reshape(-1, 3)]
    for roughness, rows in (*LEVELS[1:], (None, IRRADIANCE_ROWS)):
        spectrum = torch.fft.rfft(pyramid[rows], dim=-1)  # (3, rows, frequency)
        operator = _filter_spectra(roughness, rows).to(radiance.device)
        # Few rows times a matrix, laid out one after the other: half the time of the matrix times few columns, a tenth of strided ones.
        both = torch.cat([spectrum.real, spectrum.imag]).permute(2, 0, 1).contiguous()  # (frequency, 6, rows in)
        filtered = (both @ operator).permute(1, 2, 0)
        tables.append(torch.fft.irfft(torch.complex(filtered[:3], filtered[3:]), n=2 * rows, dim=-1).permute(1, 2, 0).reshape(-1, 3))
    return torch.cat(tables)


def level_table(tables: Float[Tensor, "texel 3"], level: int) -> Float[Tensor, "rows columns 3"]:
    """The table of one of LEVELS, of what filter_environment gave."""
    rows, start = LEVELS[level][1], _OFFSETS[level]
    return tables[start : start + 2 * rows * rows].view(rows, 2 * rows, 3)


@cache
def brdf_table(size: int = 32, samples: int = 1024) -> Float[Tensor, "2 {size} {size}"]:
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


@wp.func
def _uv(direction: wp.vec3) -> wp.vec2:
    # atan2 and acos have no derivative at the poles; a nudge of 1e-6 is a millionth of a turn.
    u = 0.5 - wp.atan2(direction[1], direction[0] + 1.0e-8) / (2.0 * wp.pi)
    return wp.vec2(u, wp.acos(wp.clamp(direction[2], -0.999999, 0.999999)) / wp.pi)


@wp.func
def _table_value(tables: wp.array[wp.vec3], start: int, rows: int, u: float, v: float) -> wp.vec3:
    columns = 2 * rows
    x = u * float(columns) - 0.5
    y = wp.clamp(v * float(rows) - 0.5, 0.0, float(rows) - 1.0)
    x_floor = wp.floor(x)
    y_floor = wp.min(wp.floor(y), float(rows) - 2.0)
    fx = x - x_floor
    fy = y - y_floor
    column0 = (int(x_floor) + columns) % columns
    column1 = (column0 + 1) % columns
    row = start + int(y_floor) * columns
    top = tables[row + column0] * (1.0 - fx) + tables[row + column1] * fx
    bottom = tables[row + columns + column0] * (1.0 - fx) + tables[row + columns + column1] * fx
    return top * (1.0 - fy) + bottom * fy


@wp.func
def _factors(table: wp.array[wp.vec2], n_dot_v: float, roughness: float) -> wp.vec2:
    last = float(_TABLE_SIZE) - 1.0
    x = wp.clamp(n_dot_v * float(_TABLE_SIZE) - 0.5, 0.0, last)
    y = wp.clamp(roughness * float(_TABLE_SIZE) - 0.5, 0.0, last)
    x_floor = wp.min(wp.floor(x), last - 1.0)
    y_floor = wp.min(wp.floor(y), last - 1.0)
    fx = x - x_floor
    fy = y - y_floor
    k = int(y_floor) * _TABLE_SIZE + int(x_floor)
    low = table[k] * (1.0 - fx) + table[k + 1] * fx
    high = table[k + _TABLE_SIZE] * (1.0 - fx) + table[k + _TABLE_SIZE + 1] * fx
    return low * (1.0 - fy) + high * fy


@wp.func
def _level_below(r: float) -> int:
    # A sum, not a loop that assigns: the adjoint of a kernel does not restore variables assigned under a condition.
    level = wp.where(r >= _ROUGHNESS[1], 1, 0) + wp.where(r >= _ROUGHNESS[2], 1, 0)
    return level + wp.where(r >= _ROUGHNESS[3], 1, 0) + wp.where(r >= _ROUGHNESS[4], 1, 0)


@wp.kernel
def split_sum_kernel(
    first: int,
    diffuse_albedo: wp.array[wp.vec3],
    residual: wp.array[wp.vec3],
    f0: wp.array[wp.vec3],
    roughness: wp.array[float],
    normal: wp.array[wp.vec3],
    wo: wp.array[wp.vec3],
    transmittance: wp.array[float],
    hit_radiance: wp.array[wp.vec3],
    open_share: wp.array[wp.vec3],
    tables: wp.array[wp.vec3],
    factor_table: wp.array[wp.vec2],
    # outputs
    radiance: wp.array[wp.vec3],
):
    """Many arguments because Warp differentiates arrays, not structs of them."""
    i = first + wp.tid()
    n_dot_v = wp.dot(normal[i], wo[i])
    mirror = 2.0 * n_dot_v * normal[i] - wo[i]
    uv = _uv(mirror)
    r = wp.clamp(roughness[i], _ROUGHNESS[0], _ROUGHNESS[_LEVEL_COUNT - 1])
    level = _level_below(r)
    fraction = (r - _ROUGHNESS[level]) / (_ROUGHNESS[level + 1] - _ROUGHNESS[level])
    near = _table_value(tables, _OFFSET[level], _ROWS[level], uv[0], uv[1])
    far = _table_value(tables, _OFFSET[level + 1], _ROWS[level + 1], uv[0], uv[1])
    reflected = (near * (1.0 - fraction) + far * fraction) * transmittance[i] + hit_radiance[i]
    factors = _factors(factor_table, n_dot_v, roughness[i])
    about = _uv(normal[i])
    irradiance = _table_value(tables, _IRRADIANCE_START, _IRRADIANCE_ROWS, about[0], about[1])
    irradiance = wp.cw_mul(irradiance, open_share[i])
    specular = wp.cw_mul(reflected, f0[i] * factors[0] + wp.vec3(factors[1], factors[1], factors[1]))
    radiance[i] = wp.cw_mul(diffuse_albedo[i], irradiance) + specular + residual[i]


class _SplitSum(torch.autograd.Function):
    @staticmethod
    def forward(ctx, diffuse_albedo, residual, f0, roughness, normal, wo, transmittance, hit_radiance, open_share, tables, factor_table):
        inputs = [
            x.detach().contiguous()
            for x in (diffuse_albedo, residual, f0, roughness, normal, wo, transmittance, hit_radiance, open_share, tables, factor_table)
        ]
        ctx.save_for_backward(*inputs)
        radiance = torch.empty_like(inputs[0])
        _launch_slices(inputs, radiance, None, None)
        return radiance

    @staticmethod
    def backward(ctx, gradient):
        inputs = ctx.saved_tensors
        point_gradients = [torch.zeros_like(x) for x in inputs[:5]]
        table_gradients = torch.zeros(gradient_slices(), *inputs[9].shape, device=gradient.device)
        _launch_slices(inputs, gradient.contiguous(), point_gradients, table_gradients)
        return *point_gradients, None, None, None, None, table_gradients.sum(0), None


_DTYPES = (wp.vec3, wp.vec3, wp.vec3, wp.float32, wp.vec3, wp.vec3, wp.float32, wp.vec3, wp.vec3, wp.vec3, wp.vec2)


def _launch_slices(
    inputs, radiance: Float[Tensor, "point 3"], point_gradients: list[Tensor] | None, table_gradients: Float[Tensor, "slice texel 3"] | None
) -> None:
    """Forward, or with gradients the adjoint (then `radiance` holds its gradient)."""
    device, count = warp_device(radiance), len(radiance)
    if count == 0:
        return
    arrays = [warp_argument(x, dtype) for x, dtype in zip(inputs, _DTYPES, strict=True)]
    out = warp_argument(radiance, wp.vec3)
    load_kernel(split_sum_kernel, device)
    if point_gradients is None and count < FEWEST_FOR_THREADS:
        wp.launch(split_sum_kernel, dim=count, inputs=[0, *arrays], outputs=[out], device=device)
        return

    # No function within this one: under test each call would check its definition anew.
    in_gradient_slices(
        lambda k, slices: _launch_slice(k, slices, count, arrays, out, device, point_gradients, table_gradients), device, count
    )


def _launch_slice(
    k: int,
    slices: int,
    count: int,
    arrays: list,
    out: Any,
    device: Any,
    point_gradients: list[Tensor] | None,
    table_gradients: Float[Tensor, "slice texel 3"] | None,
) -> None:
    """One of so many parts of the points; with gradients, into that slice of the tables'."""
    first, last = count * k // slices, count * (k + 1) // slices
    if point_gradients is None or table_gradients is None:
        wp.launch(split_sum_kernel, dim=last - first, inputs=[first, *arrays], outputs=[out], device=device)
        return
    adjoints = [warp_argument(x, dtype) for x, dtype in zip(point_gradients, _DTYPES, strict=False)]
    wp.launch(
        split_sum_kernel, dim=last - first, inputs=[first, *arrays], outputs=[out], device=device, adjoint=True,
        adj_inputs=[0, *adjoints, None, None, None, None, warp_argument(table_gradients[k], wp.vec3), None], adj_outputs=[out],
    )  # fmt: skip


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
    factor_table = brdf_table(_TABLE_SIZE).permute(1, 2, 0).reshape(-1, 2).to(f0.device)
    if transmittance is None:
        transmittance = torch.ones_like(roughness)
    if hit_radiance is None:
        hit_radiance = torch.zeros_like(f0)
    if open_share is None:
        open_share = torch.ones_like(f0)
    return _SplitSum.apply(
        diffuse_albedo, residual, f0, roughness, normal, wo, transmittance, hit_radiance, open_share, tables, factor_table
    )
