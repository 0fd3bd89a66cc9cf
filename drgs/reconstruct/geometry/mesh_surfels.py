"""Surfels rebuilt on the faces of the mesh: one a face, where the fitted ones say, so that a moved mesh carries them by construction.

Source: drgs2026, Alg. 1 (docs/sources.md), steps 1 to 3. A surfel belongs to a face for good: centre = barycentric point + offset along
the face's normal. Where Alg. 1 is silent or wrong we do otherwise, and `variant="paper"` keeps what it says:

    what                     here                                                          paper
    shape and in-plane axes  second moment of the triangle, slivers widened                isotropic, spacing of face centres, any angle
    normal                   of the surfels nearby, where they agree with the face         the face's
    offset                   mean offset of the face's candidates                          0
    offset's unit            mean edge of the face (finite for slivers)                    circumradius
    opacity without          what the fitted surfels amount to there, at least 0.1         0.1 (the smallest repair: it says nothing)
    candidates
    materials, colour        candidates' mean by opacity, else of the surfels nearby       the same (it says nothing)

Step 4, which overwrites the fitted surfels, is left out in both. In: Gaussians and a mesh. Out: Gaussians and their Binding. It does not
know photographs; fit_mesh_surfels goes on from here.
"""

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from drgs.maths.constants import MAX_ALPHA
from drgs.maths.frames import quat_wxyz_from_rotation, rotation_from_quat_wxyz
from drgs.reconstruct.geometry.bake_materials import average_surfels, vertex_weights
from drgs.reconstruct.geometry.bind_gaussians import bind_gaussians, nearest_surfels, points_from_binding
from drgs.scene.binding import Binding
from drgs.scene.gaussians import Gaussians
from drgs.scene.mesh import TriangleMesh

INSIDE = 1e-3
"""Least barycentric of a candidate: its closest point lies within the face, not on its rim (Alg. 1, step 2)."""
EMPTY_OPACITY = 0.1
"""Of faces where the fitted surfels show nothing: enough to be seen, and so to learn."""
FARTHEST = 3.0
"""Units of offset beyond which a surfel is no candidate, and which no offset may pass."""
MOMENT_SCALE = 2 * 2**0.5
"""Standard deviation over root of the triangle's second moment: on equilateral faces the spacing of their centres."""
SLIVER = 0.15
"""Least ratio of the two scales: narrower faces get wider surfels, which would be spikes else."""
NO_AREA = 1e-9
"""Faces below this share of the median area get no surfel."""
PAPER_LEAST_SPACING = 1e-7
"""Of variant="paper": added to the squared spacing of face centres. In world units, as drgs2026 has it, so it blurs objects below 1e-3."""
NEIGHBOURS = 8
"""Surfels whose opacity a face without candidates gathers."""


@dataclass(frozen=True, eq=False)
class FaceFrames:
    """Geometry of each face."""

    center: Float[Tensor, "face 3"]
    rotation: Float[Tensor, "face 3 3"]
    """Columns first and second principal axis, unit normal."""
    scales: Float[Tensor, "face 2"]
    """Standard deviations along the axes [world units]."""
    unit: Float[Tensor, "face"]
    """Length that an offset of 1 stands for [world units]."""
    longest_edge: Float[Tensor, "face"]
    area: Float[Tensor, "face"]


def face_frames(mesh: TriangleMesh, variant: Literal["corrected", "paper"] = "corrected") -> FaceFrames:
    """Centres, axes and lengths; faces without area get finite numbers that mean nothing."""
    corners = mesh.vertices[mesh.faces.long()].double()
    center = corners.mean(1)
    edges = torch.stack([corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 1], corners[:, 0] - corners[:, 2]], 1)
    lengths = edges.norm(dim=-1)
    doubled = torch.linalg.cross(edges[:, 0], -edges[:, 2])
    area = 0.5 * doubled.norm(dim=-1)
    normal = torch.nn.functional.normalize(doubled, dim=-1, eps=1e-300)
    longest = lengths.amax(1)
    along = edges.gather(1, lengths.argmax(1)[:, None, None].expand(-1, 1, 3)).squeeze(1)
    t_u = torch.nn.functional.normalize(edges[:, 0] if variant == "paper" else along, dim=-1, eps=1e-300)
    t_v = torch.linalg.cross(normal, t_u)
    if variant == "paper":
        tree = cKDTree(center.cpu().numpy())
        nearest = torch.from_numpy(tree.query(center.cpu().numpy(), k=[2])[0][:, 0]).to(center)
        scales = torch.sqrt(nearest**2 + PAPER_LEAST_SPACING)[:, None].repeat(1, 2)
        unit = lengths.prod(1) / (4 * torch.maximum(area, 1e-9 * longest**2)).clamp(min=1e-300)
    else:
        # The second moment in the plane, by its two coordinates; its eigenvectors turn t_u and t_v.
        plane = torch.stack([((corners - center[:, None]) * axis[:, None]).sum(-1) for axis in (t_u, t_v)], -1)
        values, first = larger_first(plane.mT @ plane / 12)
        t_u = t_u * first[:, :1] + t_v * first[:, 1:]
        t_v = torch.linalg.cross(normal, t_u)
        scales = MOMENT_SCALE * values.sqrt()
        scales = torch.minimum(torch.maximum(scales, SLIVER * scales[:, :1]), longest[:, None])
        unit = lengths.mean(1)
    frame = torch.stack([t_u, t_v, normal], -1)
    return FaceFrames(*(value.to(mesh.vertices.dtype) for value in (center, frame, scales, unit, longest, area)))


def larger_first(moment: Float[Tensor, "face 2 2"]) -> tuple[Float[Tensor, "face 2"], Float[Tensor, "face 2"]]:
    """Eigenvalues of symmetric matrices that are not negative, the larger one first, and its unit eigenvector.

    In closed form: cuSOLVER (of torch 2.11 with CUDA 13) refuses a batch of two hundred thousand.
    """
    a, b, c = moment[:, 0, 0], moment[:, 0, 1], moment[:, 1, 1]
    larger = 0.5 * (a + c) + torch.hypot(0.5 * (a - c), b)
    smaller = ((a * c - b * b).clamp(min=0) / larger.clamp(min=1e-300)).minimum(larger)
    angle = 0.5 * torch.atan2(2 * b, a - c)
    return torch.stack([larger, smaller], -1), torch.stack([angle.cos(), angle.sin()], -1)


def mesh_surfels(
    gaussians: Gaussians, mesh: TriangleMesh, variant: Literal["corrected", "paper"] = "corrected"
) -> tuple[Gaussians, Binding]:
    """One surfel on each face that has area, and where it sits; `gaussians` are the fitted ones that it takes everything else from.

    Raises:
        ValueError: the mesh has no face with area, or there are fewer fitted surfels than a face asks about.
    """
    if len(gaussians.centers) < NEIGHBOURS:
        raise ValueError(f"cannot rebuild {len(gaussians.centers)} surfels on a mesh; expected {NEIGHBOURS} or more")
    frames = face_frames(mesh, variant)
    found = bind_gaussians(gaussians.centers, mesh)  # refuses a mesh without area
    opacities = torch.sigmoid(gaussians.opacity_logits)
    inside = found.barycentric.amin(-1) > INSIDE
    if variant == "corrected":  # what floats far from the face says nothing about it
        inside &= found.normal_offset.abs() <= FARTHEST * frames.unit[found.face.long()]
    face = found.face[inside].long()
    count = _sums(torch.ones_like(opacities[inside]), face, len(mesh.faces))
    has = count > 0
    some = count.clamp(min=1)

    barycentric = _sums(found.barycentric[inside], face, len(count)) / some[:, None]
    barycentric = torch.where(has[:, None], barycentric, torch.full_like(barycentric, 1 / 3))
    opacity = _sums(opacities[inside], face, len(count)) / some
    if variant == "paper":
        offset = torch.zeros_like(count)
        elsewhere = torch.full_like(count, EMPTY_OPACITY)
    else:
        offset = _sums(found.normal_offset[inside], face, len(count)) / some
        elsewhere = gathered_opacity(frames.center, gaussians).clamp(min=EMPTY_OPACITY)
    opacity = torch.where(has, opacity, elsewhere).clamp(max=MAX_ALPHA)

    around = vertex_weights(frames.center, frames.rotation[:, :, 2], gaussians)
    # Materials and colour: one table of everything, averaged over candidates, or over what lies nearby.
    parts = [gaussians.sh.flatten(1), gaussians.albedo, gaussians.roughness[:, None], gaussians.metallic[:, None]]
    table = torch.cat(parts, 1)
    weight = opacities[inside]
    own = _sums(table[inside] * weight[:, None], face, len(count)) / _sums(weight, face, len(count)).clamp(min=1e-12)[:, None]
    nearby = average_surfels(table, *around)
    sh, albedo, roughness, metallic = torch.where(has[:, None], own, nearby).split([part.shape[1] for part in parts], 1)

    rotation = frames.rotation if variant == "paper" else turned_frames(frames.rotation, gaussians, *around)

    kept = (frames.area > NO_AREA * frames.area.median()).nonzero().squeeze(1)
    binding = Binding(kept.int(), barycentric[kept], offset[kept])
    return (
        Gaussians(
            centers=points_from_binding(binding, mesh.vertices, mesh.faces),
            log_scales=frames.scales[kept].log(),
            quats_wxyz=quat_wxyz_from_rotation(rotation[kept]),
            opacity_logits=torch.logit(opacity[kept]),
            sh=sh[kept].reshape(-1, *gaussians.sh.shape[1:]),
            albedo=albedo[kept],
            roughness=roughness[kept, 0],
            metallic=metallic[kept, 0],
        ),
        binding,
    )


def gathered_opacity(points: Float[Tensor, "point 3"], gaussians: Gaussians) -> Float[Tensor, "point"]:
    """(point,) opacity that the nearest surfels amount to at each point (point, 3): 1 - prod(1 - alpha G), G by distance within the disc and
    across it."""
    indices, _ = nearest_surfels(points, gaussians.centers, NEIGHBOURS)
    rotation, scales = rotation_from_quat_wxyz(gaussians.quats_wxyz)[indices], gaussians.log_scales.exp()[indices]
    local = ((points[:, None] - gaussians.centers[indices])[..., None, :] @ rotation).squeeze(-2)
    within = (local[..., :2] / scales).square().sum(-1) + (local[..., 2] / scales.amax(-1)).square()
    return 1 - (1 - torch.sigmoid(gaussians.opacity_logits)[indices] * torch.exp(-0.5 * within)).prod(-1)


def turned_frames(
    rotation: Float[Tensor, "face 3 3"], gaussians: Gaussians, indices: Int[Tensor, "face k"], weights: Float[Tensor, "face k"]
) -> Float[Tensor, "face 3 3"]:
    """Frames (face, 3, 3) whose normal is the mean of the surfels' (face, k) around, t_u turned with it; as they were where that mean
    leans more than 60 degrees from the face: at edges, and where nothing is near."""
    own = rotation[:, :, 2]
    normals = rotation_from_quat_wxyz(gaussians.quats_wxyz)[:, :, 2][indices]
    normals = normals * torch.where((normals * own[:, None]).sum(-1, keepdim=True) < 0, -1.0, 1.0)  # a surfel has two sides
    mean = torch.nn.functional.normalize((normals * weights[..., None]).sum(1), dim=-1)
    normal = torch.where((mean * own).sum(-1, keepdim=True) > 0.5, mean, own)
    t_u = rotation[:, :, 0] - (rotation[:, :, 0] * normal).sum(-1, keepdim=True) * normal
    t_u = torch.nn.functional.normalize(t_u, dim=-1)
    return torch.stack([t_u, torch.linalg.cross(normal, t_u), normal], -1)


def _sums(values: Float[Tensor, "n *value"], index: Int[Tensor, "n"], count: int) -> Float[Tensor, "{count} *value"]:
    """(count, ...) sums of values (n, ...) that share an index."""
    return values.new_zeros(count, *values.shape[1:]).index_add(0, index, values)
