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
import warp as wp
from torch import Tensor

from drgs.render.records import ShadingPoints
from drgs.render.shade import RayStarts
from drgs.render.trace_rays import trace_rays
from drgs.render.tracer import AbstractTracer
from drgs.render.tracer_embree import EmbreeTracer, embree_closest
from drgs.warp_torch import launch, warp_array

wp.set_module_options({"enable_backward": False})

NEAR = wp.constant(0.01)
"""How far splats may be from the mesh that they show [share of the mesh's diagonal]."""
FAR = wp.constant(0.25)
FACING = wp.constant(0.2)
"""Smallest cosine between a point's normal and that of the triangle it is carried to."""


@wp.kernel
def carry_to_mesh(
    first: int,
    question: wp.uint64,
    tree: wp.uint64,
    position: wp.array[wp.vec3],
    normal: wp.array[wp.vec3],
    wo: wp.array[wp.vec3],
    face_normals: wp.array[wp.vec3],
    extent: float,
    lift: float,
    # outputs; the last two are what each ray met
    start: wp.array[wp.vec3],
    surface_normal: wp.array[wp.vec3],
    face: wp.array[int],
    met: wp.array[int],
    distance: wp.array[float],
    barycentric: wp.array[wp.vec2],
):
    i = first + wp.tid()
    here = position[i]
    n = normal[i]
    start[i] = here + lift * n
    surface_normal[i] = n
    face[i] = -1
    for attempt in range(3):
        axis = wo[i]
        reach = NEAR * extent
        facing = FACING
        if attempt == 1:
            axis = n
        if attempt == 2:
            reach = FAR * extent
            facing = -1.0
        embree_closest(question, tree, here + reach * axis, -axis, 2.0 * reach, i, distance, met, barycentric)
        if met[i] >= 0:
            outward = face_normals[met[i]]
            if wp.dot(outward, n) > facing and wp.dot(outward, axis) > 0.0:  # the outside of the surface
                start[i] = here + (reach - distance[i]) * axis + lift * outward
                surface_normal[i] = outward
                face[i] = met[i]
                return


def lift_points(points: ShadingPoints, tracer: AbstractTracer) -> RayStarts:
    """Ray starts of shading points; carries no gradient."""
    places = [values.detach().float() for values in (points.position_world, points.normal_world, points.wo_world)]
    if not isinstance(tracer, EmbreeTracer):
        return lift_points_by_batches(*places, tracer)
    count = len(places[0])
    start, surface_normal = torch.empty(count, 3), torch.empty(count, 3)
    face, met = torch.empty(count, dtype=torch.int32), torch.empty(count, dtype=torch.int32)
    inputs = [*tracer.first_hit, *(warp_array(values, wp.vec3) for values in (*places, tracer.face_normals)), tracer.extent, tracer.lift]
    outputs = [warp_array(start, wp.vec3), warp_array(surface_normal, wp.vec3), warp_array(face), warp_array(met)]
    scratch = [warp_array(torch.empty(count)), warp_array(torch.empty(count, 2), wp.vec2)]
    launch(carry_to_mesh, count, inputs, [*outputs, *scratch], "cpu")
    return RayStarts(start, surface_normal, face)


def lift_points_by_batches(position: Tensor, normal: Tensor, wo: Tensor, tracer: AbstractTracer) -> RayStarts:
    """carry_to_mesh for any tracer: all rays of one axis together."""
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
