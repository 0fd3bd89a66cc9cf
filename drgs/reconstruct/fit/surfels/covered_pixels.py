"""What surfels show in the pixels that they cover, ready to be shaded: blended sums over coverage, normals that face the camera; with gradients.

Picked from the planes of the rasteriser and put back into them by one kernel each: as operations, which copied each of thirteen planes several times, it took
a tenth of stage 1. Specified by drgs/reference/covered_pixels.py.

In: blended maps, a camera, the flat numbers of the pixels. Out: per pixel what shade_split_sum takes.
"""

from typing import Any, NamedTuple

import torch
import warp as wp
from jaxtyping import Float, Int
from torch import Tensor

from drgs.render.visible.rasterize.gbuffer import LEAST_FACING
from drgs.scene.camera import Camera, world_from_pixel
from drgs.warp_torch import launch, warp_array, warp_device

LEAST_COVERAGE = 0.02
"""What maps are divided by, at least: a pixel hardly covered keeps a bounded gradient, and a pixel of less is none of the covered ones."""
_LEAST = wp.constant(LEAST_COVERAGE)
_FACING = wp.constant(LEAST_FACING)


class CoveredPixels(NamedTuple):
    """Of each covered pixel."""

    normal: Float[Tensor, "pixel 3"]
    """Unit, world, facing the camera (face_camera)."""
    diffuse_albedo: Float[Tensor, "pixel 3"]
    f0: Float[Tensor, "pixel 3"]
    roughness: Float[Tensor, "pixel"]
    residual: Float[Tensor, "pixel 3"]
    wo: Float[Tensor, "pixel 3"]
    """Unit, world, towards the camera; no gradient goes through it."""


@wp.func
def towards_camera(pixel: int, width: int, ray_of: wp.mat33):
    return -wp.normalize(ray_of * wp.vec3(float(pixel % width) + 0.5, float(pixel // width) + 0.5, 1.0))


@wp.func
def three_of(planes: wp.array2d[float], plane: int, pixel: int):
    return wp.vec3(planes[plane, pixel], planes[plane + 1, pixel], planes[plane + 2, pixel])


@wp.kernel(enable_backward=False, module="unique")
def pick_pixels(
    first: int,
    width: int,
    ray_of: wp.mat33,
    pixels: wp.array[wp.int64],
    planes: wp.array2d[float],
    coverage: wp.array[float],
    # outputs
    normal: wp.array[wp.vec3],
    diffuse: wp.array[wp.vec3],
    f0: wp.array[wp.vec3],
    roughness: wp.array[float],
    residual: wp.array[wp.vec3],
    wo: wp.array[wp.vec3],
):
    i = first + wp.tid()
    p = int(pixels[i])
    inverse = 1.0 / wp.max(coverage[p], _LEAST)
    towards = towards_camera(p, width, ray_of)
    blended = three_of(planes, 0, p) * inverse
    unit = blended / wp.max(wp.length(blended), 1.0e-12)
    bent = unit + wp.max(_FACING - wp.dot(unit, towards), 0.0) * towards
    normal[i] = bent / wp.max(wp.length(bent), 1.0e-12)
    diffuse[i] = three_of(planes, 3, p) * inverse
    f0[i] = three_of(planes, 6, p) * inverse
    roughness[i] = planes[9, p] * inverse
    residual[i] = three_of(planes, 10, p) * inverse
    wo[i] = towards


@wp.func
def put_three(planes: wp.array2d[float], plane: int, pixel: int, value: wp.vec3):
    planes[plane, pixel] = value[0]
    planes[plane + 1, pixel] = value[1]
    planes[plane + 2, pixel] = value[2]


@wp.kernel(enable_backward=False, module="unique")
def put_gradients(
    first: int,
    pixels: wp.array[wp.int64],
    planes: wp.array2d[float],
    coverage: wp.array[float],
    wo: wp.array[wp.vec3],
    g_normal: wp.array[wp.vec3],
    g_diffuse: wp.array[wp.vec3],
    g_f0: wp.array[wp.vec3],
    g_roughness: wp.array[float],
    g_residual: wp.array[wp.vec3],
    # outputs
    by_planes: wp.array2d[float],
    by_coverage: wp.array[float],
):
    i = first + wp.tid()
    p = int(pixels[i])
    inverse = 1.0 / wp.max(coverage[p], _LEAST)
    towards = wo[i]
    blended = three_of(planes, 0, p) * inverse
    long = wp.max(wp.length(blended), 1.0e-12)
    unit = blended / long
    lacking = _FACING - wp.dot(unit, towards)
    bent = unit + wp.max(lacking, 0.0) * towards
    stretch = wp.max(wp.length(bent), 1.0e-12)
    normal = bent / stretch
    g_bent = (g_normal[i] - wp.dot(normal, g_normal[i]) * normal) / stretch
    g_unit = g_bent
    if lacking > 0.0:
        g_unit = g_bent - wp.dot(g_bent, towards) * towards
    g_blended = (g_unit - wp.dot(unit, g_unit) * unit) / long
    put_three(by_planes, 0, p, inverse * g_blended)
    put_three(by_planes, 3, p, inverse * g_diffuse[i])
    put_three(by_planes, 6, p, inverse * g_f0[i])
    by_planes[9, p] = inverse * g_roughness[i]
    put_three(by_planes, 10, p, inverse * g_residual[i])
    if coverage[p] > _LEAST:
        told = wp.dot(three_of(planes, 0, p), g_blended) + wp.dot(three_of(planes, 3, p), g_diffuse[i])
        told += wp.dot(three_of(planes, 6, p), g_f0[i]) + planes[9, p] * g_roughness[i] + wp.dot(three_of(planes, 10, p), g_residual[i])
        by_coverage[p] = -inverse * inverse * told


class _Covered(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, features: Tensor, coverage: Tensor, pixels: Tensor, camera: Camera) -> tuple[Tensor, ...]:
        planes, count = features.detach().flatten(1), len(pixels)
        normal, diffuse, f0, residual, wo = (features.new_empty(count, 3) for _ in range(5))
        roughness = features.new_empty(count)
        ray_of = wp.mat33(*world_from_pixel(camera).flatten().tolist())
        inputs = [camera.width, ray_of, warp_array(pixels), warp_array(planes), warp_array(coverage.view(-1))]
        vectors = [warp_array(x, wp.vec3) for x in (normal, diffuse, f0, residual, wo)]
        launch(pick_pixels, count, inputs, [*vectors[:3], warp_array(roughness), *vectors[3:]], warp_device(features))
        ctx.save_for_backward(features, coverage, pixels, wo)
        ctx.mark_non_differentiable(wo)
        return normal, diffuse, f0, roughness, residual, wo

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor, None, None]:
        features, coverage, pixels, wo = ctx.saved_tensors
        by_features, by_coverage = torch.zeros_like(features), torch.zeros_like(coverage)
        given = [warp_array(x, dtype) for x, dtype in zip(gradients[:5], (wp.vec3, wp.vec3, wp.vec3, None, wp.vec3), strict=True)]
        inputs = [warp_array(pixels), warp_array(features.flatten(1)), warp_array(coverage.view(-1)), warp_array(wo, wp.vec3), *given]
        outputs = [warp_array(by_features.flatten(1)), warp_array(by_coverage.view(-1))]
        launch(put_gradients, len(pixels), inputs, outputs, warp_device(features))
        return by_features, by_coverage, None, None


def covered_pixels(
    features: Float[Tensor, "13 height width"],
    coverage: Float[Tensor, "height width"],
    pixels: Int[Tensor, "pixel"],
    camera: Camera,
) -> CoveredPixels:
    """What each of the flat `pixels` shows; differentiable in the maps.

    Args:
        features: sums of normal (3), diffuse albedo (3), F0 (3), roughness and residual radiance (3), as `rasterize` blends them.
    """
    return CoveredPixels(*_Covered.apply(features.contiguous(), coverage.contiguous(), pixels, camera))
