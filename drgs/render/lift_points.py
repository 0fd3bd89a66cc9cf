"""Where the rays of a splatted surface leave from: on the mesh, not on the splats.

Points that Gaussians cover lie near the mesh, in front of it or behind it. A ray from a point inside the mesh would meet the
mesh from within at once (shadow acne), one from far outside would miss contact shadows. So each point is carried to the
mesh: along its own viewing ray, else along its normal, each within NEAR of it and onto a triangle that faces as the
point does; else, where splats of two surfaces blend to a depth between them, along the viewing ray to the first surface within FAR.
A point whose viewing ray meets no mesh lies outside the mesh's outline, hence outside the mesh, and stays where it is. The start
then stands the tracer's lift outside the triangle, and shade lets no light in from below that triangle: no ray can
meet the surface it starts on.
"""

import torch
from torch import Tensor

from drgs.render.records import ShadingPoints
from drgs.render.shade import RayStarts
from drgs.render.trace_rays import over_slices, trace_rays
from drgs.render.tracer import AbstractTracer

NEAR = 0.01
"""How far splats may be from the mesh that they show [share of the mesh's diagonal]."""
FAR = 0.25
FACING = 0.2
"""Smallest cosine between a point's normal and that of the triangle it is carried to."""


SLICE = 8192
"""Points that a thread carries together."""


def lift_points(points: ShadingPoints, tracer: AbstractTracer) -> RayStarts:
    """Ray starts of shading points; carries no gradient."""
    places = [values.detach() for values in (points.position_world, points.normal_world, points.wo_world)]
    tracer.face_normals  # found once, before threads ask for them  # noqa: B018
    device = places[0].device
    parts = over_slices(
        len(places[0]), device, lambda a, b: _lift(*(values[a:b] for values in places), tracer), SLICE if device.type == "cpu" else None
    )
    if len(parts) < 2:
        return parts[0] if parts else _lift(*places, tracer)
    faces = torch.cat([part.face for part in parts])
    return RayStarts(*(torch.cat([getattr(part, name) for part in parts]) for name in ("origin_world", "surface_normal_world")), faces)


def _lift(position: Tensor, normal: Tensor, wo: Tensor, tracer: AbstractTracer) -> RayStarts:
    """lift_points for some of the points, on the calling thread."""
    face_normals = tracer.face_normals
    start, surface_normal = position + tracer.lift * normal, normal.clone()
    face = torch.full((len(position),), -1, dtype=torch.int32, device=position.device)
    left = torch.arange(len(position), device=position.device)
    for axis, share, facing in ((wo, NEAR, FACING), (normal, NEAR, FACING), (wo, FAR, -1.0)):
        reach, away = share * tracer.extent, axis[left]
        hits = trace_rays(position[left] + reach * away, -away, tracer)
        outward = face_normals[hits.face.clamp(min=0).long()]
        near = hits.hit & (hits.distance < 2 * reach) & ((outward * normal[left]).sum(-1) > facing)
        near &= (outward * away).sum(-1) > 0  # the outside of the surface
        chosen = left[near]
        met = position[chosen] + (reach - hits.distance[near])[:, None] * away[near]
        start[chosen] = met + tracer.lift * outward[near]
        surface_normal[chosen] = outward[near]
        face[chosen] = hits.face[near]
        left = left[~near]
    return RayStarts(start, surface_normal, face)
