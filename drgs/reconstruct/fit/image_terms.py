"""What fitting compares of an image pixel by pixel, values and gradients in one kernel each: the display's curve, masks, and smoothness.

As operations on whole images, each of which reads and writes all pixels and which autograd doubles, they took a tenth of stage 1.

In: maps of one view, its photograph. Out: an image, or a number; both know their gradients. Specified by drgs/reference/image_terms.py.
"""

from typing import Any

import torch
import warp as wp
from torch import Tensor

from drgs.maths.constants import SRGB_GAMMA, SRGB_LINEAR_END, SRGB_OFFSET, SRGB_SCALE, SRGB_SLOPE
from drgs.warp_torch import launch, warp_array, warp_device

SATURATED = 254 / 255
"""Of the ceiling, from where on a photograph only says "at least"."""
MASK_MARGIN = 1e-4
"""Coverage nearer to none or all of a pixel than this has no gradient by masks."""
SOLID = wp.constant(0.9)
"""Coverage from which neighbours are held together."""
EDGE = wp.constant(8.0)
"""By how much the photograph's steps (display values) loosen that."""


@wp.func
def display_value(linear: float) -> float:
    if linear <= SRGB_LINEAR_END:
        return SRGB_SLOPE * linear
    return SRGB_SCALE * wp.pow(linear, 1.0 / SRGB_GAMMA) - SRGB_OFFSET


@wp.func
def display_slope(linear: float, shown: float) -> float:
    # By what is shown, for a power costs as much as all else.
    return wp.where(linear <= SRGB_LINEAR_END, SRGB_SLOPE, (shown + SRGB_OFFSET) / (SRGB_GAMMA * wp.max(linear, SRGB_LINEAR_END)))


@wp.kernel(enable_backward=False, module="unique")
def show_pixels(
    first: int,
    ceiling: float,
    radiance: wp.array[wp.vec3],
    coverage: wp.array[float],
    photo: wp.array[wp.vec3],
    # outputs
    image: wp.array[wp.vec3],
    opaque: wp.array[wp.vec3],
    slope: wp.array[wp.vec3],
):
    """`opaque` is the image where all is covered, `slope` the image's derivative by radiance."""
    i = first + wp.tid()
    linear = radiance[i]
    covered = coverage[i]
    shown = wp.vec3()
    rate = wp.vec3()
    for k in range(3):
        shown[k] = display_value(linear[k])
        rate[k] = covered * display_slope(linear[k], shown[k])
        if photo[i][k] >= SATURATED * ceiling and shown[k] > ceiling:
            shown[k] = ceiling
            rate[k] = 0.0
    image[i] = covered * shown
    opaque[i] = shown
    slope[i] = rate


@wp.kernel(enable_backward=False, module="unique")
def shown_gradient(
    first: int,
    gradient: wp.array[wp.vec3],
    opaque: wp.array[wp.vec3],
    slope: wp.array[wp.vec3],
    # outputs
    by_radiance: wp.array[wp.vec3],
    by_coverage: wp.array[float],
):
    i = first + wp.tid()
    by_radiance[i] = wp.cw_mul(gradient[i], slope[i])
    by_coverage[i] = wp.dot(gradient[i], opaque[i])


class Shown(torch.autograd.Function):
    """Radiance as the camera would have stored it, times coverage, of losses.display_image."""

    @staticmethod
    def forward(ctx: Any, radiance: Tensor, coverage: Tensor, photo: Tensor, ceiling: float) -> Tensor:
        image, opaque, slope = (torch.empty_like(radiance, memory_format=torch.contiguous_format) for _ in range(3))
        inputs = [ceiling, warp_array(radiance, wp.vec3), warp_array(coverage), warp_array(photo, wp.vec3)]
        outputs = [warp_array(x, wp.vec3) for x in (image, opaque, slope)]
        launch(show_pixels, len(coverage), inputs, outputs, warp_device(image))
        ctx.save_for_backward(opaque, slope)
        return image

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor, None, None]:
        opaque, slope = ctx.saved_tensors
        by_radiance, by_coverage = torch.empty_like(slope), torch.empty_like(slope[:, 0])
        inputs = [warp_array(x, wp.vec3) for x in (gradients[0], opaque, slope)]
        launch(shown_gradient, len(slope), inputs, [warp_array(by_radiance, wp.vec3), warp_array(by_coverage)], warp_device(slope))
        return by_radiance, by_coverage, None, None


@wp.kernel(enable_backward=False, module="unique")
def compare_masks(
    first: int,
    coverage: wp.array[float],
    mask: wp.array[float],
    # outputs
    entropy: wp.array[float],
    slope: wp.array[float],
):
    """The cross-entropy of each pixel and its derivative."""
    i = first + wp.tid()
    held = coverage[i]
    # Not clamp, which makes a number of what is none: the sum must say that something went wrong.
    if held < MASK_MARGIN:
        held = MASK_MARGIN
    if held > 1.0 - MASK_MARGIN:
        held = 1.0 - MASK_MARGIN
    wanted = mask[i]
    value = float(0.0)
    if wanted > 0.0:
        value -= wanted * wp.log(held)
    if wanted < 1.0:
        value -= (1.0 - wanted) * wp.log(1.0 - held)
    entropy[i] = value
    slope[i] = wp.where(held == coverage[i], (held - wanted) / (held * (1.0 - held)), 0.0)


class MaskEntropy(torch.autograd.Function):
    """The mean over pixels, of losses.mask_loss."""

    @staticmethod
    def forward(ctx: Any, coverage: Tensor, mask: Tensor) -> Tensor:
        entropy, slope = torch.empty_like(coverage), torch.empty_like(coverage)
        outputs = [warp_array(x.view(-1)) for x in (entropy, slope)]
        launch(compare_masks, entropy.numel(), [warp_array(x.view(-1)) for x in (coverage, mask)], outputs, warp_device(entropy))
        ctx.save_for_backward(slope)
        return entropy.mean()

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:
        (slope,) = ctx.saved_tensors
        return slope * (gradients[0] / slope.numel()), None


@wp.func
def held_together(photo: wp.array[wp.vec3], coverage: wp.array[float], here: int, ahead: int):
    """Two neighbours' weight: less where the photograph has an edge, none where one of them is not solid."""
    if coverage[here] > SOLID and coverage[ahead] > SOLID:
        step = photo[ahead] - photo[here]
        return wp.exp(-EDGE * (wp.abs(step[0]) + wp.abs(step[1]) + wp.abs(step[2])) / 3.0)
    return 0.0


@wp.kernel(enable_backward=False, module="unique")
def smooth_steps(
    first: int,
    height: int,
    width: int,
    maps: wp.array2d[float],
    photo: wp.array[wp.vec3],
    coverage: wp.array[float],
    # outputs
    steps: wp.array[float],
    weights: wp.array[wp.vec2],
):
    """Of each pixel the weighted steps to the next one down and to the right, summed over channels, and both weights."""
    p = first + wp.tid()
    channels = maps.shape[1]
    weight = wp.vec2()
    if p // width < height - 1:
        weight[0] = held_together(photo, coverage, p, p + width)
    if p % width < width - 1:
        weight[1] = held_together(photo, coverage, p, p + 1)
    total = float(0.0)
    for axis in range(2):
        if weight[axis] > 0.0:
            ahead = p + wp.where(axis == 0, width, 1)
            for k in range(channels):
                total += weight[axis] * wp.abs(maps[ahead, k] - maps[p, k])
    steps[p] = total
    weights[p] = weight


@wp.func
def direction(step: float):
    """-1, 0, 1."""
    return wp.where(step > 0.0, 1.0, wp.where(step < 0.0, -1.0, 0.0))


@wp.kernel(enable_backward=False, module="unique")
def smooth_gradient(
    first: int,
    width: int,
    maps: wp.array2d[float],
    weights: wp.array[wp.vec2],
    factor: wp.array[float],
    # outputs
    by_maps: wp.array2d[float],
):
    p = first + wp.tid()
    down = weights[p][0]
    right = weights[p][1]
    above = float(0.0)
    left = float(0.0)
    if p >= width:
        above = weights[p - width][0]
    if p % width > 0:
        left = weights[p - 1][1]
    for k in range(maps.shape[1]):
        total = float(0.0)
        if down > 0.0:
            total -= down * direction(maps[p + width, k] - maps[p, k])
        if right > 0.0:
            total -= right * direction(maps[p + 1, k] - maps[p, k])
        if above > 0.0:
            total += above * direction(maps[p, k] - maps[p - width, k])
        if left > 0.0:
            total += left * direction(maps[p, k] - maps[p - 1, k])
        by_maps[p, k] = factor[0] * total


class Smoothness(torch.autograd.Function):
    """Of losses.edge_aware_smoothness; maps are contiguous."""

    @staticmethod
    def forward(ctx: Any, maps: Tensor, photo: Tensor, coverage: Tensor) -> Tensor:
        height, width, channels = maps.shape
        steps, weights = torch.empty_like(coverage), maps.new_empty(height * width, 2)
        inputs = [height, width, warp_array(maps.view(-1, channels)), warp_array(photo.view(-1, 3), wp.vec3), warp_array(coverage.view(-1))]
        launch(smooth_steps, height * width, inputs, [warp_array(steps.view(-1)), warp_array(weights, wp.vec2)], warp_device(maps))
        share = 1 / (channels * (coverage > float(SOLID)).sum().clamp(min=1).float())
        ctx.save_for_backward(maps, weights, share)
        return steps.sum() * share

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None, None]:
        maps, weights, share = ctx.saved_tensors
        by_maps, flat = torch.empty_like(maps), maps.view(-1, maps.shape[-1])
        inputs = [maps.shape[1], warp_array(flat), warp_array(weights, wp.vec2), warp_array((gradients[0] * share).view(1))]
        launch(smooth_gradient, len(flat), inputs, [warp_array(by_maps.view_as(flat))], warp_device(maps))
        return by_maps, None, None
