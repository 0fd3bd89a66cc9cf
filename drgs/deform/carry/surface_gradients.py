"""Deformation gradients of a mesh that moves again and again: what belongs to the mesh at rest is computed once.

In: vertices at rest and faces; then moved vertices, as often as they move. Out: F at the vertices, the same numbers as
drive_mesh.vertex_gradients, which is the specification (Sumner & Popovic 2004: edges and scaled normal of a face; mean over the faces about
a vertex by area at rest). float64 throughout: edges are short.
"""

from dataclasses import dataclass

import torch
import warp as wp
from jaxtyping import Float, Int
from torch import Tensor

from drgs.deform.carry.drive_mesh import DEGENERATE
from drgs.warp_torch import launch, warp_array, warp_device

wp.set_module_options({"enable_backward": False})


@dataclass(frozen=True, eq=False)
class SurfaceAtRest:
    faces: Int[Tensor, "face 3"]
    """int32"""
    face_from_edges: Float[Tensor, "face 3 3"]
    """float64: inverse of [e1, e2, n sqrt(2A)] at rest; zero where a face has no area."""
    start: Int[Tensor, "vertex_plus_1"]
    """int32: where a vertex's entries of `around` begin."""
    around: Int[Tensor, "3*face"]
    """int32: the faces about each vertex."""
    share: Float[Tensor, "3*face"]
    """float64, of a face in its vertex's mean."""


@wp.kernel
def gather_gradients(
    first: int,
    moved: wp.array[wp.vec3d],
    faces: wp.array2d[wp.int32],
    face_from_edges: wp.array[wp.mat33d],
    start: wp.array[wp.int32],
    around: wp.array[wp.int32],
    share: wp.array[wp.float64],
    # outputs
    gradient: wp.array[wp.mat33d],
):
    i = first + wp.tid()
    total = wp.mat33d()
    weight = wp.float64(0.0)
    for k in range(start[i], start[i + 1]):
        face = around[k]
        corner = moved[faces[face, 0]]
        e1 = moved[faces[face, 1]] - corner
        e2 = moved[faces[face, 2]] - corner
        normal = wp.cross(e1, e2)
        size = wp.sqrt(wp.max(wp.length(normal), wp.float64(1.0e-300)))
        total += share[k] * (wp.matrix_from_cols(e1, e2, normal / size) * face_from_edges[face])
        weight += share[k]
    if weight > wp.float64(0.0):
        gradient[i] = total
    else:
        gradient[i] = wp.identity(n=3, dtype=wp.float64)


def prepare_surface(vertices: Float[Tensor, "vertex 3"], faces: Int[Tensor, "face 3"]) -> SurfaceAtRest:
    """What of vertices (vertex, 3) at rest and faces (face, 3) the gradients need."""
    index = faces.long()
    a, b, c = vertices.double()[index].unbind(1)
    normal = torch.linalg.cross(b - a, c - a)
    area = normal.norm(dim=-1)
    good = area > DEGENERATE * area.median().clamp(min=1e-300) if len(area) else area > 0
    frames = torch.stack([b - a, c - a, normal / torch.sqrt(area.clamp(min=1e-300))[:, None]], -1)
    inverse = torch.zeros_like(frames)
    inverse[good] = torch.linalg.inv(frames[good])
    corner = index.reshape(-1)
    order = torch.argsort(corner, stable=True)
    weight = (area * good).repeat_interleave(3)[order]
    total = area.new_zeros(len(vertices)).index_add_(0, corner[order], weight)
    start = torch.zeros(len(vertices) + 1, dtype=torch.int64, device=vertices.device)
    start[1:] = torch.cumsum(torch.bincount(corner, minlength=len(vertices)), 0)
    share = weight / total[corner[order]].clamp(min=1e-300)
    return SurfaceAtRest(faces.int().contiguous(), inverse.contiguous(), start.int(), (order // 3).int().contiguous(), share.contiguous())


def surface_gradients(rest: SurfaceAtRest, moved: Float[Tensor, "vertex 3"]) -> Float[Tensor, "vertex 3 3"]:
    """(vertex, 3, 3) float64 of vertices moved to (vertex, 3); identity where no face tells."""
    moved = moved.detach().double().contiguous()
    gradient = torch.empty(len(moved), 3, 3, dtype=torch.float64, device=moved.device)
    inputs = [
        warp_array(moved, wp.vec3d), warp_array(rest.faces), warp_array(rest.face_from_edges, wp.mat33d), warp_array(rest.start),
        warp_array(rest.around), warp_array(rest.share),
    ]  # fmt: skip
    launch(gather_gradients, len(moved), inputs, [warp_array(gradient, wp.mat33d)], warp_device(moved))
    return gradient
