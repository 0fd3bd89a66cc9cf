"""Slow torch twin of drgs/render/visible/lift_points.py; the specification of its kernel."""

import torch

from drgs.render.intersect.trace_rays import trace_rays
from drgs.render.intersect.tracer import AbstractTracer
from drgs.render.records import RayStarts, ShadingPoints
from drgs.render.visible.lift_points import FACING, FAR, NEAR


def lift_points(points: ShadingPoints, tracer: AbstractTracer) -> RayStarts:
    """As drgs.render.visible.lift_points.lift_points; all rays of one axis together."""
    position, normal, wo = points.position_world, points.normal_world, points.wo_world
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
