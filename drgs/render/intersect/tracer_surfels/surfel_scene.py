"""Surfels in the form rays want them: packed frames and a tree of their boxes."""

import math
from dataclasses import dataclass
from typing import Any

import torch
import warp as wp
from jaxtyping import Float, Int
from torch import Tensor

from drgs.maths.constants import MIN_ALPHA
from drgs.scene.posed_scene import PosedSurfels
from drgs.warp_torch import warp_array

BOX_PADDING = 1e-4
"""Boxes grow by this share of the disc's size: a flat box must still catch rays that run in its plane up to rounding."""
COORDINATE_PADDING = 1e-6
"""... and by this share of the largest coordinate, about eight float32 steps."""
FLAT_LIMIT = 1e-6
"""Surfels whose tangents are parallel up to this sine have no plane, and are left out."""


@dataclass(frozen=True, eq=False)
class SurfelScene:
    """Written by build_surfel_scene, read by the tracers. Gradients reach the first four tensors."""

    centers: Float[Tensor, "surfel 3"]
    tangents: Float[Tensor, "surfel 3 2"]
    opacities: Float[Tensor, "surfel"]
    radiance: Float[Tensor, "surfel coefficient 3"]
    """Linear outgoing radiance: SH coefficients without the offset (1, 4, 9 or 16), or one constant colour."""
    view_dependent: bool
    """Whether `radiance` holds SH coefficients."""
    kept: Int[Tensor, "kept"]
    """int64: surfels in the tree, in rising order; transparent and degenerate ones are left out."""
    frames: Float[Tensor, "kept 3 4"]
    """Rows: centre and opacity; first tangent and |normal|; second tangent and the squared cutoff 2 ln(255 opacity)."""
    tree: Any
    """wp.Bvh over `kept`, or None when that is empty."""
    boxes: tuple[Tensor, Tensor]
    """The memory that the tree reads: lower and upper corners (kept, 3)."""


def build_surfel_scene(surfels: PosedSurfels, radiance: Tensor) -> SurfelScene:
    """Scene of surfels with outgoing radiance (N, 3), constant, or (N, C, 3), SH coefficients with C = 1, 4, 9 or 16.

    Raises:
        ValueError: a radiance tensor of another shape.
    """
    view_dependent = check_radiance(radiance, surfels.centers.shape[0])
    centers, tangents, opacities = (x.detach().float() for x in (surfels.centers, surfels.tangents, surfels.opacities))
    normal_length = torch.linalg.cross(tangents[:, :, 0], tangents[:, :, 1]).norm(dim=-1)
    solid = normal_length > FLAT_LIMIT * tangents[:, :, 0].norm(dim=-1) * tangents[:, :, 1].norm(dim=-1)
    finite = torch.isfinite(centers).all(-1) & torch.isfinite(normal_length)
    kept = (finite & solid & (opacities > MIN_ALPHA)).nonzero()[:, 0]
    centers, tangents, opacities, normal_length = centers[kept], tangents[kept], opacities[kept], normal_length[kept]

    cutoff = 2.0 * torch.log(opacities / MIN_ALPHA)
    rows = [torch.cat([centers, opacities[:, None]], -1), torch.cat([tangents[:, :, 0], normal_length[:, None]], -1)]
    frames = torch.stack([*rows, torch.cat([tangents[:, :, 1], cutoff[:, None]], -1)], 1).contiguous()
    half_box = cutoff.sqrt()[:, None] * tangents.norm(dim=-1)
    padding = BOX_PADDING * half_box.amax(-1, keepdim=True) + COORDINATE_PADDING * centers.abs().amax(-1, keepdim=True)
    boxes = (centers - half_box - padding).contiguous(), (centers + half_box + padding).contiguous()
    tree = wp.Bvh(warp_array(boxes[0], wp.vec3), warp_array(boxes[1], wp.vec3)) if kept.numel() else None
    packed = radiance if view_dependent else radiance[:, None]
    return SurfelScene(surfels.centers, surfels.tangents, surfels.opacities, packed, view_dependent, kept, frames, tree, boxes)


def check_radiance(radiance: Tensor, surfel_count: int) -> bool:
    """Whether `radiance` holds SH coefficients.

    Raises:
        ValueError: it has neither shape.
    """
    constant = radiance.shape == (surfel_count, 3)
    harmonics = radiance.ndim == 3 and radiance.shape[0] == surfel_count and radiance.shape[1] in (1, 4, 9, 16) and radiance.shape[2] == 3
    if not (constant or harmonics):
        raise ValueError(
            f"outgoing radiance has shape {tuple(radiance.shape)}; expected ({surfel_count}, 3) or ({surfel_count}, 1|4|9|16, 3) for {surfel_count} surfels"
        )
    return harmonics


def sh_degree(scene: SurfelScene) -> int:
    """Degree of the scene's radiance; -1 for a constant colour."""
    return math.isqrt(scene.radiance.shape[1]) - 1 if scene.view_dependent else -1
