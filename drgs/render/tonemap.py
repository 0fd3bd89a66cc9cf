"""Linear radiance to pictures: exposure, background, sRGB, straight alpha; 8-bit PNG files."""

from pathlib import Path

import numpy as np
import torch
import warp as wp
from PIL import Image
from torch import Tensor

from drgs.warp_torch import launch, warp_array, warp_device, warp_view

wp.set_module_options({"enable_backward": False})


def tonemap(radiance_linear: Tensor, coverage: Tensor, exposure: float = 0.0, background_linear: Tensor | None = None) -> Tensor:
    """(height, width, 4) sRGB in [0, 1] with straight alpha.

    Args:
        radiance_linear: (height, width, 3), alpha-normalised.
        coverage: (height, width), 0..1.
        exposure: [stops]; scales object and background alike.
        background_linear: (3,) or (height, width, 3) radiance behind the object; None leaves it transparent.
    """
    height, width = coverage.shape
    rgba = radiance_linear.new_empty(height, width, 4)
    behind = radiance_linear.new_empty(0, 0, 3)
    if background_linear is not None:
        behind = background_linear.to(radiance_linear).expand(height, width, 3)
    inputs = [width, 2.0**exposure, warp_view(radiance_linear, wp.vec3), warp_view(coverage), warp_view(behind, wp.vec3)]
    launch(show, height * width, inputs, [warp_array(rgba, wp.vec4)], warp_device(rgba))
    return rgba


@wp.func
def srgb_of(linear: float) -> float:
    """maths.color.srgb_from_linear, clipped."""
    c = wp.clamp(linear, 0.0, 1.0)
    return wp.where(c <= 0.0031308, 12.92 * c, 1.055 * wp.pow(wp.max(c, 0.0031308), 1.0 / 2.4) - 0.055)


@wp.kernel
def show(
    first: int,
    width: int,
    scale: float,
    radiance: wp.array2d[wp.vec3],
    coverage: wp.array2d[float],
    background: wp.array2d[wp.vec3],
    # outputs
    rgba: wp.array2d[wp.vec4],
):
    i = first + wp.tid()
    y = i / width
    x = i - y * width
    alpha = wp.clamp(coverage[y, x], 0.0, 1.0)
    color = wp.vec3(0.0, 0.0, 0.0)
    if alpha > 0.0:
        color = radiance[y, x]
    if background.shape[0] > 0:
        color = alpha * color + (1.0 - alpha) * background[y, x]
        alpha = 1.0
    color = scale * color
    rgba[y, x] = wp.vec4(srgb_of(color[0]), srgb_of(color[1]), srgb_of(color[2]), alpha)


def write_png(path: Path | str, rgba_srgb: Tensor) -> None:
    """An 8-bit RGBA file, rounded to nearest."""
    pixels = (rgba_srgb.detach().cpu().clamp(0, 1) * 255 + 0.5).to(torch.uint8).numpy()
    Image.fromarray(np.ascontiguousarray(pixels), "RGBA").save(path)
