"""What fitting minimises, term by term. Images are (height, width, 3) in sRGB, extended above 1, times coverage."""

import torch
from jaxtyping import Float
from torch import Tensor

from drgs.reconstruct.fit.image_terms import MaskEntropy, Shown, Smoothness
from drgs.reconstruct.fit.similarity import structural_similarity


def display_image(
    radiance_linear: Float[Tensor, "*pixels 3"],
    coverage: Float[Tensor, "*pixels"],
    photo_srgb: Float[Tensor, "*pixels 3"],
    ceiling: float = 1.0,
) -> Float[Tensor, "*pixels 3"]:
    """Radiance (..., 3) as the camera would have stored it, times coverage: sRGB, and no reward for passing `ceiling` where the photo is saturated."""
    shown = Shown.apply(radiance_linear.reshape(-1, 3), coverage.reshape(-1), photo_srgb.reshape(-1, 3), ceiling)
    return shown.view(radiance_linear.shape)


def structural_dissimilarity(image: Float[Tensor, "height width 3"], photo: Float[Tensor, "height width 3"]) -> Float[Tensor, ""]:
    """Scalar (1 - SSIM) / 2 of two (height, width, 3) images (docs/sources.md: wang2004)."""
    return (1 - structural_similarity(image, photo)) / 2


def mask_loss(coverage: Float[Tensor, "height width"], mask: Float[Tensor, "height width"]) -> Float[Tensor, ""]:
    """Scalar binary cross-entropy of coverage (height, width) against the mask 0..1."""
    return MaskEntropy.apply(coverage.contiguous(), mask)


def edge_aware_smoothness(
    maps: Float[Tensor, "height width channel"], photo: Float[Tensor, "height width 3"], coverage: Float[Tensor, "height width"]
) -> Float[Tensor, ""]:
    """Scalar first-order smoothness of maps (height, width, c), less where the photo has an edge, only between solid pixels."""
    return Smoothness.apply(maps.contiguous(), photo.contiguous(), coverage.detach().contiguous())


def white_light(environment_radiance: Float[Tensor, "rows columns 3"]) -> Float[Tensor, ""]:
    """Scalar: mean over directions of the light's distance from its own grey, relative to its brightness, each by its share of all light.

    Light is whiter than paint: without this, colour wanders between the two (Liu et al. 2023; docs/sources.md: liu2023nero). Relative in its gradient, too:
    else it is less where light is dimmer, and brightness, which light and paint trade without a trace in photographs, all goes to paint.
    """
    grey = environment_radiance.mean(-1, keepdim=True).clamp(min=1e-6)
    share = (grey * texel_areas(environment_radiance)).detach()
    return ((environment_radiance / grey - 1).abs().mean(-1, keepdim=True) * share).sum() / share.sum()


def rough_light(environment_radiance: Float[Tensor, "rows columns 3"]) -> Float[Tensor, ""]:
    """Scalar total variation of the logarithm of the light, in both directions of its table: unseen texels follow their neighbours."""
    log = torch.log(environment_radiance.clamp(min=1e-4))
    return (log - torch.roll(log, 1, 1)).abs().mean() + (log[1:] - log[:-1]).abs().mean()


def texel_areas(environment_radiance: Float[Tensor, "rows columns 3"]) -> Float[Tensor, "rows 1 1"]:
    """(height, 1, 1) share of the sphere of a texel of each row."""
    height, width, _ = environment_radiance.shape
    edges = torch.cos(torch.linspace(0, torch.pi, height + 1, device=environment_radiance.device))
    return ((edges[:-1] - edges[1:]) / (2 * width))[:, None, None]


def crossed_halves(
    first: Float[Tensor, "*pixels 3"], second: Float[Tensor, "*pixels 3"], photo: Float[Tensor, "*pixels 3"]
) -> Float[Tensor, ""]:
    """Scalar: the mean absolute error of the mean of two independent estimates; its gradient takes the sign from one and the derivative from
    the other, in turn (Nicolet et al. 2023; docs/sources.md: nicolet2023). With one estimate for both it leans towards low variance."""
    crossed = 0.5 * (torch.sign(first.detach() - photo) * second + torch.sign(second.detach() - photo) * first)
    value = (0.5 * (first + second).detach() - photo).abs().mean()
    return value + (crossed - crossed.detach()).mean()


def crossed_squares(
    first: Float[Tensor, "*pixels 3"], second: Float[Tensor, "*pixels 3"], photo: Float[Tensor, "*pixels 3"]
) -> Float[Tensor, "*pixels"]:
    """(...) squared error of what two independent estimates are of, in the mean over draws; may be negative. The square of one estimate
    counts its noise as well."""
    return ((first - photo) * (second - photo)).mean(-1)
