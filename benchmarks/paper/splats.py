"""Flat Gaussians with a colour each, as the other systems draw them: no rays, no light.

In: Gaussians at rest and how each is moved by an affine map of its own. Out: pictures. What a colour is, baked or shaded, is the
variants' matter. Drawn by the rasteriser that fits and shows our own surfels, so that the comparison is of what is drawn, not of how.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from drgs.deform.carry.carry_gaussians import guard_gradient
from drgs.deform.carry.gmls import polar_rotation
from drgs.maths.constants import MIN_COVERAGE
from drgs.render.visible.rasterize import RasterMaps, RasterSettings, rasterize
from drgs.render.visible.rasterize.near_plane import near_plane_of
from drgs.scene.camera import Camera


@dataclass(frozen=True, eq=False)
class Splats:
    """Gaussians in the world, at rest or moved."""

    centers: Float[Tensor, "splat 3"]
    tangents: Float[Tensor, "splat 3 2"]
    """B, of covariance B B^T; columns need not be orthogonal [world units]."""
    opacities: Float[Tensor, "splat"]
    turn: Float[Tensor, "splat 3 3"]
    """Rotation since rest: what was baked for direction d is sent in direction turn @ d."""


def resting(centers: Float[Tensor, "splat 3"], tangents: Float[Tensor, "splat 3 2"], opacities: Float[Tensor, "splat"]) -> Splats:
    """Gaussians that have not turned yet."""
    return Splats(centers, tangents, opacities, torch.eye(3, device=centers.device).expand(len(centers), 3, 3))


def moved_splats(rest: Splats, centers: Float[Tensor, "splat 3"], linear: Float[Tensor, "splat 3 3"]) -> Splats:
    """Gaussians at new centres whose covariance S becomes A S A^T and whose radiance turns with the rotation of A = linear (splat, 3, 3).

    A is guarded as our own surfels' gradients are (carry_gaussians.py), so that no way is punished for a folded triangle.
    """
    safe = guard_gradient(linear)
    return Splats(centers, safe @ rest.tangents, rest.opacities, polar_rotation(safe))


def covariances(splats: Splats) -> Float[Tensor, "splat 3 3"]:
    """B B^T [world units squared]."""
    return splats.tangents @ splats.tangents.mT


def directions_at_rest(splats: Splats, camera: Camera) -> Float[Tensor, "splat 3"]:
    """Unit directions from the camera to each Gaussian, as the Gaussian saw them at rest: R^T d, which turns harmonics with R."""
    towards = torch.nn.functional.normalize(splats.centers - camera.center_world.to(splats.centers), dim=-1)
    return (splats.turn.mT @ towards[..., None]).squeeze(-1)


def blend(splats: Splats, features: Float[Tensor, "splat channel"], camera: Camera) -> RasterMaps:
    """Front to back, sums not divided by coverage; differentiable in what the Gaussians are and in their features."""
    settings = RasterSettings(near=near_plane_of(splats.centers), depth=False)
    return rasterize(splats.centers, splats.tangents, splats.opacities, features, camera, settings)


def draw(splats: Splats, colors_srgb: Float[Tensor, "splat 3"], camera: Camera) -> Float[Tensor, "height width 4"]:
    """Straight sRGB with alpha, 0..1. Colours are blended as they are shown, in sRGB, as all of these systems do."""
    maps = blend(splats, colors_srgb.contiguous(), camera)
    mean = maps.features.permute(1, 2, 0) / maps.coverage.clamp(min=MIN_COVERAGE)[..., None]
    return torch.cat([mean, maps.coverage[..., None]], -1).clamp(0, 1)
