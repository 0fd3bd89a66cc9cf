"""SuGaR's way: flat Gaussians bound to the faces of the extracted mesh, six each, at fixed barycentrics; radiance baked.

Source: Guédon, Lepetit 2024 (docs/sources.md: guedon2024).
"""

from benchmarks.paper.face_splats import SIXTHS, areas, coarse_mesh, edge_frames, splats_on_faces
from benchmarks.paper.fields import Field
from benchmarks.paper.splats import Splats, moved_splats
from benchmarks.paper.variant import Bound, SplatVariant, Subject, baked


def bind_to_faces(subject: Subject) -> Bound:
    """Six Gaussians a face, in its plane."""
    return splats_on_faces(coarse_mesh(subject, len(SIXTHS)), SIXTHS)


def drive_with_faces(bound: Bound, field: Field) -> Splats:
    """Centres by barycentrics; frames turn with the face and grow with the root of its area."""
    anchors = bound.anchors
    assert anchors is not None
    rest, now = anchors.corners(anchors.vertices), anchors.corners(field(anchors.vertices)[0])
    growth = (areas(now) / areas(rest).clamp(min=1e-30)).sqrt()
    linear = growth[:, None, None] * (edge_frames(now) @ edge_frames(rest).mT)
    return moved_splats(bound.splats, (now * anchors.barycentric[..., None]).sum(1), linear)


SUGAR = SplatVariant(
    "sugar",
    "SuGaR",
    bind_to_faces,
    drive_with_faces,
    baked,
    relights=False,
    simplified="the mesh is ours with fewer faces, not Poisson's of a regularised fit; the Gaussians' scales and in-plane angles follow from the face and are "
    "not learned; harmonics turn with the face",
)
