"""What fitting minimises, term by term. Images are (height, width, 3) in sRGB, extended above 1, times coverage."""

import torch
from jaxtyping import Float
from torch import Tensor

from drgs.maths.color import srgb_from_linear
from drgs.scene.camera import Camera

SSIM_SIGMA = 1.5
SSIM_RADIUS = 5


def display_image(
    radiance_linear: Float[Tensor, "*pixels 3"],
    coverage: Float[Tensor, "*pixels"],
    photo_srgb: Float[Tensor, "*pixels 3"],
    ceiling: float = 1.0,
) -> Float[Tensor, "*pixels 3"]:
    """Radiance (..., 3) as the camera would have stored it, times coverage: sRGB, and no reward for passing `ceiling` where the photo is saturated."""
    srgb = srgb_from_linear(radiance_linear)
    saturated = photo_srgb >= 254 / 255 * ceiling
    return torch.where(saturated, srgb.clamp(max=ceiling), srgb) * coverage[..., None]


def _window_matrix(size: int, like: Float[Tensor, "..."]) -> Float[Tensor, "{size} {size}"]:
    """(size, size) banded: the SSIM window as a product, an order of magnitude faster on the CPU than a small convolution."""
    offsets = torch.arange(size, dtype=like.dtype, device=like.device)
    distance = offsets[:, None] - offsets
    kernel = torch.exp(-0.5 * (torch.arange(-SSIM_RADIUS, SSIM_RADIUS + 1, dtype=like.dtype) / SSIM_SIGMA) ** 2).sum().item()
    weights = torch.exp(-0.5 * (distance / SSIM_SIGMA) ** 2) / kernel
    return torch.where(distance.abs() <= SSIM_RADIUS, weights, torch.zeros_like(weights))


def _blur(images: Float[Tensor, "n height width"]) -> Float[Tensor, "n height width"]:
    """(n, height, width) smoothed by the SSIM window, zero padding."""
    along_x, along_y = _window_matrix(images.shape[2], images), _window_matrix(images.shape[1], images)
    return along_y @ (images.reshape(-1, images.shape[2]) @ along_x).view_as(images)


def structural_dissimilarity(image: Float[Tensor, "height width 3"], photo: Float[Tensor, "height width 3"]) -> Float[Tensor, ""]:
    """Scalar (1 - SSIM) / 2 of two (height, width, 3) images: Gaussian window of 11 pixels, sigma 1.5, data range 1 (Wang et al. 2004)."""
    a, b = image.permute(2, 0, 1), photo.permute(2, 0, 1)
    means_a, means_b, squares_a, squares_b, products = _blur(torch.cat([a, b, a * a, b * b, a * b])).split(3)
    variance_a, variance_b = squares_a - means_a * means_a, squares_b - means_b * means_b
    covariance = products - means_a * means_b
    ssim = ((2 * means_a * means_b + 1e-4) * (2 * covariance + 9e-4)) / (
        (means_a * means_a + means_b * means_b + 1e-4) * (variance_a + variance_b + 9e-4)
    )
    return (1 - ssim.mean()) / 2


def mask_loss(coverage: Float[Tensor, "height width"], mask: Float[Tensor, "height width"]) -> Float[Tensor, ""]:
    """Scalar binary cross-entropy of coverage (height, width) against the mask 0..1."""
    return torch.nn.functional.binary_cross_entropy(coverage.clamp(1e-4, 1 - 1e-4), mask)


def normals_from_depth(depth: Float[Tensor, "height width"], camera: Camera) -> Float[Tensor, "height width 3"]:
    """(height, width, 3) unit world normals, facing the camera, of the surface that a depth map draws; border pixels repeat."""
    fx, fy = camera.intrinsics[0, 0], camera.intrinsics[1, 1]
    cx, cy = camera.intrinsics[0, 2], camera.intrinsics[1, 2]
    x = (torch.arange(camera.width, device=depth.device) + 0.5 - cx) / fx
    y = (torch.arange(camera.height, device=depth.device) + 0.5 - cy) / fy
    # With P = z (x, y, 1), the cross product of P_x and P_y, divided by z: no 3-vectors until the end.
    z = depth
    dz_dx = torch.nn.functional.pad((z[:, 2:] - z[:, :-2])[None], (1, 1), mode="replicate")[0] * (0.5 * fx)
    dz_dy = torch.nn.functional.pad((z[2:] - z[:-2])[None, None], (0, 0, 1, 1), mode="replicate")[0, 0] * (0.5 * fy)
    normal = torch.stack([dz_dx, dz_dy, -(z + x * dz_dx + y[:, None] * dz_dy)], -1)
    return torch.nn.functional.normalize(normal, dim=-1) @ camera.camera_from_world[:3, :3]


def normal_consistency(
    normal_world: Float[Tensor, "height width 3"],
    depth: Float[Tensor, "height width"],
    coverage: Float[Tensor, "height width"],
    camera: Camera,
) -> Float[Tensor, ""]:
    """Scalar mean over solid pixels of 1 - n . n_depth: surfels lie in the surface that they draw (Huang et al. 2024, eq. 14)."""
    from_depth = normals_from_depth(depth, camera)
    solid = coverage.detach() > 0.5
    inside = -torch.nn.functional.max_pool2d(-solid.float()[None, None], 3, 1, 1)[0, 0]  # all nine neighbours solid
    agreement = 1 - (normal_world * from_depth).sum(-1)
    return (agreement * inside).sum() / inside.sum().clamp(min=1)


def edge_aware_smoothness(
    maps: Float[Tensor, "height width channel"], photo: Float[Tensor, "height width 3"], coverage: Float[Tensor, "height width"]
) -> Float[Tensor, ""]:
    """Scalar first-order smoothness of maps (height, width, c), less where the photo has an edge, only between solid pixels."""
    solid = (coverage.detach() > 0.9).float()
    total = maps.new_zeros(())
    for axis in (0, 1):
        ahead, here = [slice(None)] * 2, [slice(None)] * 2
        ahead[axis], here[axis] = slice(1, None), slice(None, -1)
        edge = (photo[tuple(ahead)] - photo[tuple(here)]).abs().mean(-1)
        weight = torch.exp(-8 * edge) * solid[tuple(ahead)] * solid[tuple(here)]
        total = total + ((maps[tuple(ahead)] - maps[tuple(here)]).abs().mean(-1) * weight).sum() / solid.sum().clamp(min=1)
    return total


def white_light(environment_radiance: Float[Tensor, "rows columns 3"]) -> Float[Tensor, ""]:
    """Scalar: mean over directions of the light's distance from its own grey, relative to its brightness.

    Light is whiter than paint: without this, colour wanders between the two (Liu et al. 2023; docs/sources.md: liu2023nero).
    """
    area = texel_areas(environment_radiance)
    distance = (environment_radiance - environment_radiance.mean(-1, keepdim=True)).abs()
    return (distance * area).sum() / (environment_radiance * area).sum().detach().clamp(min=1e-6)


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
