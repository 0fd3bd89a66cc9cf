"""The structural similarity of an image and a photograph: on the CPU its value and its gradient by two passes over rows, elsewhere by matrices.

SSIM with a Gaussian window of 11 pixels, sigma 1.5, data range 1 (docs/sources.md: wang2004), zero beyond the borders. Two banded matrix products, which
autograd turns into four, are an order of magnitude faster on a CPU than a small convolution, and took a fifth of stage 1 all the same: most
of a banded matrix is zero.
"""

import math
from pathlib import Path
from typing import Any

import torch
import warp as wp
from jaxtyping import Float
from torch import Tensor

from drgs.render.native_source import native_source
from drgs.warp_torch import launch, warp_array, warp_device

SIGMA = 1.5
RADIUS = 5
SEGMENT = 240
"""Numbers of a row that one launch index takes: what it keeps of them fits the first cache."""
_TOTAL = sum(math.exp(-0.5 * (offset / SIGMA) ** 2) for offset in range(-RADIUS, RADIUS + 1))
WINDOW = tuple(math.exp(-0.5 * (offset / SIGMA) ** 2) / _TOTAL for offset in range(RADIUS + 1))
"""Weights by distance; the window is the same to either side."""


def _source(name: str) -> str:
    return native_source(
        Path(__file__).with_name(name), constants={f"WINDOW_{k}": weight for k, weight in enumerate(WINDOW)} | {"SEGMENT": SEGMENT}
    )


@wp.func_native(_source("ssim_means.h"))
def ssim_means(
    index: int, height: int, width: int, pitch: int, image: wp.array[float], photo: wp.array[float], sums: wp.array[float],
    slopes: wp.array[float],
): ...  # fmt: skip


@wp.func_native(_source("ssim_slopes.h"))
def ssim_slopes(
    index: int, height: int, width: int, pitch: int, image: wp.array[float], photo: wp.array[float], slopes: wp.array[float],
    gradient: wp.array[float],
): ...  # fmt: skip


@wp.kernel(enable_backward=False, module="unique")
def similarity_rows(
    first: int,
    height: int,
    width: int,
    pitch: int,
    image: wp.array[float],
    photo: wp.array[float],
    # outputs
    sums: wp.array[float],
    slopes: wp.array[float],
):
    """ssim_means.h."""
    ssim_means(first + wp.tid(), height, width, pitch, image, photo, sums, slopes)


@wp.kernel(enable_backward=False, module="unique")
def similarity_gradient_rows(
    first: int,
    height: int,
    width: int,
    pitch: int,
    image: wp.array[float],
    photo: wp.array[float],
    slopes: wp.array[float],
    # outputs
    gradient: wp.array[float],
):
    """ssim_slopes.h."""
    ssim_slopes(first + wp.tid(), height, width, pitch, image, photo, slopes, gradient)


class _Similarity(torch.autograd.Function):
    """Mean SSIM over pixels and channels of float32 images on the CPU."""

    @staticmethod
    def forward(ctx: Any, image: Tensor, photo: Tensor) -> Tensor:
        height, columns, channels = image.shape
        width = columns * channels
        segments = -(-width // SEGMENT)
        pitch = segments * SEGMENT + 32
        rows = [torch.nn.functional.pad(x.detach().reshape(height, width), (16, pitch - width - 16)) for x in (image, photo)]
        sums, slopes = torch.empty(height * segments), torch.zeros(3, height, pitch)
        arrays = [warp_array(x.view(-1)) for x in rows]
        launch(
            similarity_rows,
            height * segments,
            [height, width, pitch, *arrays],
            [warp_array(sums), warp_array(slopes.view(-1))],
            warp_device(image),
        )
        ctx.save_for_backward(*rows, slopes)
        ctx.image_shape = image.shape
        return sums.sum() / image.numel()

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:
        image, photo, slopes = ctx.saved_tensors
        height, pitch = image.shape
        columns, channels = ctx.image_shape[1:]
        width = columns * channels
        gradient = torch.empty(height, pitch)
        arrays = [warp_array(x.view(-1)) for x in (image, photo, slopes)]
        count = height * -(-width // SEGMENT)
        launch(similarity_gradient_rows, count, [height, width, pitch, *arrays], [warp_array(gradient.view(-1))], warp_device(image))
        inside = gradient[:, 16 : 16 + width] * (gradients[0] / (height * width))
        return inside.view(ctx.image_shape), None


def structural_similarity(image: Float[Tensor, "height width 3"], photo: Float[Tensor, "height width 3"]) -> Float[Tensor, ""]:
    """Scalar mean SSIM of two images; differentiable."""
    if image.device.type == "cpu" and image.dtype == torch.float32 and not photo.requires_grad:
        return _Similarity.apply(image, photo)
    return similarity_by_matrices(image, photo)


def similarity_by_matrices(image: Float[Tensor, "height width 3"], photo: Float[Tensor, "height width 3"]) -> Float[Tensor, ""]:
    """The same for any device and type, the window as two banded matrices."""
    a, b = image.permute(2, 0, 1), photo.permute(2, 0, 1)
    means_a, means_b, squares_a, squares_b, products = _blur(torch.cat([a, b, a * a, b * b, a * b])).split(3)
    variance_a, variance_b = squares_a - means_a * means_a, squares_b - means_b * means_b
    covariance = products - means_a * means_b
    ssim = ((2 * means_a * means_b + 1e-4) * (2 * covariance + 9e-4)) / (
        (means_a * means_a + means_b * means_b + 1e-4) * (variance_a + variance_b + 9e-4)
    )
    return ssim.mean()


def _window_matrix(size: int, like: Float[Tensor, "..."]) -> Float[Tensor, "{size} {size}"]:
    """(size, size) banded: the window as a product."""
    offsets = torch.arange(size, device=like.device)
    distance = (offsets[:, None] - offsets).abs()
    weights = torch.tensor([*WINDOW, 0.0], dtype=like.dtype, device=like.device)
    return weights[distance.clamp(max=RADIUS + 1)]


def _blur(images: Float[Tensor, "n height width"]) -> Float[Tensor, "n height width"]:
    """(n, height, width) smoothed by the window, zero padding."""
    along_x, along_y = _window_matrix(images.shape[2], images), _window_matrix(images.shape[1], images)
    return along_y @ (images.reshape(-1, images.shape[2]) @ along_x).view_as(images)
