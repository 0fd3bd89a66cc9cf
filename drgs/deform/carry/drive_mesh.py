"""A mesh with new vertex positions carries the surfels that are bound to it.

F of a face from its edges and its scaled normal (Sumner & Popovic 2004), F of a vertex as the mean over its faces by area at
rest, F of a surfel by its barycentrics; then B' = F B, and the centre keeps its place relative to the moved face:
p' = sum w v' + F (p - sum w v). That reproduces the rest pose, rigid motions and similarities.
"""

from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from drgs.deform.carry.carry_gaussians import carry_tangents, guard_gradient
from drgs.scene.binding import Binding

DEGENERATE = 1e-12
"""Faces whose area at rest is below this part of the median say nothing about F."""


def vertex_gradients(
    vertices: Float[Tensor, "vertex 3"], moved: Float[Tensor, "vertex 3"], faces: Int[Tensor, "face 3"]
) -> Float[Tensor, "vertex 3 3"]:
    """(vertex, 3, 3) deformation gradients that take vertices (vertex, 3) to moved (vertex, 3); identity where no face tells."""
    rest, now = _face_frames(vertices.double(), faces), _face_frames(moved.double(), faces)
    area = torch.linalg.cross(rest[..., 0], rest[..., 1]).norm(dim=-1)
    good = area > DEGENERATE * area.median().clamp(min=1e-300)
    index = faces.long()[good]
    gradient = now[good] @ torch.linalg.inv(rest[good])
    total = vertices.new_zeros(len(vertices), dtype=torch.float64)
    mean = vertices.new_zeros(len(vertices), 3, 3, dtype=torch.float64)
    for corner in range(3):
        total.index_add_(0, index[:, corner], area[good])
        mean.index_add_(0, index[:, corner], gradient * area[good][:, None, None])
    identity = torch.eye(3, dtype=torch.float64, device=vertices.device)
    return torch.where((total > 0)[:, None, None], mean / total.clamp(min=1e-300)[:, None, None], identity).to(vertices.dtype)


def drive_surfels(
    vertices: Float[Tensor, "vertex 3"],
    moved: Float[Tensor, "vertex 3"],
    faces: Int[Tensor, "face 3"],
    gradients: Float[Tensor, "vertex 3 3"],
    binding: Binding,
    centers: Float[Tensor, "surfel 3"],
    tangents: Float[Tensor, "surfel 3 2"],
    variant: Literal["corrected", "paper"] = "corrected",
) -> tuple[Float[Tensor, "surfel 3"], Float[Tensor, "surfel 3 2"]]:
    """Moved centres (surfel, 3) and tangents (surfel, 3, 2), from the mesh at rest, moved, and `vertex_gradients`.

    Args:
        variant: paper: Eq. 8 of drgs2026 as printed. Centres move by the mean of the corners' displacements, so the offset along the
            normal does not turn; rotations and stretches of the corners are averaged as matrices, then Eq. 7. For comparison.
    """
    if variant == "paper":
        corners = faces.long()[binding.face.long()]
        weights = binding.barycentric[..., None]
        rotation, stretch = _polar(gradients)
        blended = (rotation[corners] * weights[..., None]).sum(1)
        # On the processor: cuSOLVER (of torch 2.11 with CUDA 13) refuses a batch of two hundred thousand.
        lengths = torch.linalg.eigvalsh((stretch[corners] * weights[..., None]).sum(1).double().cpu()).abs().to(tangents)  # ascending
        scale = torch.stack([lengths[:, 1], lengths[:, 0]], -1)
        return centers + ((moved - vertices)[corners] * weights).sum(1), blended @ tangents * scale[:, None]
    places, gradient = drive_points(vertices, moved, faces, gradients, binding, centers)
    return places, carry_tangents(tangents, gradient)


def drive_points(
    vertices: Float[Tensor, "vertex 3"],
    moved: Float[Tensor, "vertex 3"],
    faces: Int[Tensor, "face 3"],
    gradients: Float[Tensor, "vertex 3 3"],
    binding: Binding,
    points: Float[Tensor, "point 3"],
) -> tuple[Float[Tensor, "point 3"], Float[Tensor, "point 3 3"]]:
    """Moved points and F there, of points bound to the mesh."""
    corners = faces.long()[binding.face.long()]
    weights = binding.barycentric[..., None]
    gradient = (gradients[corners] * weights[..., None]).sum(1)
    foot, foot_moved = (vertices[corners] * weights).sum(1), (moved[corners] * weights).sum(1)
    return foot_moved + (gradient @ (points - foot)[..., None]).squeeze(-1), gradient


def _polar(gradients: Float[Tensor, "n 3 3"]) -> tuple[Float[Tensor, "n 3 3"], Float[Tensor, "n 3 3"]]:
    """Rotation and symmetric stretch (n, 3, 3) of F = R S, guarded."""
    f = guard_gradient(gradients).double()
    u, s, vt = torch.linalg.svd(f)
    return (u @ vt).to(gradients.dtype), (vt.mT @ torch.diag_embed(s) @ vt).to(gradients.dtype)


def _face_frames(vertices: Float[Tensor, "vertex 3"], faces: Int[Tensor, "face 3"]) -> Float[Tensor, "face 3 3"]:
    """(face, 3, 3): columns e1, e2 and the unit normal times the square root of |e1 x e2|."""
    a, b, c = vertices[faces.long()].unbind(1)
    normal = torch.linalg.cross(b - a, c - a)
    size = normal.norm(dim=-1, keepdim=True)
    return torch.stack([b - a, c - a, normal / torch.sqrt(size.clamp(min=1e-300))], -1)
