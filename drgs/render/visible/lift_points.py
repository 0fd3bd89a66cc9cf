"""Where the rays of a splatted surface leave from: on the mesh, not on the splats.

Points that Gaussians cover lie near the mesh, in front of it or behind it. A ray from a point inside the mesh would meet the
mesh from within at once (shadow acne), one from far outside would miss contact shadows. So each point is carried to the
mesh: along its own viewing ray, else along its normal, each within NEAR of it and onto a triangle that faces as the
point does; else, where splats of two surfaces blend to a depth between them, along the viewing ray to the first surface within FAR.
A point whose viewing ray meets no mesh lies outside the mesh's outline, hence outside the mesh, and stays where it is. The start
then stands the tracer's lift outside the triangle, and shade lets no light in from below that triangle: no ray can
meet the surface it starts on.

Twin: drgs/reference/lift_points.py.
"""

from functools import cache
from typing import Any

import torch
import warp as wp

from drgs.render.intersect.tracer import AbstractTracer, KernelQuery
from drgs.render.records import RayStarts, ShadingPoints
from drgs.warp_torch import launch, warp_array, warp_device

wp.set_module_options({"enable_backward": False})

NEAR = wp.constant(0.01)
"""How far splats may be from the mesh that they show [share of the mesh's diagonal]."""
FAR = wp.constant(0.25)
FACING = wp.constant(0.2)
"""Smallest cosine between a point's normal and that of the triangle it is carried to."""


@cache
def carry_kernel(query: KernelQuery) -> Any:
    """The kernel that carries points to the mesh of a kind of tracer."""
    closest_fn, handle_type = query.closest_fn, query.handle_type

    @wp.kernel(enable_backward=False, module="unique")
    def carry_to_mesh(
        first: int,
        tracer: handle_type,  # type: ignore[valid-type]  # known when the kernel is made
        position: wp.array[wp.vec3],
        normal: wp.array[wp.vec3],
        wo: wp.array[wp.vec3],
        face_normals: wp.array[wp.vec3],
        extent: float,
        lift: float,
        # outputs
        start: wp.array[wp.vec3],
        surface_normal: wp.array[wp.vec3],
        face: wp.array[int],
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
            hit = closest_fn(tracer, here + reach * axis, -axis, 2.0 * reach)
            if hit.face >= 0:
                outward = face_normals[hit.face]
                if wp.dot(outward, n) > facing and wp.dot(outward, axis) > 0.0:  # the outside of the surface
                    start[i] = here + (reach - hit.distance) * axis + lift * outward
                    surface_normal[i] = outward
                    face[i] = hit.face
                    return

    return carry_to_mesh


def lift_points(points: ShadingPoints, tracer: AbstractTracer) -> RayStarts:
    """Ray starts of shading points; carries no gradient."""
    places = [values.detach().float() for values in (points.position_world, points.normal_world, points.wo_world)]
    start, surface_normal = torch.empty_like(places[0]), torch.empty_like(places[0])
    face = torch.empty(len(start), dtype=torch.int32, device=start.device)
    inputs = [tracer.handle, *(warp_array(values, wp.vec3) for values in (*places, tracer.face_normals)), tracer.extent, tracer.lift]
    outputs = [warp_array(start, wp.vec3), warp_array(surface_normal, wp.vec3), warp_array(face)]
    launch(carry_kernel(tracer.kernel_query), len(start), inputs, outputs, warp_device(start))
    return RayStarts(start, surface_normal, face)
