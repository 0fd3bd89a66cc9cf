"""Kernels of the surfel tracer: a ray's walk from hit to hit in order of distance, and the sum of gradients by surfel.

One kernel, `walk_rays`, serves forward and backward, so both visit the same hits in the same order: by t, ties by index.
It fills a buffer with the nearest HITS_PER_PASS hits behind the last one visited, visits them, and starts again behind
them until the ray is opaque or nothing is left: no hit is lost or met twice, however many overlap.
"""

from typing import Any

import warp as wp

from drgs.maths.constants import MAX_ALPHA, MIN_TRANSMITTANCE
from drgs.maths.spherical_harmonics import K00, K1, K20, K21, K22, K30, K31, K32, K33, SH_OFFSET

wp.set_module_options({"enable_backward": False})

HITS_PER_PASS = 16
GRAZING_COSINE = 1e-4
"""Rays closer to a surfel's plane than this sine miss it: t and the plane coordinates lose their digits there."""
FURTHER = 1.00001
"""Slack on the tree's distance limit, so that boxes of hits at the very limit are still opened."""


vec16 = wp.types.vector(length=16, dtype=wp.float32)


@wp.struct
class SurfelTable:
    """SurfelScene as kernels see it; indices count kept surfels."""

    tree: wp.uint64
    frames: wp.array[wp.vec4]
    """Three a surfel, see SurfelScene.frames."""
    radiance: wp.array2d[wp.vec3]
    degree: int
    """Of the spherical harmonics; -1: `radiance` is a colour."""


@wp.struct
class SurfelHit:
    """Where a ray meets a surfel."""

    t: float
    u: float
    v: float
    alpha: float
    """0 where it does not."""
    clamped: int
    """1 where alpha stands at MAX_ALPHA and has no gradient."""


@wp.func
def xyz(row: wp.vec4) -> wp.vec3:
    return wp.vec3(row[0], row[1], row[2])


@wp.func
def meet_surfel(table: SurfelTable, surfel: int, origin: wp.vec3, direction: wp.vec3) -> SurfelHit:
    """Solve origin + t direction = centre + u b1 + v b2 by Cramer's rule."""
    hit = SurfelHit()
    row0 = table.frames[3 * surfel]
    row1 = table.frames[3 * surfel + 1]
    row2 = table.frames[3 * surfel + 2]
    b1 = xyz(row1)
    b2 = xyz(row2)
    normal = wp.cross(b1, b2)
    slope = wp.dot(normal, direction)
    if wp.abs(slope) > GRAZING_COSINE * row1[3]:
        offset = origin - xyz(row0)
        hit.u = wp.dot(wp.cross(b2, direction), offset) / slope
        hit.v = wp.dot(wp.cross(direction, b1), offset) / slope
        rho = hit.u * hit.u + hit.v * hit.v
        if rho <= row2[3]:
            hit.t = -wp.dot(normal, offset) / slope
            hit.alpha = row0[3] * wp.exp(-0.5 * rho)
            if hit.alpha > MAX_ALPHA:
                hit.alpha = MAX_ALPHA
                hit.clamped = 1
    return hit


@wp.func
def is_before(t_a: float, surfel_a: int, t_b: float, surfel_b: int) -> bool:
    """The order of hits along a ray."""
    return t_a < t_b or (t_a == t_b and surfel_a < surfel_b)


@wp.func
def sh_basis_at(d: wp.vec3):
    """drgs.maths.spherical_harmonics.sh_basis to degree 3, a vec16."""
    x = d[0]
    y = d[1]
    z = d[2]
    xx = x * x
    yy = y * y
    zz = z * z
    # All at once: assigning entry by entry copies the vector every time.
    return vec16(
        K00,
        -K1 * y,
        K1 * z,
        -K1 * x,
        K21 * x * y,
        -K21 * y * z,
        K20 * (2.0 * zz - xx - yy),
        -K21 * x * z,
        K22 * (xx - yy),
        -K33 * y * (3.0 * xx - yy),
        2.0 * K32 * x * y * z,
        -K31 * y * (4.0 * zz - xx - yy),
        K30 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy),
        -K31 * x * (4.0 * zz - xx - yy),
        K32 * z * (xx - yy),
        -K33 * x * (xx - 3.0 * yy),
    )


@wp.func
def radiance_before_clamp(table: SurfelTable, surfel: int, basis: Any) -> wp.vec3:
    """Colour of a surfel seen along a direction, not yet clamped at 0."""
    if table.degree < 0:
        return table.radiance[surfel, 0]
    total = wp.vec3(SH_OFFSET, SH_OFFSET, SH_OFFSET)
    for k in range((table.degree + 1) * (table.degree + 1)):
        total += basis[k] * table.radiance[surfel, k]
    return total


@wp.func
def clamp_radiance(radiance: wp.vec3) -> wp.vec3:
    return wp.vec3(wp.max(radiance[0], 0.0), wp.max(radiance[1], 0.0), wp.max(radiance[2], 0.0))


@wp.func
def where_positive(value: float, gradient: float) -> float:
    if value > 0.0:
        return gradient
    return 0.0


@wp.struct
class GradientHits:
    """What the backward pass notes of every hit, to be summed by surfel afterwards."""

    surfel: wp.array[int]
    ray: wp.array[int]
    plane: wp.array[wp.vec3]
    """u, v and the gradient of the opacity."""
    center: wp.array[wp.vec3]
    """Gradient of the centre; times u or v that of a tangent."""
    radiance: wp.array[wp.vec3]
    """Gradient of the colour before it was clamped at 0."""


@wp.struct
class BlendedRays:
    """What rays bring."""

    radiance: wp.array[wp.vec3]
    opacity: wp.array[float]
    depth: wp.array[float]
    """Sum of weight times t."""
    hit_count: wp.array[int]


@wp.struct
class RayGradients:
    """Of the loss by what rays bring; empty in the forward pass."""

    radiance: wp.array[wp.vec3]
    opacity: wp.array[float]
    depth: wp.array[float]
    first_hit: wp.array[wp.int64]
    """Where a ray's hits begin in GradientHits."""


@wp.func
def note_gradients_of_hit(
    note: int,
    ray: int,
    surfel: int,
    table: SurfelTable,
    hit: SurfelHit,
    direction: wp.vec3,
    g_alpha: float,
    g_t: float,
    # outputs
    noted: GradientHits,
):
    """All but that of the colour, from the gradients of the loss by the hit's alpha and t."""
    b1 = xyz(table.frames[3 * surfel + 1])
    b2 = xyz(table.frames[3 * surfel + 2])
    normal = wp.cross(b1, b2)
    # The inverse transpose of [b1 b2 -direction] takes gradients of (u, v, t) to that of the origin.
    g_u = -hit.alpha * hit.u * g_alpha
    g_v = -hit.alpha * hit.v * g_alpha
    g_origin = g_u * wp.cross(b2, direction) + g_v * wp.cross(direction, b1) - g_t * normal
    noted.surfel[note] = surfel
    noted.ray[note] = ray
    noted.plane[note] = wp.vec3(hit.u, hit.v, g_alpha * wp.exp(-0.5 * (hit.u * hit.u + hit.v * hit.v)))
    noted.center[note] = -g_origin / wp.dot(normal, direction)


@wp.kernel
def walk_rays(
    first: int,
    table: SurfelTable,
    origins: wp.array[wp.vec3],
    directions: wp.array[wp.vec3],
    t_min: float,
    gradients: RayGradients,
    # outputs
    blended: BlendedRays,
    noted: GradientHits,
):
    """Blend front to back. Given gradients, `blended` is read instead, and the gradients of each hit are noted.

    Long because gathering and visiting share the buffer of near hits, local memory that a Warp function cannot be given.
    """
    ray = first + wp.tid()
    origin = origins[ray]
    direction = directions[ray]
    basis = vec16()  # filled at the first hit: most rays have none

    # With L the loss: dL/dalpha_i = T_i s_i - (sum of w_j s_j behind i) / (1 - alpha_i), where s_i = dL/dw_i.
    total_score = float(0.0)
    prefix_score = float(0.0)
    g_radiance = wp.vec3()
    g_opacity = float(0.0)
    g_depth = float(0.0)
    notes = gradients.first_hit.shape[0] > 0
    if notes:
        g_radiance = gradients.radiance[ray]
        g_opacity = gradients.opacity[ray]
        g_depth = gradients.depth[ray]
        total_score = wp.dot(g_radiance, blended.radiance[ray]) + g_opacity * blended.opacity[ray] + g_depth * blended.depth[ray]

    left = float(1.0)
    color = wp.vec3()
    weighted_t = float(0.0)
    visited = int(0)
    last_t = t_min
    last_surfel = int(2147483647)  # after every surfel at t_min itself: only t > t_min counts
    near_t = wp.zeros(shape=(HITS_PER_PASS,), dtype=float)
    near_surfel = wp.zeros(shape=(HITS_PER_PASS,), dtype=int)
    size = int(HITS_PER_PASS)
    while size == HITS_PER_PASS and left >= MIN_TRANSMITTANCE:
        # Gather the nearest hits behind the last one, sorted by insertion.
        size = int(0)
        limit = float(wp.inf)
        surfel = int(0)
        query = wp.bvh_query_ray(table.tree, origin, direction)
        while wp.bvh_query_next(query, surfel, limit):
            hit = meet_surfel(table, surfel, origin, direction)
            if hit.alpha > 0.0 and is_before(last_t, last_surfel, hit.t, surfel):
                slot = int(size)
                if size == HITS_PER_PASS:
                    slot = HITS_PER_PASS - 1
                    if not is_before(hit.t, surfel, near_t[slot], near_surfel[slot]):
                        slot = -1
                if slot >= 0:
                    while slot > 0 and is_before(hit.t, surfel, near_t[slot - 1], near_surfel[slot - 1]):
                        near_t[slot] = near_t[slot - 1]
                        near_surfel[slot] = near_surfel[slot - 1]
                        slot -= 1
                    near_t[slot] = hit.t
                    near_surfel[slot] = surfel
                    size = wp.min(size + 1, HITS_PER_PASS)
                    if size == HITS_PER_PASS:
                        limit = FURTHER * near_t[HITS_PER_PASS - 1]

        # Visit them.
        k = int(0)
        while k < size and left >= MIN_TRANSMITTANCE:
            surfel = near_surfel[k]
            hit = meet_surfel(table, surfel, origin, direction)
            if visited == 0 and table.degree >= 0:
                basis = sh_basis_at(direction)
            raw = radiance_before_clamp(table, surfel, basis)
            emitted = clamp_radiance(raw)
            weight = left * hit.alpha
            if notes:
                score = wp.dot(g_radiance, emitted) + g_opacity + g_depth * hit.t
                prefix_score += weight * score
                g_alpha = left * score - (total_score - prefix_score) / (1.0 - hit.alpha)
                if hit.clamped == 1:
                    g_alpha = 0.0
                note = int(gradients.first_hit[ray]) + visited
                note_gradients_of_hit(note, ray, surfel, table, hit, direction, g_alpha, weight * g_depth, noted)
                noted.radiance[note] = weight * wp.vec3(
                    where_positive(raw[0], g_radiance[0]), where_positive(raw[1], g_radiance[1]), where_positive(raw[2], g_radiance[2])
                )
            color += weight * emitted
            weighted_t += weight * hit.t
            left *= 1.0 - hit.alpha
            visited += 1
            last_t = hit.t
            last_surfel = surfel
            k += 1

    if not notes:
        blended.radiance[ray] = color
        blended.opacity[ray] = 1.0 - left
        blended.depth[ray] = weighted_t
        blended.hit_count[ray] = visited


@wp.kernel
def sum_by_surfel(
    first: int,
    degree: int,
    directions: wp.array[wp.vec3],
    order: wp.array[wp.int64],
    start: wp.array[wp.int64],
    noted: GradientHits,
    # outputs
    grad_center: wp.array[wp.vec3],
    grad_tangent_u: wp.array[wp.vec3],
    grad_tangent_v: wp.array[wp.vec3],
    grad_opacity: wp.array[float],
    grad_radiance: wp.array2d[wp.vec3],
):
    """Add up a surfel's hits, in the order of rays: one thread a surfel, so no atomics and the same bits every time."""
    surfel = first + wp.tid()
    center = grad_center[surfel]
    tangent_u = grad_tangent_u[surfel]
    tangent_v = grad_tangent_v[surfel]
    g_opacity = grad_opacity[surfel]
    coefficients = (degree + 1) * (degree + 1)
    for place in range(int(start[surfel]), int(start[surfel + 1])):
        note = int(order[place])
        plane = noted.plane[note]
        g_center = noted.center[note]
        center += g_center
        tangent_u += plane[0] * g_center
        tangent_v += plane[1] * g_center
        g_opacity += plane[2]
        if degree < 0:
            grad_radiance[surfel, 0] = grad_radiance[surfel, 0] + noted.radiance[note]
        else:
            basis = sh_basis_at(directions[noted.ray[note]])
            for k in range(coefficients):
                grad_radiance[surfel, k] = grad_radiance[surfel, k] + basis[k] * noted.radiance[note]
    grad_center[surfel] = center
    grad_tangent_u[surfel] = tangent_u
    grad_tangent_v[surfel] = tangent_v
    grad_opacity[surfel] = g_opacity
