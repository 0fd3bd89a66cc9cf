"""What many pictures agree that a place looks like, though something hides it from some of them, and how likely a pixel is to show it.

In: of each place, the colours that pictures have there. Out: one colour, how far it varies, and whether enough of them agree.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from drgs.scene.camera import Camera


@dataclass(frozen=True)
class Agreement:
    guesses: int = 6
    """Pictures whose colour is tried as a place's own."""
    alike: float = 0.08
    """Colours that differ by less (root mean square of channels, sRGB 0..1) are the same place's."""
    fewest: int = 4
    """Pictures that must agree on a place's colour, and"""
    agreeing: float = 0.35
    """how many of those that look there, whether or not something hides it."""
    least_deviation: float = 0.03
    """Of colours, by noise and blur."""
    noise_around: float = 0.5
    """Of a pixel and its neighbours together, over that of one: a third, were it noise alone, and not poses and blur as well."""
    others: float = 0.02
    """Share of the pixels that show a place and look otherwise, by a shadow or a highlight."""


def asked_views(count: int, most: int) -> list[int]:
    """Numbers of at most so many views, spread over all."""
    return sorted({round(number) for number in np.linspace(0, count - 1, min(most, count))})


def seen_colors(
    projected: Float[Tensor, "place 3"],
    camera: Camera,
    image_srgb: UInt8[Tensor, "height width 3"],
    free: Bool[Tensor, "height width"] | None,
) -> tuple[Float[Tensor, "place 3"], Bool[Tensor, "place"]]:
    """A picture's colours (sRGB 0..1) at places, NaN where it does not see them free; and which of them it looks at.

    Args:
        projected: pixels times depth, and depth. free: pixels that may show them; None: all.
    """
    depth = projected[:, 2:]
    pixels = projected[:, :2] / torch.where(depth > 0, depth, 1.0)
    size = pixels.new_tensor([camera.width, camera.height])
    inside = (depth[:, 0] > 0) & (pixels >= 0.5).all(-1) & (pixels <= size - 0.5).all(-1)
    picture = image_srgb.permute(2, 0, 1).float() / 255
    may_show = torch.ones_like(picture[:1]) if free is None else free[None].float()
    places = (2 * pixels / size - 1)[None, None]
    found = torch.nn.functional.grid_sample(torch.cat([picture, may_show])[None], places, align_corners=False)[0, :, 0].T
    return torch.where((inside & (found[:, 3] > 0.999))[:, None], found[:, :3], torch.nan), inside


def agreed_colors(
    samples: Float[Tensor, "view texel 3"], looked: Bool[Tensor, "view texel"], settings: Agreement
) -> tuple[Float[Tensor, "texel 3"], Float[Tensor, "texel"], Bool[Tensor, "texel"]]:
    """Of each texel the colour that most views agree on, its deviation, and whether enough of them do."""
    seen = samples[..., 0].isfinite()
    count = seen.sum(0)
    # Guesses: of each texel, views spread over those that see it.
    order = torch.argsort(~seen, dim=0, stable=True)
    best, most = torch.zeros_like(samples[0]), torch.full(count.shape, -1)
    for guess in range(settings.guesses):
        rank = (count * guess) // settings.guesses
        color = samples.gather(0, order.gather(0, rank[None])[..., None].expand(1, -1, 3))[0]
        alike = (_difference(samples, color) < settings.alike).sum(0)
        better = alike > most
        best, most = torch.where(better[:, None], color, best), torch.where(better, alike, most)
    for _ in range(2):
        weight = (_difference(samples, best) < settings.alike).float()
        best = (samples.nan_to_num() * weight[..., None]).sum(0) / weight.sum(0).clamp_min(1)[:, None]
    weight = (_difference(samples, best) < settings.alike).float()
    agreeing = weight.sum(0)
    variance = ((samples.nan_to_num() - best).square().mean(-1) * weight).sum(0) / agreeing.clamp_min(1)
    sure = (agreeing >= settings.fewest) & (agreeing >= settings.agreeing * looked.sum(0))
    return best, variance.sqrt().clamp_min(settings.least_deviation), sure


def _difference(samples: Float[Tensor, "view texel 3"], color: Float[Tensor, "texel 3"]) -> Float[Tensor, "view texel"]:
    """Infinite where a view sees nothing."""
    return (samples - color).square().mean(-1).sqrt().nan_to_num(torch.inf)


def color_likelihood(
    color: Float[Tensor, "3 height width"],
    deviation: Float[Tensor, "height width"],
    image_srgb: UInt8[Tensor, "height width 3"],
    settings: Agreement = Agreement(),
) -> Float[Tensor, "height width"]:
    """Logarithm of the density of each pixel's colour (sRGB 0..1) if it shows what is expected there, or of its surroundings' if that is less: noise may
    make one pixel of another colour likely, but not all around."""
    image = image_srgb.permute(2, 0, 1).float() / 255
    alone = _log_density(color, deviation, image, settings)
    together = _log_density(_around(color), settings.noise_around * deviation, _around(image), settings)
    return torch.minimum(alone, together)


def _around(picture: Float[Tensor, "3 height width"]) -> Float[Tensor, "3 height width"]:
    """Means of pixels and their neighbours."""
    return torch.nn.functional.avg_pool2d(picture[None].nan_to_num(), 3, 1, 1, count_include_pad=False)[0]


def _log_density(
    color: Float[Tensor, "3 height width"],
    deviation: Float[Tensor, "height width"],
    image: Float[Tensor, "3 height width"],
    settings: Agreement,
) -> Float[Tensor, "height width"]:
    # Poses are off by up to a pixel: the best of the neighbouring places counts.
    padded = torch.nn.functional.pad(color[None], (1, 1, 1, 1), mode="replicate")[0]
    height, width = image.shape[1:]
    shifted = (padded[:, y : y + height, x : x + width] for y in range(3) for x in range(3))
    square = torch.stack([(image - expected).square().sum(0) for expected in shifted]).amin(0)
    deviation = deviation.clamp_min(settings.least_deviation)
    log_density = -0.5 * square / deviation.square() - 3 * torch.log(deviation) - 1.5 * np.log(2 * np.pi)
    return torch.logaddexp(log_density + np.log(1 - settings.others), torch.full_like(log_density, np.log(settings.others)))
