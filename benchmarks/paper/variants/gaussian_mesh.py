"""GaussianMesh's way: one Gaussian a face, split with its face where photographs disagree; corners' rotations and stretches blended.

Source: Gao et al. 2024 (docs/sources.md: gao2024), and drgs2026, whose Alg. 1 and Eq. 8 take it over; mesh_surfels.py has the binding.
"""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from benchmarks.paper.face_splats import QUARTERS, coarse_mesh, edge_lengths
from benchmarks.paper.fields import Field
from benchmarks.paper.harmonics import bake_harmonics, even_colors, gathered, harmonic_colors, missing_light
from benchmarks.paper.splats import Splats, moved_splats, resting
from benchmarks.paper.variant import Bound, FaceAnchors, SplatVariant, Subject, baked
from drgs.deform.carry.drive_mesh import vertex_gradients
from drgs.deform.carry.gmls import polar_rotation
from drgs.reconstruct.geometry.bind_gaussians import foot_and_normal
from drgs.reconstruct.geometry.face_surfels import WIDTH
from drgs.reconstruct.geometry.mesh_surfels import mesh_surfels
from drgs.scene.gaussians import surfel_tangents

SPLIT_SHARE = 1 / 3
"""Of the Gaussians that are split: a split adds three, so these double their number."""
LARGEST = 1.0
"""Of a Gaussian's standard deviation [its face's longest edge]: what is larger is drawn as spikes when faces move."""


def bind_and_split(subject: Subject) -> Bound:
    """Gaussians on faces, those split that the photographs disagree with most."""
    gaussians = subject.asset.gaussians
    assert gaussians is not None
    mesh = coarse_mesh(subject, 2)
    placed, binding = mesh_surfels(gaussians, mesh)
    anchors = FaceAnchors(mesh.vertices, mesh.faces, binding.face, binding.barycentric, binding.normal_offset)
    tangents = capped(WIDTH * surfel_tangents(placed), edge_lengths(anchors.corners(mesh.vertices)).amax(-1))
    bound = Bound(resting(placed.centers, tangents, torch.sigmoid(placed.opacity_logits)), anchors)
    error = disagreement(subject, bound)
    worst = error >= error.sort(descending=True).values[int(SPLIT_SHARE * (len(error) - 1))]
    return split(bound, worst)


def capped(tangents: Float[Tensor, "splat 3 2"], longest: Float[Tensor, "splat"]) -> Float[Tensor, "splat 3 2"]:
    """Tangents no longer than LARGEST of their face's longest edge [world units]: sizes are regularised by the face."""
    length = tangents.norm(dim=1, keepdim=True)
    return tangents * (LARGEST * longest[:, None, None] / length.clamp(min=1e-30)).clamp(max=1)


def disagreement(subject: Subject, bound: Bound) -> Float[Tensor, "splat"]:
    """Squared difference from the photographs that each Gaussian has a part in, with harmonics of one pass."""
    splats, shaded = bound.splats, even_colors(bound.splats)
    few = replace(subject.bake, rounds=0, every=max(4, subject.bake.every))
    sh = bake_harmonics(subject.views, splats, shaded, few)
    error = torch.zeros(len(splats.centers))
    for index in range(0, len(subject.views.cameras), few.every):
        camera = subject.views.cameras[index]
        lacking, mask = missing_light(subject.views, index, splats, harmonic_colors(sh, splats, camera, shaded))
        error += gathered(splats, lacking.square().sum(-1, keepdim=True), mask, camera)[:, 0]
    return error


def split(bound: Bound, chosen: Tensor) -> Bound:
    """With four Gaussians of half the size, one in each quarter of the face, for each that is chosen (splat,) bool; they keep its offset."""
    anchors, splats = bound.anchors, bound.splats
    assert anchors is not None
    each = len(QUARTERS)
    face, offset = anchors.face[chosen].repeat_interleave(each), anchors.offset[chosen].repeat_interleave(each)
    barycentric = torch.tensor(QUARTERS).repeat(int(chosen.sum()), 1)
    foot, normal = foot_and_normal(face, barycentric, anchors.vertices, anchors.faces)
    children = (
        foot + offset[:, None] * normal,
        splats.tangents[chosen].repeat_interleave(each, 0) / 2,
        splats.opacities[chosen].repeat_interleave(each),
    )
    parents = splats.centers[~chosen], splats.tangents[~chosen], splats.opacities[~chosen]
    kept = anchors.face[~chosen], anchors.barycentric[~chosen], anchors.offset[~chosen]
    places = (torch.cat(pair) for pair in zip(kept, (face, barycentric, offset), strict=True))
    return Bound(
        resting(*(torch.cat(pair) for pair in zip(parents, children, strict=True))), FaceAnchors(anchors.vertices, anchors.faces, *places)
    )


def drive_by_corners(bound: Bound, field: Field) -> Splats:
    """F of a Gaussian is R S, R the rotation nearest to the mean of its corners' rotations, S the mean of their stretches."""
    anchors = bound.anchors
    assert anchors is not None
    moved = field(anchors.vertices)[0]
    gradients = vertex_gradients(anchors.vertices, moved, anchors.faces)
    rotations = polar_rotation(gradients)
    stretches = rotations.mT @ gradients
    corners, weights = anchors.faces.long()[anchors.face.long()], anchors.barycentric[..., None, None]
    linear = polar_rotation((rotations[corners] * weights).sum(1)) @ (stretches[corners] * weights).sum(1)
    foot, normal = foot_and_normal(anchors.face, anchors.barycentric, moved, anchors.faces)
    unit = edge_lengths(anchors.corners(moved)).mean(-1) / edge_lengths(anchors.corners(anchors.vertices)).mean(-1).clamp(min=1e-30)
    return moved_splats(bound.splats, foot + (anchors.offset * unit)[:, None] * normal, linear)


GAUSSIAN_MESH = SplatVariant(
    "gaussian_mesh",
    "GaussianMesh",
    bind_and_split,
    drive_by_corners,
    baked,
    relights=False,
    simplified="barycentrics, offsets and opacities are means of our surfels on the face (drgs2026, Alg. 1) and are not learned through pictures; faces are "
    "split once, by the photographs' squared error; corners' rotations come from the moved mesh alone, without ACAP's search for turns beyond half a one, "
    "and their blend is made a rotation",
)
