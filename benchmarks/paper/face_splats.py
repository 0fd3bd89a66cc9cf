"""Gaussians on the faces of a mesh, several each, and the frames of moved faces: what the ways that hold to a mesh share.

In: the asset's mesh with fewer faces, so that n Gaussians a face make the budget. Out: flat Gaussians at fixed barycentrics, together as wide as
their face, and where they sit.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from benchmarks.paper.splats import resting
from benchmarks.paper.variant import Bound, FaceAnchors, Subject
from drgs.maths.constants import MAX_ALPHA
from drgs.reconstruct.geometry.face_surfels import WIDTH
from drgs.reconstruct.geometry.mesh_from_gaussians import reduced_mesh
from drgs.reconstruct.geometry.mesh_surfels import face_frames
from drgs.scene.mesh import TriangleMesh

MIDDLE = ((1 / 3, 1 / 3, 1 / 3),)
THIRDS = ((2 / 3, 1 / 6, 1 / 6), (1 / 6, 2 / 3, 1 / 6), (1 / 6, 1 / 6, 2 / 3))
"""Middles of a triangle's corners."""
QUARTERS = (*MIDDLE, *THIRDS)
"""Middles of the four triangles that the middles of its edges cut it into."""
SIXTHS = tuple((a / 18, b / 18, c / 18) for a, b, c in ((11, 5, 2), (11, 2, 5), (5, 11, 2), (2, 11, 5), (5, 2, 11), (2, 5, 11)))
"""Middles of the six triangles that its medians cut it into."""


def coarse_mesh(subject: Subject, gaussians_a_face: int) -> TriangleMesh:
    """The asset's mesh with as many faces as the budget holds."""
    mesh = subject.asset.mesh
    radius = 0.5 * float((mesh.vertices.amax(0) - mesh.vertices.amin(0)).norm())
    return reduced_mesh(mesh, max(subject.budget // gaussians_a_face, 4), radius)


def splats_on_faces(mesh: TriangleMesh, pattern: tuple[tuple[float, float, float], ...]) -> Bound:
    """Gaussians at the pattern's barycentrics on every face, in its plane, with its second moment over their number."""
    frames = face_frames(mesh)
    count, each = len(mesh.faces), len(pattern)
    face = torch.arange(count).repeat_interleave(each)
    barycentric = torch.tensor(pattern).repeat(count, 1)
    tangents = frames.rotation[:, :, :2] * (WIDTH * frames.scales * each**-0.5)[:, None]
    centers = (mesh.vertices[mesh.faces.long()[face]] * barycentric[..., None]).sum(1)
    anchors = FaceAnchors(mesh.vertices, mesh.faces, face.int(), barycentric, torch.zeros(len(face)))
    return Bound(resting(centers, tangents[face], torch.full((len(face),), MAX_ALPHA)), anchors)


def edge_frames(corners: Float[Tensor, "n 3 3"]) -> Float[Tensor, "n 3 3"]:
    """Rotations with columns: first edge's direction, across it in the plane, unit normal; of triangles (n, corner, 3)."""
    along = torch.nn.functional.normalize(corners[:, 1] - corners[:, 0], dim=-1, eps=1e-30)
    normal = torch.nn.functional.normalize(
        torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), dim=-1, eps=1e-30
    )
    return torch.stack([along, torch.linalg.cross(normal, along), normal], -1)


def edge_lengths(corners: Float[Tensor, "n 3 3"]) -> Float[Tensor, "n 3"]:
    """Of the edges 01, 12, 20 [world units], of triangles (n, corner, 3)."""
    return (corners - corners.roll(-1, 1)).norm(dim=-1)


def areas(corners: Float[Tensor, "n 3 3"]) -> Float[Tensor, "n"]:
    """Of triangles (n, corner, 3) [world units squared]."""
    return 0.5 * torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]).norm(dim=-1)
