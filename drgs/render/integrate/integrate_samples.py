"""Outgoing radiance of shading points from sampled rays, differentiable: what stage 2 fits materials and light with.

    L_o = sum over a point's rays of f(wi, wo) (n.wi) weight L_i,   L_i = environment(wi) where the ray escapes, else hit_radiance

Same BRDF, lookup and weights as the integrators (integrator.py); here the gradient reaches normal, albedo, roughness, metallic and the environment's texels.
Directions, weights, visibility and hit radiance are constants (a detached estimator, unbiased in value and in gradient but for the
visibility's own). Differentiated by Warp, so nothing is assigned under a condition (the adjoint would not undo it).
"""

from collections.abc import Sequence
from typing import Any

import torch
import warp as wp
from torch import Tensor

from drgs.maths.constants import F0, MIN_ROUGHNESS
from drgs.render.integrate.brdf_warp import PI, ggx_d, smith_v
from drgs.render.records import Rays, ShadingPoints
from drgs.warp_torch import gradient_slices, in_gradient_slices, load_kernel, warp_argument, warp_device


@wp.func
def table_radiance(table: wp.array[wp.vec3], height: int, direction: wp.vec3) -> wp.vec3:
    width = 2 * height
    u = 0.5 - wp.atan2(direction[1], direction[0]) / (2.0 * PI)
    v = wp.atan2(wp.sqrt(direction[0] * direction[0] + direction[1] * direction[1]), direction[2]) / PI
    x = u * float(width) - 0.5
    y = wp.clamp(v * float(height) - 0.5, 0.0, float(height) - 1.0)
    x_floor = wp.floor(x)
    y_floor = wp.min(wp.floor(y), float(height) - 2.0)
    fx = x - x_floor
    fy = y - y_floor
    column0 = (int(x_floor) + width) % width
    column1 = (column0 + 1) % width
    row = int(y_floor) * width
    top = table[row + column0] * (1.0 - fx) + table[row + column1] * fx
    bottom = table[row + width + column0] * (1.0 - fx) + table[row + width + column1] * fx
    return top * (1.0 - fy) + bottom * fy


@wp.kernel
def ray_contributions(
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
    contribution: wp.array[wp.vec3],
):
    """Many arguments because Warp differentiates arrays, not structs of them."""
    i = first + wp.tid()
    point = i / samples
    n = normal[point]
    v = wo[point]
    wi = direction[i]
    m = metallic[point]
    a = albedo[point]
    r = wp.max(roughness[point], MIN_ROUGHNESS)
    alpha = r * r
    h = wp.normalize(wi + v)
    n_dot_l = wp.max(wp.dot(n, wi), 1.0e-6)
    n_dot_v = wp.max(wp.dot(n, v), 1.0e-6)
    dv = ggx_d(wp.clamp(wp.dot(n, h), 0.0, 1.0), wp.length_sq(wp.cross(n, h)), alpha) * smith_v(n_dot_l, n_dot_v, alpha)
    c = 1.0 - wp.clamp(wp.dot(h, v), 0.0, 1.0)
    c5 = c * c * c * c * c
    white = wp.vec3(1.0, 1.0, 1.0)
    f0 = white * (F0 * (1.0 - m)) + a * m
    reflectance = a * ((1.0 - m) / PI) + (f0 * (1.0 - c5) + white * c5) * dv
    incoming = table_radiance(table, height, wi) * transmittance[i] + hit_radiance[i]
    contribution[i] = wp.cw_mul(reflectance, incoming) * (n_dot_l * weight[i])


_DTYPES = (wp.vec3, wp.vec3, wp.float32, wp.float32, wp.vec3, wp.vec3, wp.vec3, wp.float32, wp.float32, wp.vec3)
_DIFFERENTIABLE = 5
"""The last five inputs: normal, albedo, roughness, metallic, table."""


class _Contributions(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, height: int, *given: Tensor) -> Tensor:
        inputs = [x.detach().contiguous() for x in given]
        ctx.height = height
        ctx.save_for_backward(*inputs)
        contribution = torch.empty_like(inputs[1])
        _launch(height, inputs, contribution, None)
        return contribution

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        inputs = ctx.saved_tensors
        point_gradients = [torch.zeros_like(x) for x in inputs[-_DIFFERENTIABLE:-1]]
        table_gradients = torch.zeros(gradient_slices(), *inputs[-1].shape, device=gradient.device)
        _launch(ctx.height, inputs, gradient.contiguous(), (point_gradients, table_gradients))
        return None, *[None] * (len(inputs) - _DIFFERENTIABLE), *point_gradients, table_gradients.sum(0)


def _launch(height: int, inputs: Sequence[Tensor], contribution: Tensor, gradients: tuple[list[Tensor], Tensor] | None) -> None:
    """Forward; or, with `gradients` of the points and slices of the table's to be added to, backward: then `contribution` is its gradient."""
    device, points = warp_device(contribution), len(inputs[0])
    if points == 0:
        return
    samples = len(contribution) // points
    arrays = [warp_argument(x, dtype) for x, dtype in zip(inputs, _DTYPES, strict=True)]
    out = warp_argument(contribution, wp.vec3)
    load_kernel(ray_contributions, device)

    def run(k: int, slices: int) -> None:
        # Slices end between points, so no two threads add to one point's gradient.
        first, last = points * k // slices * samples, points * (k + 1) // slices * samples
        values = [first, samples, height, *arrays]
        if gradients is None:
            wp.launch(ray_contributions, dim=last - first, inputs=values, outputs=[out], device=device)
            return
        point_gradients, table_gradients = gradients
        adjoints = [warp_argument(x, dtype) for x, dtype in zip(point_gradients, _DTYPES[-_DIFFERENTIABLE:-1], strict=True)]
        wp.launch(
            ray_contributions, dim=last - first, inputs=values, outputs=[out], device=device, adjoint=True,
            adj_inputs=[0, 0, 0, *[None] * (len(arrays) - _DIFFERENTIABLE), *adjoints, warp_argument(table_gradients[k], wp.vec3)], adj_outputs=[out],
        )  # fmt: skip

    in_gradient_slices(run, device, points * samples)


def integrate_samples(
    points: ShadingPoints, rays: Rays, transmittance: Tensor, hit_radiance: Tensor, environment_radiance: Tensor
) -> Tensor:
    """(point, 3) linear radiance towards wo; differentiable in the points' normal and materials and in the environment.

    Args:
        transmittance: (point, sample) transmittance of each ray, 0..1. hit_radiance: (point, sample, 3) radiance of what it met, already times
            1 - transmittance. environment_radiance: (height, 2 height, 3).
    """
    count, samples = rays.weight.shape
    contribution = _Contributions.apply(
        environment_radiance.shape[0], points.wo_world, rays.direction_world.reshape(-1, 3), rays.weight.reshape(-1),
        transmittance.reshape(-1), hit_radiance.reshape(-1, 3), points.normal_world, points.albedo, points.roughness, points.metallic,
        environment_radiance.reshape(-1, 3),
    )  # fmt: skip
    return contribution.view(count, samples, 3).sum(1)
