"""Radiance baked into Gaussians whose shape stands: spherical harmonics of degree 3, fitted to the training photographs.

In: Gaussians, photographs with masks and, where only a rest is to be baked, what is shaded already. Out: coefficients of sRGB by
direction. Each Gaussian is solved alone by linear least squares: its mean colour in every view that sees it, weighted by how much of the
view it is. Then the same for what the drawn pictures still lack, in some rounds, for neighbours blend: Landweber's iteration, with the
blocks of the normal matrix as its step. Source: Kerbl et al. 2023 for what is fitted (docs/sources.md: kerbl2023); the solver is ours.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from benchmarks.paper.splats import Splats, blend, directions_at_rest
from drgs.maths.constants import MIN_COVERAGE
from drgs.maths.spherical_harmonics import SH_OFFSET, evaluate_sh, sh_basis
from drgs.scene.camera import Camera
from drgs.scene.views import Views

ShadedColors = Callable[[Camera], Tensor]
"""(splat, 3) sRGB that harmonics are added to, seen from a camera."""
RIDGE = 1e-3
"""Of the least squares, as a share of what a Gaussian was seen, times 1 + degree^2: views from one side leave the other side open."""


@dataclass(frozen=True)
class BakeSettings:
    """How harmonics are fitted."""

    rounds: int = 6
    """Passes over the photographs after the first."""
    every: int = 1
    """Only every so many-th photograph is looked at."""


def even_colors(splats: Splats) -> ShadedColors:
    """The offset that files' harmonics are counted from: everything is baked."""
    return lambda camera: torch.full_like(splats.centers, SH_OFFSET)


def harmonic_colors(sh: Float[Tensor, "splat 16 3"], splats: Splats, camera: Camera, shaded: ShadedColors) -> Float[Tensor, "splat 3"]:
    """sRGB of each Gaussian towards the camera, not below 0."""
    return (shaded(camera) + evaluate_sh(sh, directions_at_rest(splats, camera))).clamp(min=0)


def bake_harmonics(views: Views, splats: Splats, shaded: ShadedColors, settings: BakeSettings) -> Float[Tensor, "splat 16 3"]:
    """Coefficients that reproduce the photographs; 0 for Gaussians that none of them shows."""
    count = len(splats.centers)
    matrix, right, seen = torch.zeros(count, 16, 16), torch.zeros(count, 16, 3), torch.zeros(count)
    chosen = range(0, len(views.cameras), settings.every)
    for index in chosen:
        camera = views.cameras[index]
        image, mask = photograph(views, index)
        sums = gathered(splats, image, mask, camera)
        basis, weight = sh_basis(directions_at_rest(splats, camera)), sums[:, 3:]
        matrix += (basis * weight)[:, :, None] * basis[:, None, :]
        right += basis[:, :, None] * (sums[:, :3] - weight * shaded(camera))[:, None, :]
        seen += weight[:, 0]
    degree = torch.tensor([math.isqrt(k) for k in range(16)])
    ridge = RIDGE * (1.0 + degree**2) * (seen[:, None] + 1e-6)
    factor = torch.linalg.cholesky(matrix + torch.diag_embed(ridge))
    del matrix  # a kilobyte a Gaussian
    sh = torch.cholesky_solve(right, factor)
    for _ in range(settings.rounds):
        right = torch.zeros_like(sh)
        for index in chosen:
            camera = views.cameras[index]
            lacking, mask = missing_light(views, index, splats, harmonic_colors(sh, splats, camera, shaded))
            sums = gathered(splats, lacking, mask, camera)
            right += sh_basis(directions_at_rest(splats, camera))[:, :, None] * sums[:, None, :3]
        sh = sh + torch.cholesky_solve(right, factor)
    return sh


def photograph(views: Views, index: int) -> tuple[Float[Tensor, "height width 3"], Float[Tensor, "height width 1"]]:
    """Straight sRGB and coverage of a view, 0..1."""
    return views.images_srgb[index].float() / 255, views.coverage[index].float()[..., None] / 255


def missing_light(
    views: Views, index: int, splats: Splats, colors: Float[Tensor, "splat 3"]
) -> tuple[Float[Tensor, "height width 3"], Float[Tensor, "height width 1"]]:
    """What a drawn picture lacks of the photograph, in sRGB, and where both show the object."""
    image, mask = photograph(views, index)
    maps = blend(splats, colors.contiguous(), views.cameras[index])
    drawn = maps.features.permute(1, 2, 0) / maps.coverage.clamp(min=MIN_COVERAGE)[..., None]
    return image - drawn, mask * maps.coverage[..., None]


def gathered(
    splats: Splats, image: Float[Tensor, "height width channel"], weight: Float[Tensor, "height width 1"], camera: Camera
) -> Float[Tensor, "splat channel_plus_1"]:
    """Of each Gaussian, sums over pixels of its blending weight times `weight` times (image, 1)."""
    with torch.enable_grad():
        features = torch.zeros(len(splats.centers), image.shape[-1] + 1, requires_grad=True)
        # The gradient of sum_p w_ip f_i t_p with respect to f_i is what Gaussian i is asked to show.
        wanted = torch.cat([image * weight, weight], -1).permute(2, 0, 1)
        return torch.autograd.grad((blend(splats, features, camera).features * wanted).sum(), features)[0]
