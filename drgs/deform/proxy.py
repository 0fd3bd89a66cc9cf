"""Points that follow a simpler mesh near them: a scanned object moves with the low-polygon model that an animator has rigged.

In: the proxy's triangles at rest and points near them; each frame the proxy's moved vertices and their deformation gradients. Out: where
the points go, and F there. Two ways to bind, both exact for rigid motions and similarities:

closest: a point keeps its place relative to its closest triangle, p' = sum w v' + F (p - sum w v), F from the corners; between nearby parts
(two legs) the one that faces as the point does is chosen. mls: moving least squares over samples of the triangles (gmls.py), smoother
across the proxy's edges, but blind to gaps narrower than its neighbourhoods.
"""

from dataclasses import dataclass
from typing import Literal

import torch
import warp as wp
from torch import Tensor

from drgs.deform.drive_mesh import DEGENERATE
from drgs.deform.gmls import GmlsSettings, Weights, build_weights, interpolate
from drgs.warp_torch import launch, warp_array, warp_device

wp.set_module_options({"enable_backward": False})

ProxyMethod = Literal["closest", "mls"]
SAMPLE_SPACING = 0.02
"""Between the samples of `mls`, as a share of the proxy's diagonal."""
MOST_SAMPLES = 40_000
"""Of the whole proxy; it gets a few per triangle more than that where it has more triangles."""
FACING_MARGIN = 0.05
"""How much farther than its closest triangle one that faces as the point does may be, as a share of the proxy's diagonal."""


@dataclass(frozen=True, eq=False)
class ProxyBinding:
    """What of a set of points does not change while their proxy moves."""

    faces: Tensor
    """(k, 3) int64 corners of the triangles of `barycentric`."""
    barycentric: Tensor
    """(k, 3) float64: feet of the points (closest), or samples (mls)."""
    offset: Tensor | None
    """(point, 3) float64 from foot to point at rest [world units]; None for mls."""
    weights: Weights | None
    """From samples to points; None for closest."""


@wp.func
def closest_on_triangle(p: wp.vec3, a: wp.vec3, b: wp.vec3, c: wp.vec3) -> wp.vec3:
    """Barycentrics of the closest point, by the region of the triangle's plane that p projects to."""
    ab = b - a
    ac = c - a
    d1 = wp.dot(ab, p - a)
    d2 = wp.dot(ac, p - a)
    if d1 <= 0.0 and d2 <= 0.0:
        return wp.vec3(1.0, 0.0, 0.0)
    d3 = wp.dot(ab, p - b)
    d4 = wp.dot(ac, p - b)
    if d3 >= 0.0 and d4 <= d3:
        return wp.vec3(0.0, 1.0, 0.0)
    d5 = wp.dot(ab, p - c)
    d6 = wp.dot(ac, p - c)
    if d6 >= 0.0 and d5 <= d6:
        return wp.vec3(0.0, 0.0, 1.0)
    across_c = d1 * d4 - d3 * d2
    if across_c <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        t = d1 / (d1 - d3)
        return wp.vec3(1.0 - t, t, 0.0)
    across_b = d5 * d2 - d1 * d6
    if across_b <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        t = d2 / (d2 - d6)
        return wp.vec3(1.0 - t, 0.0, t)
    across_a = d3 * d6 - d5 * d4
    if across_a <= 0.0 and d4 >= d3 and d5 >= d6:
        t = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        return wp.vec3(0.0, 1.0 - t, t)
    total = across_a + across_b + across_c
    return wp.vec3(across_a / total, across_b / total, across_c / total)


@wp.kernel
def find_closest_faces(
    first: int,
    mesh: wp.uint64,
    points: wp.array[wp.vec3],
    normals: wp.array[wp.vec3],
    side: float,
    reach: float,
    margin: float,
    # outputs
    face: wp.array[wp.int32],
    barycentric: wp.array[wp.vec3],
    facing: wp.array[float],
):
    """The closest face; with a side (1 or -1), rather one with n . side * n_face > 0 if there is one hardly farther away."""
    i = first + wp.tid()
    p = points[i]
    query = wp.mesh_query_point_no_sign(mesh, p, reach)
    best = query.face
    where = wp.vec3(query.u, query.v, 1.0 - query.u - query.v)
    distance = wp.length(wp.mesh_eval_position(mesh, query.face, query.u, query.v) - p)
    if side * wp.dot(normals[i], wp.mesh_eval_face_normal(mesh, best)) < 0.0:
        widest = distance + margin
        corner = wp.vec3(widest, widest, widest)
        candidates = wp.mesh_query_aabb(mesh, p - corner, p + corner)
        for f in candidates:
            if side * wp.dot(normals[i], wp.mesh_eval_face_normal(mesh, f)) > 0.0:
                a = wp.mesh_eval_position(mesh, f, 1.0, 0.0)
                b = wp.mesh_eval_position(mesh, f, 0.0, 1.0)
                c = wp.mesh_eval_position(mesh, f, 0.0, 0.0)
                inside = closest_on_triangle(p, a, b, c)
                away = wp.length(inside[0] * a + inside[1] * b + inside[2] * c - p)
                if away < widest:
                    widest = away
                    best = f
                    where = inside
    face[i] = best
    barycentric[i] = where
    facing[i] = wp.dot(normals[i], wp.mesh_eval_face_normal(mesh, best))


def bind_to_proxy(vertices: Tensor, faces: Tensor, points: Tensor, normals: Tensor, method: ProxyMethod = "closest") -> ProxyBinding:
    """Bind points (point, 3) to a proxy's vertices (vertex, 3) and faces (face, 3) at rest.

    Args:
        normals: (point, 3) of the surface at the points; zero where it has none. Only `closest` looks at them.

    Raises:
        ValueError: the proxy has no faces with area.
    """
    vertices, device = vertices.double().to(points.device), points.device
    corners = vertices[faces.long().to(device)]
    area = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]).norm(dim=-1)
    faces = faces.long().to(device)[area > DEGENERATE * area.median().clamp(min=1e-300)] if len(area) else faces.long()
    if not len(faces):
        raise ValueError("the rig's mesh has no faces with area")
    if method == "mls":
        chosen, barycentric = _samples(vertices, faces)
        sampled = (vertices[faces[chosen]] * barycentric[..., None]).sum(1)
        return ProxyBinding(faces[chosen], barycentric, None, build_weights(sampled, points, GmlsSettings()))
    chosen, barycentric = _closest(vertices, faces, points, normals)
    foot = (vertices[faces[chosen]] * barycentric[..., None]).sum(1)
    return ProxyBinding(faces[chosen], barycentric, points.detach().double() - foot, None)


def carry_points(binding: ProxyBinding, moved: Tensor, gradients: Tensor) -> tuple[Tensor, Tensor]:
    """Positions (point, 3) and deformation gradients (point, 3, 3), float32, from the proxy's vertices, (vertex, 3) and (vertex, 3, 3)."""
    device = binding.faces.device
    weights = binding.barycentric[..., None]
    foot = (moved.double().to(device)[binding.faces] * weights).sum(1)
    gradient = (gradients.double().to(device)[binding.faces] * weights[..., None]).sum(1)
    if binding.weights is not None:
        return interpolate(binding.weights, foot.float(), gradient.float())
    assert binding.offset is not None
    return (foot + (gradient @ binding.offset[..., None]).squeeze(-1)).float(), gradient.float()


def distances_to_proxy(binding: ProxyBinding) -> Tensor:
    """(point,) world units from each point to what it is bound to: its foot, or its nearest sample."""
    if binding.offset is not None:
        return binding.offset.norm(dim=-1)
    assert binding.weights is not None
    nearest = binding.weights.particles[binding.weights.neighbours[:, 0].long()]
    return (binding.weights.points - nearest).norm(dim=-1)


def _closest(vertices: Tensor, faces: Tensor, points: Tensor, normals: Tensor) -> tuple[Tensor, Tensor]:
    """Face (point,) and barycentrics (point, 3) of the closest points that face alike."""
    # About the proxy's middle: Warp's tree is in float32.
    middle = vertices.mean(0)
    local, targets = (vertices - middle).float().contiguous(), (points.detach().double() - middle).float().contiguous()
    indices, towards = faces.int().reshape(-1).contiguous(), normals.detach().float().contiguous()
    tree = wp.Mesh(points=warp_array(local, wp.vec3), indices=warp_array(indices))
    diagonal = float((local.amax(0) - local.amin(0)).norm())
    reach = 2 * float(torch.cat([targets, local]).norm(dim=-1).max()) + 1e-6
    face = torch.zeros(len(points), dtype=torch.int32, device=points.device)
    barycentric = torch.zeros(len(points), 3, device=points.device)
    facing = torch.zeros(len(points), device=points.device)

    def search(side: float) -> None:
        inputs = [tree.id, warp_array(targets, wp.vec3), warp_array(towards, wp.vec3), side, reach, FACING_MARGIN * diagonal]
        launch(
            find_closest_faces,
            len(points),
            inputs,
            [warp_array(face), warp_array(barycentric, wp.vec3), warp_array(facing)],
            warp_device(points),
        )

    search(0.0)
    # A proxy may be wound inside out; what most points say is its outside.
    search(1.0 if float(facing.sum()) >= 0 else -1.0)
    inside = barycentric.double().clamp(min=0)
    return face.long(), inside / inside.sum(-1, keepdim=True)


def _samples(vertices: Tensor, faces: Tensor) -> tuple[Tensor, Tensor]:
    """Face (sample,) and barycentrics (sample, 3): middles of the n * n small triangles that each face is cut into."""
    corners = vertices[faces]
    longest = torch.stack([(corners[:, k] - corners[:, k - 1]).norm(dim=-1) for k in range(3)], -1).amax(-1)
    spacing = SAMPLE_SPACING * float((vertices.amax(0) - vertices.amin(0)).norm())
    cuts = torch.ceil(longest / spacing).clamp(min=1).long()
    while int((cuts**2).sum()) > MOST_SAMPLES and int(cuts.max()) > 1:
        cuts = torch.ceil(cuts / 2).long()
    chosen, barycentric = [], []
    for n in torch.unique(cuts).tolist():
        upright = [(3 * i + 1, 3 * j + 1) for i in range(n) for j in range(n - i)]
        inverted = [(3 * i + 2, 3 * j + 2) for i in range(n - 1) for j in range(n - 1 - i)]
        pattern = torch.tensor(upright + inverted, dtype=torch.float64, device=faces.device) / (3 * n)
        of_size = torch.nonzero(cuts == n).squeeze(-1)
        chosen.append(of_size.repeat_interleave(len(pattern)))
        barycentric.append(torch.cat([pattern, 1 - pattern.sum(-1, keepdim=True)], -1).repeat(len(of_size), 1))
    return torch.cat(chosen), torch.cat(barycentric)
