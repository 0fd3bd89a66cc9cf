"""Mani-GS' way: local frames that know their triangle. Axes scale with its edges, Gaussians may stand off along them; radiance baked.

A Gaussian at E^-1 R^T (p - c) in the frame R of its triangle, c its middle and E = diag(e) its lengths, moves to c' + R' E' E^-1 R^T (p - c).
Source: Gao et al. 2025 (docs/sources.md: gao2025).
"""

import torch
from jaxtyping import Float
from torch import Tensor

from benchmarks.paper.face_splats import THIRDS, coarse_mesh, edge_frames, edge_lengths, splats_on_faces
from benchmarks.paper.fields import Field
from benchmarks.paper.splats import Splats, moved_splats, resting
from benchmarks.paper.variant import Bound, SplatVariant, Subject, baked
from drgs.reconstruct.geometry.bind_gaussians import bind_gaussians, foot_and_normal


def bind_in_frames(subject: Subject) -> Bound:
    """Three Gaussians a face, each at the closest point of the asset's own surface: the offsets that the paper learns on a poor mesh."""
    on_faces, fine = splats_on_faces(coarse_mesh(subject, len(THIRDS)), THIRDS), subject.asset.mesh
    found = bind_gaussians(on_faces.splats.centers, fine)
    places, _ = foot_and_normal(found.face, found.barycentric, fine.vertices, fine.faces)
    return Bound(resting(places, on_faces.splats.tangents, on_faces.splats.opacities), on_faces.anchors)


def frame_lengths(corners: Float[Tensor, "n 3 3"]) -> Float[Tensor, "n 3"]:
    """e of triangles (n, corner, 3) [world units]: the first edge; the mean of the other two across it; the mean of both along the normal."""
    lengths = edge_lengths(corners)
    across = 0.5 * (lengths[:, 1] + lengths[:, 2])
    return torch.stack([lengths[:, 0], across, 0.5 * (lengths[:, 0] + across)], -1)


def drive_in_frames(bound: Bound, field: Field) -> Splats:
    """Gaussians keep their coordinates in their triangle's frame."""
    anchors = bound.anchors
    assert anchors is not None
    rest, now = anchors.corners(anchors.vertices), anchors.corners(field(anchors.vertices)[0])
    growth = frame_lengths(now) / frame_lengths(rest).clamp(min=1e-30)
    linear = (edge_frames(now) * growth[:, None]) @ edge_frames(rest).mT
    local = bound.splats.centers - rest.mean(1)
    return moved_splats(bound.splats, now.mean(1) + (linear @ local[..., None]).squeeze(-1), linear)


MANI_GS = SplatVariant(
    "mani_gs",
    "Mani-GS",
    bind_in_frames,
    drive_in_frames,
    baked,
    relights=False,
    simplified="offsets are those to our surface, scales and angles follow from the face: none is learned; the frame scales Gaussians before it turns them, "
    "so that turns change nothing; harmonics turn with the frame",
)
