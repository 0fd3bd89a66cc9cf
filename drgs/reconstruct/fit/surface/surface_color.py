"""What places of a mesh look like in a photograph, from the numbers at its vertices: split sum and the display's curve in one kernel.

A step of the surface's fit shades some ten thousand places and goes back through it. As separate operations, each reading and writing all places, that
took three times as long. Gradients are written out (split_sum_kernels.py) and added where vertices and the light's tables are.

In: places of pixels on the mesh, numbers of its vertices, the filtered light. Out: (place, 3) colours in display space; gradients reach the numbers
of the vertices, the tables and, where it wants one, the share of the open sky's irradiance that arrives.
"""

from typing import Any

import torch
import warp as wp
from jaxtyping import Float, Int
from torch import Tensor

from drgs.reconstruct.fit.image_terms import SATURATED, display_slope, display_value
from drgs.reconstruct.fit.light.mesh_light import MeshLight
from drgs.reconstruct.fit.light.mesh_light_kernels import base_f0, normal_at, rotation_of, vector_at
from drgs.reconstruct.fit.light.split_sum import factor_table
from drgs.reconstruct.fit.light.split_sum_kernels import gradients_of_point, radiance_of_point
from drgs.warp_torch import launch, launch_adding, warp_argument, warp_device

wp.set_module_options({"enable_backward": False})

NUMBERS = 8
"""Of a vertex: normal, albedo, roughness, metallic."""


@wp.struct
class _Seen:
    """One place."""

    corner: wp.vec3i
    weight: wp.vec3
    blended: wp.vec3
    """Normal before it has unit length."""
    normal: wp.vec3
    albedo: wp.vec3
    roughness: float
    metallic: float
    diffuse: wp.vec3
    f0: wp.vec3
    open_share: wp.vec3


@wp.func
def _seen(
    i: int, corners: wp.array2d[wp.int64], weights: wp.array[wp.vec3], surface: wp.array2d[float], open_share: wp.array[wp.vec3]
) -> _Seen:
    place = _Seen()
    place.corner = wp.vec3i(int(corners[i, 0]), int(corners[i, 1]), int(corners[i, 2]))
    place.weight = weights[i]
    albedo = wp.vec3(0.0, 0.0, 0.0)
    blended = wp.vec3(0.0, 0.0, 0.0)
    roughness = float(0.0)
    metallic = float(0.0)
    for k in range(3):
        c = place.corner[k]
        w = place.weight[k]
        blended += w * wp.vec3(surface[c, 0], surface[c, 1], surface[c, 2])
        albedo += w * wp.vec3(surface[c, 3], surface[c, 4], surface[c, 5])
        roughness += w * surface[c, 6]
        metallic += w * surface[c, 7]
    place.blended = blended
    place.normal = normal_at(blended)
    place.albedo = albedo
    place.roughness = roughness
    place.metallic = metallic
    place.diffuse = albedo * (1.0 - metallic)
    place.f0 = base_f0(albedo, metallic)
    place.open_share = vector_at(open_share, place.corner, place.weight)
    return place


@wp.kernel
def color_kernel(
    first: int,
    corners: wp.array2d[wp.int64],
    weights: wp.array[wp.vec3],
    wo: wp.array[wp.vec3],
    transmittance: wp.array[float],
    met: wp.array[wp.vec3],
    photo: wp.array[wp.vec3],
    open_share: wp.array[wp.vec3],
    factors: wp.array[wp.vec2],
    light_from_world: wp.mat33,
    ceiling: float,
    surface: wp.array2d[float],
    tables: wp.array[wp.vec3],
    # outputs
    radiance: wp.array[wp.vec3],
    uncut: wp.array[wp.vec3],
    color: wp.array[wp.vec3],
):
    """`uncut` is the colour where nothing is saturated.

    Many arguments because a struct of them would be filled anew, array by array, for each launch.
    """
    i = first + wp.tid()
    place = _seen(i, corners, weights, surface, open_share)
    linear = radiance_of_point(
        place.diffuse, place.f0, place.roughness, light_from_world * place.normal, light_from_world * wo[i], transmittance[i], met[i],
        place.open_share, tables, factors,
    )  # fmt: skip
    radiance[i] = linear
    value = wp.vec3(display_value(linear[0]), display_value(linear[1]), display_value(linear[2]))
    uncut[i] = value
    shown = value
    for k in range(3):
        shown[k] = wp.where(photo[i][k] >= SATURATED * ceiling, wp.min(value[k], ceiling), value[k])
    color[i] = shown


@wp.kernel
def color_adjoint(
    first: int,
    corners: wp.array2d[wp.int64],
    weights: wp.array[wp.vec3],
    wo: wp.array[wp.vec3],
    transmittance: wp.array[float],
    met: wp.array[wp.vec3],
    photo: wp.array[wp.vec3],
    open_share: wp.array[wp.vec3],
    factors: wp.array[wp.vec2],
    light_from_world: wp.mat33,
    ceiling: float,
    surface: wp.array2d[float],
    tables: wp.array[wp.vec3],
    radiance: wp.array[wp.vec3],
    uncut: wp.array[wp.vec3],
    color_gradient: wp.array[wp.vec3],
    slopes_of_share: int,
    # outputs
    surface_gradients: wp.array2d[float],
    table_gradients: wp.array[wp.vec3],
    share_gradients: wp.array[wp.vec3],
):
    """Many arguments because a struct of them would be filled anew, array by array, for each launch."""
    i = first + wp.tid()
    place = _seen(i, corners, weights, surface, open_share)
    linear = radiance[i]
    g = wp.vec3(0.0, 0.0, 0.0)
    for k in range(3):
        beyond = wp.where(photo[i][k] >= SATURATED * ceiling, uncut[i][k], 0.0) > ceiling
        g[k] = wp.where(beyond, 0.0, color_gradient[i][k] * display_slope(linear[k], uncut[i][k]))
    found = gradients_of_point(
        g, place.diffuse, place.f0, place.roughness, light_from_world * place.normal, light_from_world * wo[i], transmittance[i], met[i],
        place.open_share, tables, factors, table_gradients,
    )  # fmt: skip
    m = place.metallic
    g_albedo = found.diffuse_albedo * (1.0 - m) + found.f0 * m
    g_metallic = wp.dot(found.f0, place.albedo - base_f0(place.albedo, 0.0)) - wp.dot(found.diffuse_albedo, place.albedo)
    g_normal = wp.transpose(light_from_world) * found.normal
    g_normal = (g_normal - wp.dot(g_normal, place.normal) * place.normal) / wp.max(wp.length(place.blended), 1.0e-12)
    for k in range(3):
        c = place.corner[k]
        w = place.weight[k]
        for axis in range(3):
            wp.atomic_add(surface_gradients, c, axis, w * g_normal[axis])
            wp.atomic_add(surface_gradients, c, 3 + axis, w * g_albedo[axis])
        wp.atomic_add(surface_gradients, c, 6, w * found.roughness)
        wp.atomic_add(surface_gradients, c, 7, w * g_metallic)
        if slopes_of_share != 0:
            wp.atomic_add(share_gradients, c, w * found.open_share)


def surface_color(
    corners: Int[Tensor, "place 3"],
    weights: Float[Tensor, "place 3"],
    wo: Float[Tensor, "place 3"],
    transmittance: Float[Tensor, "place"],
    met: Float[Tensor, "place 3"],
    photo: Float[Tensor, "place 3"],
    ceiling: float,
    surface: Float[Tensor, "vertex 8"],
    light: MeshLight,
) -> Float[Tensor, "place 3"]:
    """Colours in display space, as display_image has them; differentiable in `surface` and in the light's tables and share.

    Args:
        corners, weights: of each place. wo: unit, world. transmittance, met: of mirrored_light. photo: what the photograph shows there, for what is
            saturated. ceiling: its largest value. surface: of packed_surface.
    """
    given = (corners, weights, wo, transmittance, met, photo, light.open_share, factor_table(wo.device))
    return _SurfaceColor.apply(surface, light.tables, light.open_share, given, rotation_of(light.light_from_world), ceiling)


_TYPES = (None, wp.vec3, wp.vec3, None, wp.vec3, wp.vec3, wp.vec3, wp.vec2)
_SHARE = 6
"""Place of the open sky's share among what is given."""


class _SurfaceColor(torch.autograd.Function):
    @staticmethod
    def forward(ctx, surface, tables, open_share, given, rotation, ceiling):
        radiance, uncut, color = (torch.empty_like(given[2]) for _ in range(3))
        surface, tables = surface.detach().contiguous(), tables.detach().contiguous()
        ctx.given, ctx.rotation, ctx.ceiling = tuple(x.detach().contiguous() for x in given), rotation, ceiling
        ctx.save_for_backward(surface, tables, radiance, uncut)
        outputs = [warp_argument(x, wp.vec3) for x in (radiance, uncut, color)]
        launch(color_kernel, len(color), _arguments(ctx, surface, tables), outputs, warp_device(color))
        return color

    @staticmethod
    def backward(ctx, gradient):
        surface, tables, radiance, uncut = ctx.saved_tensors
        gradient = gradient.contiguous()
        inputs = [*_arguments(ctx, surface, tables), *(warp_argument(x, wp.vec3) for x in (radiance, uncut, gradient))]
        share, asked = ctx.given[_SHARE], ctx.needs_input_grad[2]
        added = [(surface, None), (tables, wp.vec3), (share if asked else share[:0], wp.vec3)]
        found = launch_adding(color_adjoint, len(gradient), [*inputs, int(asked)], [], added, warp_device(gradient))
        return (*found[:2], found[2] if asked else None, None, None, None)


def _arguments(ctx: Any, surface: Tensor, tables: Tensor) -> list:
    given = [warp_argument(x, dtype) for x, dtype in zip(ctx.given, _TYPES, strict=True)]
    return [*given, ctx.rotation, ctx.ceiling, warp_argument(surface), warp_argument(tables, wp.vec3)]
