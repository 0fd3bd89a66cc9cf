"""Points that follow a simpler mesh near them: a scanned object moves with the low-polygon model that an animator has rigged.

In: the proxy's triangles at rest and points near them; each frame the proxy's moved vertices and their deformation gradients. Out: where
the points go. Two ways to bind, and a blend of them, all exact for rigid motions and similarities:

closest: a point keeps its place relative to its closest triangle, p' = sum w v' + F (p - sum w v), F from the corners; between nearby parts
(two legs) the one that faces as the point does is chosen. For proxies that hug the object: where they stand off, neighbours may follow
triangles far apart, and what lies between is torn. mls: moving least squares (gmls.py) over patches of the proxy as wide as the point is
away from it, so that a loose proxy moves the object smoothly; blind to gaps narrower than its patches. auto: closest up to a distance of
the finest patch's width, mls from twice that.
"""

from dataclasses import dataclass
from typing import Literal

import torch
import warp as wp
from jaxtyping import Float, Int
from torch import Tensor

from drgs.deform.carry.drive_mesh import DEGENERATE
from drgs.deform.carry.gmls import GmlsSettings, Weights, build_weights, interpolate
from drgs.maths.unique_rows import unique_rows
from drgs.scene.mesh import face_areas
from drgs.warp_torch import launch, warp_array, warp_device

wp.set_module_options({"enable_backward": False})

ProxyMethod = Literal["auto", "closest", "mls"]
FINEST_PATCH = 0.02
"""Width of the smallest patches of `mls`, as a share of the proxy's diagonal; the next are twice as wide, and so on."""
LEVELS = 5
"""Of patches: the widest have a third of the diagonal."""
STAND_OFF = 2.0
"""A point uses patches of this part of its distance to the proxy: some two dozen of them then span about that distance."""
MOST_SAMPLES = 60_000
"""Of the whole proxy, where it does not have more triangles than that."""
PATCHES = GmlsSettings(neighbours=24, reach=1.0)
"""reach 1: the farthest patch counts nothing, so that nothing jumps where another becomes the farthest."""
FACING_MARGIN = 0.05
"""How much farther than its closest triangle one that faces as the point does may be, as a share of the proxy's diagonal."""


@dataclass(frozen=True, eq=False)
class PatchLevel:
    """Samples of a proxy gathered in patches of one width, and the points that follow these."""

    patch: Int[Tensor, "sample"]
    """int64"""
    share: Float[Tensor, "sample"]
    """float64: how much of its patch; the shares of a patch sum to 1."""
    points: Int[Tensor, "n"]
    """int64: the points that this level takes part in."""
    part: Float[Tensor, "n 1"]
    """float64: how much; the parts of a point's levels sum to 1."""
    weights: Weights
    """From patches to points."""


@dataclass(frozen=True, eq=False)
class ProxyBinding:
    """What of a set of points does not change while their proxy moves."""

    faces: Int[Tensor, "point 3"]
    """int64 corners of the triangle closest to each point."""
    barycentric: Float[Tensor, "point 3"]
    """float64, of the closest point in it."""
    offset: Float[Tensor, "point 3"]
    """float64, from there to the point, at rest [world units]."""
    near: Float[Tensor, "point 1"]
    """float64: how much a point follows its closest triangle; its levels of patches have the rest."""
    samples: Int[Tensor, "sample 3"]
    """int64 corners of the triangles that hold the samples of the patches."""
    sample_barycentric: Float[Tensor, "sample 3"]
    """float64"""
    levels: tuple[PatchLevel, ...]


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


def bind_to_proxy(
    vertices: Float[Tensor, "vertex 3"],
    faces: Int[Tensor, "face 3"],
    points: Float[Tensor, "point 3"],
    normals: Float[Tensor, "point 3"],
    method: ProxyMethod = "auto",
) -> ProxyBinding:
    """Bind points (point, 3) to a proxy's vertices (vertex, 3) and faces (face, 3) at rest.

    Args:
        normals: (point, 3) of the surface at the points; zero where it has none. `mls` does not look at them.

    Raises:
        ValueError: the proxy has no faces with area.
    """
    vertices, faces = vertices.double().to(points.device), faces.long().to(points.device)
    area = face_areas(vertices, faces)
    faces = faces[area > DEGENERATE * area.median().clamp(min=1e-300)] if len(area) else faces
    if not len(faces):
        raise ValueError("the rig's mesh has no faces with area")
    chosen, barycentric = closest_faces(vertices, faces, points, normals)
    offset = points.detach().double() - (vertices[faces[chosen]] * barycentric[..., None]).sum(1)
    feet = (faces[chosen], barycentric, offset)
    finest = FINEST_PATCH * float((vertices.amax(0) - vertices.amin(0)).norm())
    # 0 at the distance that the finest patches are made for, rising by 1 with each doubling; -1 and below is next to the proxy.
    height = torch.log2((offset.norm(dim=-1) / (STAND_OFF * finest)).clamp(min=0.5)).clamp(max=LEVELS - 1)
    height = {"auto": height, "closest": torch.full_like(height, -1), "mls": height.clamp(min=0)}[method]
    near = _level_part(height, -1)[:, None]
    if bool((near == 1).all()):
        return ProxyBinding(*feet, near, faces[:0], barycentric[:0], ())
    chosen, barycentric, size = _samples(vertices, faces, finest / 2)
    sampled = (vertices[faces[chosen]] * barycentric[..., None]).sum(1)
    levels = []
    for k in range(LEVELS):
        part = _level_part(height, k)
        followers = torch.nonzero(part > 0).squeeze(-1)
        if len(followers):
            patch, share, middle = _patches(sampled, size, vertices.amin(0), finest * 2**k)
            weights = build_weights(middle, points[followers], PATCHES)
            levels.append(PatchLevel(patch, share, followers, part[followers, None], weights))
    return ProxyBinding(*feet, near, faces[chosen], barycentric, tuple(levels))


def carry_points(
    binding: ProxyBinding, moved: Float[Tensor, "vertex 3"], gradients: Float[Tensor, "vertex 3 3"]
) -> Float[Tensor, "point 3"]:
    """Positions (point, 3) float64 from the proxy's vertices, (vertex, 3) and (vertex, 3, 3)."""
    device = binding.faces.device
    moved, gradients = moved.double().to(device), gradients.double().to(device)

    def blend(corners: Tensor, barycentric: Tensor) -> tuple[Tensor, Tensor]:
        return (moved[corners] * barycentric[..., None]).sum(1), (gradients[corners] * barycentric[..., None, None]).sum(1)

    foot, gradient = blend(binding.faces, binding.barycentric)
    positions = foot + (gradient @ binding.offset[..., None]).squeeze(-1)
    if not binding.levels:
        return positions
    positions = positions * binding.near
    place, turn = blend(binding.samples, binding.sample_barycentric)
    for level in binding.levels:
        count = len(level.weights.particles)
        middle = place.new_zeros(count, 3).index_add_(0, level.patch, place * level.share[:, None])
        turned = turn.new_zeros(count, 3, 3).index_add_(0, level.patch, turn * level.share[:, None, None])
        positions.index_add_(0, level.points, level.part * interpolate(level.weights, middle.float(), turned.float())[0])
    return positions


def _level_part(height: Float[Tensor, "point"], level: int) -> Float[Tensor, "point"]:
    """(point,) how much points at a height belong to a level: 1 at its own, falling smoothly to 0 at the next ones; sums to 1."""
    nearness = (1 - (height - level).abs()).clamp(min=0)
    return nearness * nearness * (3 - 2 * nearness)


def _patches(
    sampled: Float[Tensor, "sample 3"], size: Float[Tensor, "sample"], low: Float[Tensor, "3"], width: float
) -> tuple[Int[Tensor, "sample"], Float[Tensor, "sample"], Float[Tensor, "patch 3"]]:
    """Patch (sample,), share in it (sample,) by size, and middles of the patches (patch, 3): the cells of a grid that hold samples."""
    # Half a cell lower: walls along the axes would lie on the cells' borders, where rounding decides.
    _, patch = unique_rows(torch.floor((sampled - low) / width + 0.5).long())
    total = size.new_zeros(int(patch.max()) + 1).index_add_(0, patch, size)
    share = size / total[patch]
    return patch, share, size.new_zeros(len(total), 3).index_add_(0, patch, sampled * share[:, None])


def closest_faces(
    vertices: Float[Tensor, "vertex 3"], faces: Int[Tensor, "face 3"], points: Float[Tensor, "point 3"], normals: Float[Tensor, "point 3"]
) -> tuple[Int[Tensor, "point"], Float[Tensor, "point 3"]]:
    """Face (point,) and barycentrics (point, 3) float64 of the closest points, on faces that look the way of the normals (point, 3), or zero."""
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


def _samples(
    vertices: Float[Tensor, "vertex 3"], faces: Int[Tensor, "face 3"], spacing: float
) -> tuple[Int[Tensor, "sample"], Float[Tensor, "sample 3"], Float[Tensor, "sample"]]:
    """Face (sample,), barycentrics (sample, 3) and area (sample,): middles of the n * n small triangles that each face is cut into."""
    corners = vertices[faces]
    longest = torch.stack([(corners[:, k] - corners[:, k - 1]).norm(dim=-1) for k in range(3)], -1).amax(-1)
    area = face_areas(vertices, faces)
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
    face = torch.cat(chosen)
    return face, torch.cat(barycentric), area[face] / cuts[face] ** 2
