"""Surfels under a deformation gradient F: B' = F B, exact, without any decomposition; normals by the cofactor.

Where F is inverted or nearly singular (a folded mesh), its signed singular values are clamped first, so that every surfel keeps
an area and a side. Source: docs/sources.md (huang2024 for B); the cofactor rule is Nanson's formula.
"""

from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from drgs.maths.frames import quat_wxyz_from_rotation

SMALLEST_STRETCH = 1e-2
LARGEST_STRETCH = 1e2
"""Bounds of the singular values of F that a surfel may feel."""


def cofactor(matrix: Float[Tensor, "*n 3 3"]) -> Float[Tensor, "*n 3 3"]:
    """(..., 3, 3) cofactor matrices, det(M) M^-T without the division."""
    a, b, c = matrix.unbind(-1)
    return torch.stack([torch.linalg.cross(b, c), torch.linalg.cross(c, a), torch.linalg.cross(a, b)], -1)


def guard_gradient(gradient: Float[Tensor, "n 3 3"]) -> Float[Tensor, "n 3 3"]:
    """(n, 3, 3) F with det > 0 and singular values within the bounds; matrices that already are so are returned as they were.

    A matrix that is not finite becomes the identity: whoever made it refuses the positions that belong to it.
    """
    finite = torch.isfinite(gradient).flatten(-2).all(-1)
    if not finite.all():
        gradient = torch.where(finite[:, None, None], gradient, torch.eye(3, dtype=gradient.dtype, device=gradient.device))
    minors = cofactor(gradient)
    determinant = (gradient[..., 0] * minors[..., 0]).sum(-1)
    # sigma_3 lies within [J, sqrt(3) J] / |cof F|, and sigma_1 below |F|: only suspects pay for a decomposition.
    low = determinant <= SMALLEST_STRETCH * minors.flatten(-2).norm(dim=-1)
    suspect = low | (gradient.flatten(-2).norm(dim=-1) > LARGEST_STRETCH)
    if not suspect.any():
        return gradient
    u, s, vt = torch.linalg.svd(gradient[suspect].double())
    s = s.clone()
    s[:, 2] *= torch.sign(torch.linalg.det(u @ vt))
    u[:, :, 2] *= torch.sign(torch.linalg.det(u))[:, None]  # U and V become rotations; the sign now stands in s
    vt[:, 2] *= torch.sign(torch.linalg.det(vt))[:, None]
    guarded = gradient.clone()
    guarded[suspect] = (u * s.clamp(SMALLEST_STRETCH, LARGEST_STRETCH)[:, None, :] @ vt).to(gradient.dtype)
    return guarded


def carry_tangents(
    tangents: Float[Tensor, "n 3 2"],
    gradient: Float[Tensor, "n 3 3"],
    variant: Literal["exact", "paper"] = "exact",
    order: Literal["ascending", "descending"] = "ascending",
) -> Float[Tensor, "n 3 2"]:
    """(n, 3, 2) moved tangents B' = F B of tangents (n, 3, 2); F (n, 3, 3) is guarded here.

    Args:
        variant: paper: Eq. 7 of drgs2026. F = R S; the tangents turn with R and are scaled by two eigenvalues of S, whatever axes
            those belong to. For comparison: it is right for rotations and uniform scales only.
        order: of the eigenvalues, which the paper leaves open.
    """
    gradient = guard_gradient(gradient)
    if variant == "exact":
        return gradient @ tangents
    u, s, vt = torch.linalg.svd(gradient.double())
    lengths = s.flip(-1) if order == "ascending" else s  # lambda_1, lambda_2, lambda_3; torch sorts descending
    scale = torch.stack([lengths[:, 1], lengths[:, 0]], -1)
    return ((u @ vt) @ tangents.double() * scale[:, None]).to(tangents.dtype)


def carry_normals(normals: Float[Tensor, "n 3"], gradient: Float[Tensor, "n 3 3"]) -> Float[Tensor, "n 3"]:
    """(n, 3) unit normals cof(F) n / |cof(F) n| of normals (n, 3); F (n, 3, 3) is guarded here."""
    return torch.nn.functional.normalize((cofactor(guard_gradient(gradient)) @ normals[..., None]).squeeze(-1), dim=-1, eps=1e-30)


def decompose_tangents(tangents: Float[Tensor, "n 3 2"]) -> tuple[Float[Tensor, "n 4"], Float[Tensor, "n 2"]]:
    """Quaternions wxyz (n, 4) and log scales (n, 2), longer first, of tangents (n, 3, 2): what files hold of a moved surfel.

    The second scale comes from the area, |B1 x B2| / s1, which keeps its digits where m - q would cancel.
    """
    first, second = tangents.unbind(-1)
    a, b, c = (first * first).sum(-1), (first * second).sum(-1), (second * second).sum(-1)
    mean, spread = (a + c) / 2, torch.hypot((a - c) / 2, b)
    angle = 0.5 * torch.atan2(2 * b, a - c)
    area_normal = torch.linalg.cross(first, second)
    tiny = torch.finfo(tangents.dtype).tiny
    s1 = torch.sqrt(mean + spread).clamp(min=tiny)
    s2 = (area_normal.norm(dim=-1) / s1).clamp(min=tiny)
    t1 = (first * torch.cos(angle)[:, None] + second * torch.sin(angle)[:, None]) / s1[:, None]
    normal = torch.nn.functional.normalize(area_normal, dim=-1, eps=tiny)
    t1 = torch.nn.functional.normalize(t1, dim=-1, eps=tiny)
    rotation = torch.stack([t1, torch.linalg.cross(normal, t1), normal], -1)
    return quat_wxyz_from_rotation(rotation), torch.log(torch.stack([s1, s2], -1))
