"""What one photograph says of a mesh's vertices: which ones it shows, with what radiance, and the light that they mirror towards it.

In: the mesh through its tracer, a photograph. Out: numbers of vertices, and one entry for each.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from drgs.maths.color import linear_from_srgb
from drgs.reconstruct.fit.image_terms import SATURATED
from drgs.reconstruct.fit.light.mesh_light import MeshLight, radiance_along
from drgs.reconstruct.fit.view_targets import ViewTarget
from drgs.render.intersect.trace_rays import trace_rays
from drgs.render.intersect.tracer import AbstractTracer

FACING = 0.25
"""Least cosine between normal and view."""
SOLID = 0.995


@dataclass(frozen=True, eq=False)
class SeenVertices:
    """Those that a photograph shows facing it, unhidden and not overexposed."""

    index: Int[Tensor, "seen"]
    """int64, into the mesh's vertices."""
    photo: Float[Tensor, "seen 3"]
    """Linear radiance that the photograph has there."""
    wo: Float[Tensor, "seen 3"]
    """Unit direction to the camera, world."""


def seen_vertices(tracer: AbstractTracer, target: ViewTarget, among: Int[Tensor, "some"] | None = None) -> SeenVertices:
    """Of the tracer's mesh; there may be none.

    Args:
        among: vertices that are asked; None: all.
    """
    mesh, camera = tracer.mesh, target.camera
    vertices, normals = (values if among is None else values[among] for values in (mesh.vertices, mesh.normals))
    towards = camera.center_world - vertices
    wo = torch.nn.functional.normalize(towards, dim=-1)
    at = vertices @ camera.camera_from_world[:3, :3].T + camera.camera_from_world[:3, 3]
    homogeneous = at @ camera.intrinsics.T
    place = homogeneous[:, :2] / homogeneous[:, 2:]
    size = torch.tensor([camera.width, camera.height], device=place.device)
    seen = ((normals * wo).sum(-1) > FACING) & (at[:, 2] > 1e-6) & (place > 1).all(1) & (place < size - 1).all(1)
    index = seen.nonzero().squeeze(1)
    column, row = place[index].long().unbind(1)
    colour = target.saturation[row, column]
    index_ok = (target.mask[row, column] > SOLID) & (colour.amax(-1) < SATURATED * target.ceiling)
    index, place = index[index_ok], place[index][index_ok]
    origin = vertices[index] + 4 * tracer.lift * normals[index]
    open_ = ~trace_rays(origin, wo[index], tracer).hit
    index, place = index[open_], place[open_]
    grid = (2 * place / size - 1)[None, None]
    sampled = torch.nn.functional.grid_sample(target.saturation.permute(2, 0, 1)[None], grid, mode="bilinear", align_corners=False)
    return SeenVertices(index if among is None else among[index], linear_from_srgb(sampled[0, :, 0].T), wo[index])


def mirrored_radiance(tracer: AbstractTracer, seen: SeenVertices, light: MeshLight) -> tuple[Tensor, Tensor]:
    """(seen,) 1 where the mirrored view meets nothing, and (seen, 3) radiance of what it meets, 0 elsewhere; see radiance_along."""
    mesh = tracer.mesh
    normal = mesh.normals[seen.index]
    mirrored = 2 * (normal * seen.wo).sum(-1, keepdim=True) * normal - seen.wo
    return radiance_along(tracer, mesh.vertices[seen.index] + 4 * tracer.lift * normal, mirrored, light)
