"""2D Gaussians (surfels), after Huang et al. 2024 (docs/sources.md: huang2024), with materials."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from drgs.maths.frames import rotation_from_quat_wxyz


@dataclass(frozen=True, eq=False)
class Gaussians:
    """Surfels of an object at rest, in the units files hold (logits, logs); materials are already in [0, 1]."""

    centers: Float[Tensor, "surfel 3"]
    """World position."""
    log_scales: Float[Tensor, "surfel 2"]
    """log of (s_u, s_v) [world units]: standard deviations along the tangents."""
    quats_wxyz: Float[Tensor, "surfel 4"]
    """R = [t_u t_v n]; not necessarily of unit length."""
    opacity_logits: Float[Tensor, "surfel"]
    sh: Float[Tensor, "surfel 16 3"]
    """Real spherical harmonics to degree 3 of linear outgoing radiance under the capture's light, 3DGS basis and order, +0.5 offset."""
    albedo: Float[Tensor, "surfel 3"]
    """Base colour, linear, 0..1."""
    roughness: Float[Tensor, "surfel"]
    """r, 0..1; GGX alpha = r^2."""
    metallic: Float[Tensor, "surfel"]
    """m, 0..1."""


def surfel_tangents(gaussians: Gaussians) -> Tensor:
    """(surfel, 3, 2): columns s_u t_u and s_v t_v. Deformation multiplies these by F (B' = F B)."""
    rotation = rotation_from_quat_wxyz(gaussians.quats_wxyz)
    return rotation[:, :, :2] * torch.exp(gaussians.log_scales)[:, None, :]
