"""What the passes of a frame add up to, and how an estimate is added."""

from dataclasses import dataclass, replace
from typing import Any

import torch
import warp as wp
from jaxtyping import Float
from torch import Tensor

from drgs.render.color_warp import luminance_of
from drgs.render.integrate.sample_arrays import PointArrays, point_arrays
from drgs.render.records import PrimaryPoints, ShadedPoints
from drgs.warp_torch import launch, warp_array, warp_device

wp.set_module_options({"enable_backward": False})

DARK = 0.01
"""Squared luminance below which errors are absolute, where a pixel's is asked for."""


@dataclass(frozen=True, eq=False)
class FrameSums:
    """Over passes, weighted by coverage; pixels are flat, row-major."""

    diffuse: Float[Tensor, "pixel 3"]
    specular: Float[Tensor, "pixel 3"]
    places: Float[Tensor, "pixel"]
    """Looked through: one a pass, unless passes look through some pixels more often (spread_places.py)."""
    weight: Float[Tensor, "pixel"]
    """Places that found a surface."""
    luminance: Float[Tensor, "pixel"]
    luminance_squared: Float[Tensor, "pixel"]
    scatter: Float[Tensor, "pixel 3"]
    """Of the passes' own variance estimates: whole luminance, diffuse, specular."""
    visibility: Float[Tensor, "pixel"]
    indirect: Float[Tensor, "pixel 3"] | None
    """The part of diffuse + specular that other surfaces send; None unless asked for."""
    surface: Float[Tensor, "pixel 15"] | None
    """Position, normal, wo, albedo, roughness, metallic, depth of a mesh; None of Gaussians, whose G-buffer says them."""


BRIGHTNESS_POWERS = {"diffuse": 1, "specular": 1, "luminance": 1, "luminance_squared": 2, "scatter": 2, "indirect": 1}
"""Under a light f times as strong these sums are f to that power times as large; the others stay."""


@wp.struct
class SumArrays:
    """FrameSums as kernels see them."""

    first_pixel: int
    """Number in the image of the first of them."""
    diffuse: wp.array[wp.vec3]
    specular: wp.array[wp.vec3]
    places: wp.array[float]
    weight: wp.array[float]
    luminance: wp.array[float]
    luminance_squared: wp.array[float]
    scatter: wp.array[wp.vec3]
    visibility: wp.array[float]
    indirect: wp.array[wp.vec3]
    """Empty unless asked for."""
    surface: wp.array2d[float]
    """Empty of Gaussians."""


@wp.kernel
def add_light(
    first: int,
    pixel: wp.array[int],
    diffuse: wp.array[wp.vec3],
    specular: wp.array[wp.vec3],
    variance: wp.array[wp.vec3],
    visibility: wp.array[float],
    indirect: wp.array[wp.vec3],
    # outputs; each pixel occurs once a launch, or all launch indices run on one thread, so plain adds are exact and ordered
    sums: SumArrays,
):
    i = first + wp.tid()
    p = pixel[i] - sums.first_pixel
    y = luminance_of(diffuse[i] + specular[i])
    sums.diffuse[p] = sums.diffuse[p] + diffuse[i]
    sums.specular[p] = sums.specular[p] + specular[i]
    sums.weight[p] = sums.weight[p] + 1.0
    sums.luminance[p] = sums.luminance[p] + y
    sums.luminance_squared[p] = sums.luminance_squared[p] + y * y
    sums.scatter[p] = sums.scatter[p] + variance[i]
    sums.visibility[p] = sums.visibility[p] + visibility[i]
    if sums.indirect.shape[0] > 0:
        sums.indirect[p] = sums.indirect[p] + indirect[i]


@wp.kernel
def add_surface(
    first: int,
    points: PointArrays,
    depth: wp.array[float],
    # outputs
    sums: SumArrays,
):
    i = first + wp.tid()
    p = points.pixel[i] - sums.first_pixel
    for k in range(3):
        sums.surface[p, k] = sums.surface[p, k] + points.position[i][k]
        sums.surface[p, 3 + k] = sums.surface[p, 3 + k] + points.normal[i][k]
        sums.surface[p, 6 + k] = sums.surface[p, 6 + k] + points.wo[i][k]
        sums.surface[p, 9 + k] = sums.surface[p, 9 + k] + points.albedo[i][k]
    sums.surface[p, 12] = sums.surface[p, 12] + points.roughness[i]
    sums.surface[p, 13] = sums.surface[p, 13] + points.metallic[i]
    sums.surface[p, 14] = sums.surface[p, 14] + depth[i]


def no_sums(pixels: int, with_surface: bool, with_indirect: bool, device: torch.device) -> FrameSums:
    """Zeros that take no memory: the first pass copies them."""

    def zeros(*tail: int) -> Tensor:
        return torch.zeros(1, *tail, device=device).expand(pixels, *tail)

    return FrameSums(
        diffuse=zeros(3),
        specular=zeros(3),
        places=zeros(),
        weight=zeros(),
        luminance=zeros(),
        luminance_squared=zeros(),
        scatter=zeros(3),
        visibility=zeros(),
        indirect=zeros(3) if with_indirect else None,
        surface=zeros(15) if with_surface else None,
    )


def copy_sums(sums: FrameSums) -> FrameSums:
    """Sums that may be added to."""
    return replace(sums, **{name: values.clone() for name, values in vars(sums).items() if values is not None})


def brighten_sums(sums: FrameSums, brightness: float) -> FrameSums:
    """The same under a light `brightness` times as strong."""
    known = {name: values for name, values in vars(sums).items() if values is not None}
    return replace(sums, **{name: known[name] * brightness**power for name, power in BRIGHTNESS_POWERS.items() if name in known})


def add_estimate(sums: FrameSums, arrays: Any, primary: PrimaryPoints, light: ShadedPoints) -> None:
    """Add one estimate of the light of some pixels to their sums, in place; `places` are the caller's to count.

    Args:
        arrays: `sum_arrays` of these sums.
    """
    device, count = warp_device(sums.weight), len(primary.points.pixel)
    vectors = [warp_array(values, wp.vec3) for values in (light.diffuse, light.specular, light.variance)]
    indirect = warp_array(light.diffuse[:0] if light.indirect is None else light.indirect, wp.vec3)
    launch(add_light, count, [warp_array(primary.points.pixel), *vectors, warp_array(light.visibility), indirect], [arrays], device)
    if sums.surface is not None:
        launch(add_surface, count, [point_arrays(primary.points), warp_array(primary.depth)], [arrays], device)


def sum_arrays(sums: FrameSums, first_pixel: int = 0) -> Any:
    """The struct that kernels read and write; shares memory with the tensors."""
    arrays = SumArrays()
    arrays.first_pixel = first_pixel
    arrays.diffuse, arrays.specular, arrays.scatter = (warp_array(x, wp.vec3) for x in (sums.diffuse, sums.specular, sums.scatter))
    arrays.places = warp_array(sums.places)
    arrays.weight, arrays.visibility = warp_array(sums.weight), warp_array(sums.visibility)
    arrays.luminance, arrays.luminance_squared = warp_array(sums.luminance), warp_array(sums.luminance_squared)
    arrays.indirect = warp_array(sums.diffuse[:0] if sums.indirect is None else sums.indirect, wp.vec3)
    arrays.surface = warp_array(sums.weight.new_empty(0, 15) if sums.surface is None else sums.surface)
    return arrays
