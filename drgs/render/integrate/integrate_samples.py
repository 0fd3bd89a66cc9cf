"""Outgoing radiance of shading points from sampled rays, differentiable: what stage 2 fits materials and light with.

    L_o = sum over a point's rays of f(wi, wo) (n.wi) weight L_i,   L_i = environment(wi) where the ray escapes, else hit_radiance

Same BRDF, lookup and weights as the integrators (integrator.py); here the gradient reaches normal, albedo, roughness, metallic and the environment's texels.
Directions, weights, visibility and hit radiance are constants (a detached estimator, unbiased in value and in gradient but for the
visibility's own). The gradient is written out: Warp's own adjoint takes four times as long, and is half of stage 2.
"""

from collections.abc import Sequence
from typing import Any

import torch
import warp as wp
from torch import Tensor

from drgs.maths.angles_warp import azimuth
from drgs.maths.constants import F0, MIN_ROUGHNESS
from drgs.maths.lat_long_warp import Texels, add_to_texels, texel_value, texels_at
from drgs.render.integrate.brdf_warp import PI
from drgs.render.records import Rays, ShadingPoints
from drgs.warp_torch import launch, launch_adding, warp_argument, warp_device

wp.set_module_options({"enable_backward": False})


@wp.func
def _texels_along(height: int, direction: wp.vec3) -> Texels:
    u = 0.5 - azimuth(direction[0], direction[1]) / (2.0 * PI)
    v = azimuth(direction[2], wp.sqrt(direction[0] * direction[0] + direction[1] * direction[1])) / PI
    return texels_at(0, height, u, v)


@wp.struct
class _Lobe:
    """The BRDF of one pair of directions, and what its gradient is made of."""

    h: wp.vec3
    n_dot_h: float
    n_dot_l: float
    n_dot_v: float
    a2: float
    denominator: float
    d: float
    root_v: float
    root_l: float
    v: float
    fresnel: float
    """(1 - h.v)^5"""
    reflectance: wp.vec3
    """Of all light, diffuse and mirrored."""


@wp.func
def _lobe(n: wp.vec3, v: wp.vec3, wi: wp.vec3, a: wp.vec3, roughness: float, m: float) -> _Lobe:
    # brdf_warp's formulas, for the gradient wants what is between.
    r = wp.max(roughness, MIN_ROUGHNESS)
    lobe = _Lobe()
    lobe.a2 = r * r * r * r
    lobe.h = wp.normalize(wi + v)
    lobe.n_dot_h = wp.clamp(wp.dot(n, lobe.h), 0.0, 1.0)
    lobe.n_dot_l = wp.max(wp.dot(n, wi), 1.0e-6)
    lobe.n_dot_v = wp.max(wp.dot(n, v), 1.0e-6)
    lobe.denominator = wp.length_sq(wp.cross(n, lobe.h)) + lobe.n_dot_h * lobe.n_dot_h * lobe.a2
    lobe.d = lobe.a2 / wp.max(PI * lobe.denominator * lobe.denominator, 1.0e-30)
    lobe.root_v = wp.sqrt(lobe.n_dot_v * lobe.n_dot_v * (1.0 - lobe.a2) + lobe.a2)
    lobe.root_l = wp.sqrt(lobe.n_dot_l * lobe.n_dot_l * (1.0 - lobe.a2) + lobe.a2)
    lobe.v = 0.5 / wp.max(lobe.n_dot_l * lobe.root_v + lobe.n_dot_v * lobe.root_l, 1.0e-12)
    c = 1.0 - wp.clamp(wp.dot(lobe.h, v), 0.0, 1.0)
    lobe.fresnel = c * c * c * c * c
    white = wp.vec3(1.0, 1.0, 1.0)
    f0 = white * (F0 * (1.0 - m)) + a * m
    mirrored = (f0 * (1.0 - lobe.fresnel) + white * lobe.fresnel) * (lobe.d * lobe.v)
    lobe.reflectance = a * ((1.0 - m) / PI) + mirrored
    return lobe


@wp.kernel
def radiance_of_rays(
    first: int,
    samples: int,
    height: int,
    wo: wp.array[wp.vec3],
    direction: wp.array[wp.vec3],
    weight: wp.array[float],
    transmittance: wp.array[float],
    hit_radiance: wp.array[wp.vec3],
    normal: wp.array[wp.vec3],
    albedo: wp.array[wp.vec3],
    roughness: wp.array[float],
    metallic: wp.array[float],
    table: wp.array[wp.vec3],
    # outputs
    radiance: wp.array[wp.vec3],
):
    """Many arguments because a struct of them would be filled anew, array by array, for each launch."""
    point = first + wp.tid()
    total = wp.vec3(0.0, 0.0, 0.0)
    for k in range(samples):
        i = point * samples + k
        if weight[i] != 0.0:
            wi = direction[i]
            lobe = _lobe(normal[point], wo[point], wi, albedo[point], roughness[point], metallic[point])
            incoming = texel_value(table, _texels_along(height, wi)) * transmittance[i] + hit_radiance[i]
            total += wp.cw_mul(lobe.reflectance, incoming) * (lobe.n_dot_l * weight[i])
    radiance[point] = total


@wp.kernel
def rays_adjoint(
    first: int,
    samples: int,
    height: int,
    wo: wp.array[wp.vec3],
    direction: wp.array[wp.vec3],
    weight: wp.array[float],
    transmittance: wp.array[float],
    hit_radiance: wp.array[wp.vec3],
    normal: wp.array[wp.vec3],
    albedo: wp.array[wp.vec3],
    roughness: wp.array[float],
    metallic: wp.array[float],
    table: wp.array[wp.vec3],
    radiance_gradient: wp.array[wp.vec3],
    # outputs
    normal_gradient: wp.array[wp.vec3],
    albedo_gradient: wp.array[wp.vec3],
    roughness_gradient: wp.array[float],
    metallic_gradient: wp.array[float],
    table_gradients: wp.array[wp.vec3],
):
    """Many arguments because a struct of them would be filled anew, array by array, for each launch."""
    point = first + wp.tid()
    n = normal[point]
    v = wo[point]
    a = albedo[point]
    m = metallic[point]
    g_normal = wp.vec3(0.0, 0.0, 0.0)
    g_albedo = wp.vec3(0.0, 0.0, 0.0)
    g_a2 = float(0.0)
    g_metallic = float(0.0)
    for k in range(samples):
        i = point * samples + k
        if weight[i] != 0.0:
            wi = direction[i]
            lobe = _lobe(n, v, wi, a, roughness[point], m)
            around = _texels_along(height, wi)
            g = radiance_gradient[point] * weight[i]
            g_incoming = wp.cw_mul(g, lobe.reflectance) * (lobe.n_dot_l * transmittance[i])
            add_to_texels(table_gradients, around, g_incoming)

            g_lit = wp.cw_mul(g, texel_value(table, around) * transmittance[i] + hit_radiance[i])
            g_reflectance = g_lit * lobe.n_dot_l
            g_l = wp.dot(g_lit, lobe.reflectance)
            dv = lobe.d * lobe.v
            g_albedo += g_reflectance * ((1.0 - m) / PI + m * (1.0 - lobe.fresnel) * dv)
            dielectric = wp.vec3(F0, F0, F0)
            g_metallic += wp.dot(g_reflectance, (a - dielectric) * ((1.0 - lobe.fresnel) * dv) - a / PI)
            white = wp.vec3(1.0, 1.0, 1.0)
            f0 = white * (F0 * (1.0 - m)) + a * m
            g_dv = wp.dot(g_reflectance, f0 * (1.0 - lobe.fresnel) + white * lobe.fresnel)

            # Of V = 1 / (2 (n.l root_v + n.v root_l))
            g_sum = -2.0 * lobe.v * lobe.v * g_dv * lobe.d
            by_v = g_sum * lobe.n_dot_l / lobe.root_v
            by_l = g_sum * lobe.n_dot_v / lobe.root_l
            g_l += g_sum * lobe.root_v + by_l * lobe.n_dot_l * (1.0 - lobe.a2)
            g_v = g_sum * lobe.root_l + by_v * lobe.n_dot_v * (1.0 - lobe.a2)
            g_a2 += 0.5 * (by_v * (1.0 - lobe.n_dot_v * lobe.n_dot_v) + by_l * (1.0 - lobe.n_dot_l * lobe.n_dot_l))

            # Of D = a2 / (pi denominator^2), its denominator |n x h|^2 + (n.h)^2 a2
            g_d = g_dv * lobe.v
            narrow = lobe.denominator < 1.0e-15  # where ggx_d is cut
            g_denominator = wp.where(narrow, 0.0, -2.0 * g_d * lobe.d / wp.max(lobe.denominator, 1.0e-15))
            g_a2 += g_d * lobe.d / lobe.a2 + g_denominator * lobe.n_dot_h * lobe.n_dot_h
            n_dot_h = wp.dot(n, lobe.h)
            within = wp.where(n_dot_h == lobe.n_dot_h, 1.0, 0.0)
            g_normal += (2.0 * g_denominator) * (n - n_dot_h * lobe.h + (within * lobe.n_dot_h * lobe.a2) * lobe.h)
            g_normal += wp.where(wp.dot(n, wi) > 1.0e-6, g_l, 0.0) * wi + wp.where(wp.dot(n, v) > 1.0e-6, g_v, 0.0) * v
    r = roughness[point]
    normal_gradient[point] = g_normal
    albedo_gradient[point] = g_albedo
    roughness_gradient[point] = wp.where(r > MIN_ROUGHNESS, 4.0 * r * r * r * g_a2, 0.0)
    metallic_gradient[point] = g_metallic


_DTYPES = (wp.vec3, wp.vec3, wp.float32, wp.float32, wp.vec3, wp.vec3, wp.vec3, wp.float32, wp.float32, wp.vec3)
_POINT_TYPES = (wp.vec3, wp.vec3, wp.float32, wp.float32)
"""Of normal, albedo, roughness and metallic, which come last but for the table."""


class _Radiance(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, height: int, samples: int, *given: Tensor) -> Tensor:
        inputs = [x.detach().contiguous() for x in given]
        ctx.height, ctx.samples = height, samples
        ctx.save_for_backward(*inputs)
        radiance = torch.empty_like(inputs[0])
        launch(radiance_of_rays, len(radiance), _arguments(ctx, inputs), [warp_argument(radiance, wp.vec3)], warp_device(radiance))
        return radiance

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        inputs, gradient = ctx.saved_tensors, gradient.contiguous()
        of_points = [torch.empty_like(x) for x in inputs[5:-1]]
        values = [*_arguments(ctx, inputs), warp_argument(gradient, wp.vec3)]
        outputs = [warp_argument(x, dtype) for x, dtype in zip(of_points, _POINT_TYPES, strict=True)]
        of_table = launch_adding(rays_adjoint, len(gradient), values, outputs, [(inputs[-1], wp.vec3)], warp_device(gradient))
        return None, None, *[None] * 5, *of_points, *of_table


def _arguments(ctx: Any, inputs: Sequence[Tensor]) -> list:
    return [ctx.samples, ctx.height, *(warp_argument(x, dtype) for x, dtype in zip(inputs, _DTYPES, strict=True))]


def integrate_samples(
    points: ShadingPoints, rays: Rays, transmittance: Tensor, hit_radiance: Tensor, environment_radiance: Tensor
) -> Tensor:
    """(point, 3) linear radiance towards wo; differentiable in the points' normal and materials and in the environment.

    Args:
        transmittance: (point, sample) transmittance of each ray, 0..1. hit_radiance: (point, sample, 3) radiance of what it met, already times
            1 - transmittance. environment_radiance: (height, 2 height, 3).
    """
    return _Radiance.apply(
        environment_radiance.shape[0], rays.weight.shape[1], points.wo_world, rays.direction_world.reshape(-1, 3), rays.weight.reshape(-1),
        transmittance.reshape(-1), hit_radiance.reshape(-1, 3), points.normal_world, points.albedo, points.roughness, points.metallic,
        environment_radiance.reshape(-1, 3),
    )  # fmt: skip
