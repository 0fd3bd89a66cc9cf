"""Kernels that look how high a mesh rises above its faces (horizon.py), and the sector of azimuth that a direction lies in.

In: triangles in the order of a space-filling curve, and boxes of runs of them. Out: for each face and sector the tangent of an elevation
below which all of the mesh lies. On the CPU sixteen triangles at once (horizon.h); raise_horizons is the specification.
"""

from pathlib import Path
from typing import Any

import warp as wp

from drgs.render.native_source import native_source

wp.set_module_options({"enable_backward": False})

GROUP = wp.constant(16)
"""Triangles of a group."""
SUPER = wp.constant(16)
"""Groups of a group of groups."""
DIRECTIONS = wp.constant(11)
SECTORS = 8
"""Of azimuth, an eighth of a turn each."""
POLE = wp.constant(0.02)
"""Sine of a face's tilt off the z axis below which it has the same horizon all around, because rounding turns its frame there. Above it,
rounding turns the frame by less than 1e-5; that is why only what keeps the lift (1e-5 of the mesh's extent) away counts as behind."""
STEEPEST = wp.constant(1.75)
"""Tangent of the elevation above which a horizon is of no use."""

Planes = wp.types.matrix(shape=(11, 3), dtype=float)
Supports = wp.types.vector(length=11, dtype=float)
Tangents = wp.types.vector(length=8, dtype=float)
Passed = wp.types.vector(length=8, dtype=wp.int32)


@wp.func
def horizon_frame(normal: wp.vec3) -> wp.vec3:
    """First axis of the frame in which azimuths over a face are counted; the second is normal x first."""
    across = wp.sqrt(normal[0] * normal[0] + normal[1] * normal[1])
    if across > 0.0:
        return wp.vec3(-normal[1] / across, normal[0] / across, 0.0)
    return wp.vec3(1.0, 0.0, 0.0)


@wp.func
def horizon_sector(normal: wp.vec3, direction: wp.vec3) -> int:
    """The sector of azimuth over a face that a direction lies in."""
    u = horizon_frame(normal)
    x = wp.dot(u, direction)
    y = wp.dot(wp.cross(normal, u), direction)
    return wp.where(x < 0.0, 1, 0) + wp.where(y < 0.0, 2, 0) + wp.where(wp.abs(y) > wp.abs(x), 4, 0)


@wp.func
def ratio(above: float, beyond: float, tolerance: float) -> float:
    """Tangent at which a point `above` the face's plane and `beyond` its edge is just on the outer side of a plane."""
    if above <= 0.0:
        return wp.where(beyond >= -tolerance, 0.0, 1.0e30)
    return wp.where(beyond > 0.0, above / wp.max(beyond, 1.0e-30), 1.0e30)


@wp.func
def box_above(normal: wp.vec3, base: float, low: wp.vec3, high: wp.vec3, tangent: float, planes: Any, supports: Any) -> wp.bool:
    """Whether a box may hold something above elevation `tangent`."""
    middle = 0.5 * (low + high)
    half = 0.5 * (high - low)
    above = wp.dot(normal, middle) + wp.dot(wp.abs(normal), half) - base
    if above <= 0.0:
        return False
    for k in range(DIRECTIONS):
        h = wp.vec3(planes[k, 0], planes[k, 1], planes[k, 2])
        beyond = wp.dot(h, middle) - wp.dot(wp.abs(h), half) - supports[k]
        if beyond > 0.0 and above <= tangent * beyond:
            return False
    return True


@wp.func
def planes_around(a: wp.vec3, b: wp.vec3, c: wp.vec3, normal: wp.vec3, lift: float):
    """Directions in the plane of a face, eight of the frame and its edges' three; how far the face reaches along each; and of the eight
    where begins what lies wholly behind it."""
    u = horizon_frame(normal)
    v = wp.cross(normal, u)
    planes = Planes()
    supports = Supports()
    behind = Tangents()
    for k in range(DIRECTIONS):
        angle = 0.78539816339 * float(k)
        h = wp.cos(angle) * u + wp.sin(angle) * v
        if k == 8:
            h = wp.normalize(wp.cross(b - a, normal))
        if k == 9:
            h = wp.normalize(wp.cross(c - b, normal))
        if k == 10:
            h = wp.normalize(wp.cross(a - c, normal))
        planes[k, 0] = h[0]
        planes[k, 1] = h[1]
        planes[k, 2] = h[2]
        supports[k] = wp.max(wp.max(wp.dot(h, a), wp.dot(h, b)), wp.dot(h, c))
        if k < 8:
            behind[k] = wp.min(wp.min(wp.dot(h, a), wp.dot(h, b)), wp.dot(h, c)) - lift
    return planes, supports, behind


@wp.func
def triangle_tangents(
    p: wp.vec3, q: wp.vec3, r: wp.vec3, normal: wp.vec3, base: float, lift: float, planes: Any, supports: Any, behind: Any
):
    """Tangent of the elevation below which a triangle lies, in each sector that it reaches into; 0 in the others."""
    passed = Passed()
    tangents = Tangents()
    above_p = wp.dot(normal, p) - base
    above_q = wp.dot(normal, q) - base
    above_r = wp.dot(normal, r) - base
    for k in range(8):
        h = wp.vec3(planes[k, 0], planes[k, 1], planes[k, 2])
        farthest = wp.max(wp.max(wp.dot(h, p), wp.dot(h, q)), wp.dot(h, r))
        passed[k] = wp.where(farthest < behind[k], 1, 0)
    lowest = wp.float32(1.0e30)
    for k in range(DIRECTIONS):
        h = wp.vec3(planes[k, 0], planes[k, 1], planes[k, 2])
        needed = wp.max(
            wp.max(ratio(above_p, wp.dot(h, p) - supports[k], 0.1 * lift), ratio(above_q, wp.dot(h, q) - supports[k], 0.1 * lift)),
            ratio(above_r, wp.dot(h, r) - supports[k], 0.1 * lift),
        )
        lowest = wp.min(lowest, needed)
    for k in range(8):
        is_out = passed[(k + 7) % 8] + passed[k] + passed[(k + 1) % 8] + passed[(k + 2) % 8]
        tangents[k] = wp.where(is_out == 0, lowest, 0.0)
    return tangents


@wp.kernel
def raise_horizons(
    first: int,
    which: wp.array[int],
    corners: wp.array[wp.vec3],
    face_count: int,
    group_low: wp.array[wp.vec3],
    group_high: wp.array[wp.vec3],
    super_low: wp.array[wp.vec3],
    super_high: wp.array[wp.vec3],
    lift: float,
    # outputs
    tangent_out: wp.array[float],
):
    f = which[first + wp.tid()]
    a = corners[3 * f]
    b = corners[3 * f + 1]
    c = corners[3 * f + 2]
    cross = wp.cross(b - a, c - a)
    area = wp.length(cross)
    if area <= 0.0:
        for k in range(8):
            tangent_out[8 * f + k] = 1.0e30
        return
    normal = cross / area
    # Rays start at `lift` above the plane: what stays below half of it is out of their reach.
    base = wp.max(wp.max(wp.dot(normal, a), wp.dot(normal, b)), wp.dot(normal, c)) + 0.5 * lift
    planes, supports, behind = planes_around(a, b, c, normal, lift)
    tangents = Tangents()
    tangent = wp.float32(0.0)  # the least of them
    groups = (face_count + GROUP - 1) // GROUP
    supers = (groups + SUPER - 1) // SUPER
    own = f // (GROUP * SUPER)
    # The face's own neighbourhood first: it is what most often shows that there is nothing to gain.
    for turn in range(supers):
        s = own + turn
        if s >= supers:
            s -= supers
        if tangent < STEEPEST:  # noqa: SIM102 (Warp's `and` evaluates both)
            if box_above(normal, base, super_low[s], super_high[s], tangent, planes, supports):
                for g in range(s * SUPER, wp.min((s + 1) * SUPER, groups)):
                    if tangent < STEEPEST:  # noqa: SIM102
                        if box_above(normal, base, group_low[g], group_high[g], tangent, planes, supports):
                            for t in range(g * GROUP, wp.min((g + 1) * GROUP, face_count)):
                                p = corners[3 * t]
                                q = corners[3 * t + 1]
                                r = corners[3 * t + 2]
                                if wp.max(wp.max(wp.dot(normal, p), wp.dot(normal, q)), wp.dot(normal, r)) > base:
                                    raised = triangle_tangents(p, q, r, normal, base, lift, planes, supports, behind)
                                    tangents = wp.max(tangents, raised)
                                    tangent = wp.min(tangents)
    most = wp.max(tangents)
    u = horizon_frame(normal)
    v = wp.cross(normal, u)
    pole = wp.sqrt(normal[0] * normal[0] + normal[1] * normal[1]) < POLE
    for k in range(8):
        # Sector k begins at k eighths of a turn; the order is horizon_sector's.
        angle = 0.78539816339 * (float(k) + 0.5)
        at = horizon_sector(normal, wp.cos(angle) * u + wp.sin(angle) * v)
        tangent_out[8 * f + at] = wp.where(pole, most, tangents[k])


assert int(GROUP) == int(SUPER) == 16  # the lanes of a vector in horizon.h
FACE_HORIZON = native_source(
    Path(__file__).with_name("horizon.h"),
    constants={"DIRECTIONS": int(DIRECTIONS), "STEEPEST": float(STEEPEST), "POLE": float(POLE)},
)


@wp.func_native(FACE_HORIZON)
def face_horizon(
    f: int, corners: wp.array[wp.vec3], lanes: wp.array[float], group_boxes: wp.array[float],
    super_boxes: wp.array[float], lift: float, tangent_out: wp.array[float],
): ...  # fmt: skip


@wp.kernel(enable_backward=False, module="unique")
def raise_horizons_simd(
    first: int,
    which: wp.array[int],
    corners: wp.array[wp.vec3],
    lanes: wp.array[float],
    group_boxes: wp.array[float],
    super_boxes: wp.array[float],
    lift: float,
    # outputs
    tangent_out: wp.array[float],
):
    """raise_horizons on the CPU."""
    face_horizon(which[first + wp.tid()], corners, lanes, group_boxes, super_boxes, lift, tangent_out)
