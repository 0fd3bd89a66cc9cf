"""The edges of a mesh drawn over a picture of it, those that are behind it hidden.

In: a picture on white, the mesh and the camera that took it. Out: the picture, darker where a pixel's middle is near an edge of the face that it sees.
"""

import torch

from benchmarks.paper.sheets import Array
from drgs.render.intersect.trace_rays import build_tracer, trace_rays
from drgs.scene.camera import Camera, pixel_rays_world
from drgs.scene.mesh import TriangleMesh

HALF_WIDTH = 0.6
"""Of a line [pixels]."""
STRENGTH = 0.75
"""How much darker a pixel on a line is."""


def with_wires(picture: Array, mesh: TriangleMesh, camera: Camera) -> Array:
    """
    Args:
        picture: (height, width, 3), 0..1.
    """
    origin, directions = pixel_rays_world(camera)
    rays = directions.reshape(-1, 3).contiguous()
    hits = trace_rays(origin.expand_as(rays).contiguous(), rays, build_tracer(mesh))
    seen = hits.hit.nonzero().squeeze(1)
    # Corners of the seen faces in the picture [pixels].
    places = mesh.vertices[mesh.faces.long()[hits.face[seen].long()]] @ camera.camera_from_world[:3, :3].T + camera.camera_from_world[:3, 3]
    corners = places @ camera.intrinsics.T
    corners = corners[..., :2] / corners[..., 2:].clamp(min=1e-9)
    pixel = torch.stack([seen % camera.width, seen // camera.width], -1) + 0.5
    start, along = corners, corners.roll(-1, 1) - corners
    across = torch.stack([along[..., 1], -along[..., 0]], -1)
    distance = ((pixel[:, None] - start) * across).sum(-1).abs() / across.norm(dim=-1).clamp(min=1e-9)
    ink = torch.zeros(camera.height * camera.width)
    ink[seen] = (HALF_WIDTH + 0.5 - distance.amin(1)).clamp(0, 1)
    return picture * (1 - STRENGTH * ink.reshape(camera.height, camera.width, 1).double().numpy())
