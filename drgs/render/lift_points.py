"""Where the rays of a splatted surface leave from: on the mesh, not on the splats.

Points that Gaussians cover lie near the mesh, in front of it or behind it. A ray from a point inside the mesh would meet the
mesh from within at once (shadow acne), one from far outside would miss contact shadows. So each point is carried to the
mesh along its own viewing ray; where that ray meets none of it within TOLERANCE_OF_EXTENT, along its normal; where that
fails too there is no mesh near, and the point itself, lifted, will do. The start then stands the tracer's lift outside the triangle,
and shade lets no light in from below that triangle: no ray can meet the surface it starts on.
"""

import torch

from drgs.render.records import ShadingPoints
from drgs.render.shade import RayStarts
from drgs.render.trace_rays import trace_rays
from drgs.render.tracer import AbstractTracer

TOLERANCE_OF_EXTENT = 0.02
"""How far a splatted point may be from the mesh [share of the mesh's diagonal]."""


def lift_points(points: ShadingPoints, tracer: AbstractTracer) -> RayStarts:
    """Ray starts of shading points; carries no gradient."""
    mesh = tracer.mesh
    position, normal, wo = points.position_world.detach(), points.normal_world.detach(), points.wo_world.detach()
    reach = TOLERANCE_OF_EXTENT * tracer.extent
    corners = mesh.vertices.detach()[mesh.faces.long()]
    face_normals = torch.nn.functional.normalize(torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), dim=-1)

    start, surface_normal = position + tracer.lift * normal, normal.clone()
    left = torch.arange(len(position), device=position.device)
    for axis in (wo, normal):  # first along the viewing ray, then along the normal
        away = axis[left]
        hits = trace_rays(position[left] + reach * away, -away, tracer)
        near = hits.hit & (hits.distance < 2 * reach)
        outward = face_normals[hits.face.clamp(min=0).long()]
        near &= (outward * away).sum(-1) > 0  # the outside of the surface
        chosen = left[near]
        met = position[chosen] + (reach - hits.distance[near])[:, None] * away[near]
        start[chosen] = met + tracer.lift * outward[near]
        surface_normal[chosen] = outward[near]
        left = left[~near]
    return RayStarts(start, surface_normal)
