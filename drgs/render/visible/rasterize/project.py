"""From surfels in the world to the numbers a pixel needs, and back.

A surfel is {p + B (u, v)}. With K [R | t] the pixel-homogeneous map of (u, v, 1) is the 3x3 matrix M with rows T_u, T_v, T_w,
and a pixel (x, y) meets the surfel's plane at (u, v, 1) ~ adj(M) (x, y, 1) =: h, so u = h_x / h_z, v = h_y / h_z: linear in the
pixel, which is what the tile loops exploit. Coordinates are taken about the surfel's own projected centre (`origin`), where float32
is fine-grained. Source: Huang et al. 2024, eq. 5-10, and Sigg et al. 2006 for the bounds (docs/sources.md: huang2024, sigg2006).

What we do differently: the box follows the opacity (no pixel with alpha >= MIN_ALPHA is missed, none is visited in vain), a surfel that
crosses the camera plane is kept and cut pixel by pixel at the near plane, and the screen-space filter's gradient is complete.
"""

import warp as wp

from drgs.maths.constants import MIN_ALPHA

PARAMETERS = 25
"""A (9), origin (2), filter centre (2), opacity, rho_max, T_w.z, T_w.x, T_w.y, near (0: no test), box x0 x1 y0 y1, scale of A,
1 / variance of the filter."""
FILTER_CUTOFF_SQUARED = 9.0
"""The low-pass is centred on the middle of the surfel's screen box at this cutoff."""
DEPTH_CUTOFF = 3.0
"""Depth is that of the plane at (u, v), with |(u, v)| limited to this: bounded for surfels seen edge-on."""


@wp.struct
class RasterView:
    """The camera, and what of the settings projecting needs."""

    camera_from_world: wp.mat44
    pixel_from_camera: wp.mat33
    near: float
    """[world units]."""
    filter_precision: float
    """1 / variance of the low-pass [1 / pixel^2]."""
    width: int
    height: int


@wp.struct
class SurfelRows:
    """T_u, T_v and T_w of a surfel, about its origin."""

    tu: wp.vec3
    tv: wp.vec3
    tw: wp.vec3


@wp.struct
class ProjectedSurfels:
    """What project_surfels writes of each surfel."""

    parameters: wp.array2d[float]
    """(surfel, PARAMETERS)."""
    depths: wp.array[wp.float64]
    """Of the centres, along the viewing axis."""
    tile_rects: wp.array2d[wp.int32]
    """(surfel, 4): first and last column, first and last row of tiles."""
    tile_counts: wp.array[wp.int32]
    """0 where a surfel is not seen; its other values then mean nothing."""


@wp.func
def _screen_column(pixel_from_camera: wp.mat33, camera_vector: wp.vec3, origin: wp.vec2) -> wp.vec3:
    pixel = pixel_from_camera * camera_vector
    return wp.vec3(pixel[0] - origin[0] * pixel[2], pixel[1] - origin[1] * pixel[2], pixel[2])


@wp.func
def _origin(view: RasterView, center_camera: wp.vec3) -> wp.vec2:
    if center_camera[2] > view.near:
        pixel = view.pixel_from_camera * center_camera
        x = wp.clamp(pixel[0] / pixel[2], -4.0 * float(view.width), 5.0 * float(view.width))
        y = wp.clamp(pixel[1] / pixel[2], -4.0 * float(view.height), 5.0 * float(view.height))
        return wp.vec2(wp.round(x), wp.round(y))
    return wp.vec2(0.5 * float(view.width), 0.5 * float(view.height))


@wp.func
def _rows_about(view: RasterView, center_camera: wp.vec3, tangents: wp.array2d[float], i: int, origin: wp.vec2) -> SurfelRows:
    bu = wp.transform_vector(view.camera_from_world, wp.vec3(tangents[i, 0], tangents[i, 2], tangents[i, 4]))
    bv = wp.transform_vector(view.camera_from_world, wp.vec3(tangents[i, 1], tangents[i, 3], tangents[i, 5]))
    cu = _screen_column(view.pixel_from_camera, bu, origin)
    cv = _screen_column(view.pixel_from_camera, bv, origin)
    cp = _screen_column(view.pixel_from_camera, center_camera, origin)
    rows = SurfelRows()
    rows.tu = wp.vec3(cu[0], cv[0], cp[0])
    rows.tv = wp.vec3(cu[1], cv[1], cp[1])
    rows.tw = wp.vec3(cu[2], cv[2], cp[2])
    return rows


@wp.func
def _filter_center(rows: SurfelRows, slope2: float, near: float) -> wp.vec2:
    """Middle of the surfel's box at the fixed cutoff, relative to its origin; far away where its centre is not in front."""
    tu = rows.tu
    tv = rows.tv
    tw = rows.tw
    if not (tw[2] > near):
        return wp.vec2(-1.0e6, -1.0e6)
    d9 = FILTER_CUTOFF_SQUARED * slope2 - tw[2] * tw[2]
    if d9 < 0.0:
        center_x = (FILTER_CUTOFF_SQUARED * (tu[0] * tw[0] + tu[1] * tw[1]) - tu[2] * tw[2]) / d9
        center_y = (FILTER_CUTOFF_SQUARED * (tv[0] * tw[0] + tv[1] * tw[1]) - tv[2] * tw[2]) / d9
        return wp.vec2(center_x, center_y)
    return wp.vec2(tu[2] / tw[2], tv[2] / tw[2])


@wp.func
def _screen_box(rows: SurfelRows, view: RasterView, rho_max: float, slope2: float, center: wp.vec2, origin: wp.vec2) -> wp.vec4i:
    """First and last column, first and last row of all pixels that may reach MIN_ALPHA: the plane's and the filter's box together."""
    tu = rows.tu
    tv = rows.tv
    tw = rows.tw
    d = rho_max * slope2 - tw[2] * tw[2]
    low_x = float(-1.0e9)
    high_x = float(1.0e9)
    low_y = float(-1.0e9)
    high_y = float(1.0e9)
    if d < 0.0 and tw[2] > 0.0:
        mx = (rho_max * (tu[0] * tw[0] + tu[1] * tw[1]) - tu[2] * tw[2]) / d
        my = (rho_max * (tv[0] * tw[0] + tv[1] * tw[1]) - tv[2] * tw[2]) / d
        hx = wp.sqrt(wp.max(mx * mx - (rho_max * (tu[0] * tu[0] + tu[1] * tu[1]) - tu[2] * tu[2]) / d, 0.0)) * 1.0001 + 0.01
        hy = wp.sqrt(wp.max(my * my - (rho_max * (tv[0] * tv[0] + tv[1] * tv[1]) - tv[2] * tv[2]) / d, 0.0)) * 1.0001 + 0.01
        low_x = mx - hx
        high_x = mx + hx
        low_y = my - hy
        high_y = my + hy
        if tw[2] > view.near:
            filter_reach = wp.sqrt(rho_max / view.filter_precision)
            low_x = wp.min(low_x, center[0] - filter_reach)
            high_x = wp.max(high_x, center[0] + filter_reach)
            low_y = wp.min(low_y, center[1] - filter_reach)
            high_y = wp.max(high_y, center[1] + filter_reach)
    x0 = int(wp.ceil(wp.clamp(low_x + origin[0], -1.0, float(view.width) + 1.0) - 0.5))
    x1 = int(wp.floor(wp.clamp(high_x + origin[0], -1.0, float(view.width) + 1.0) - 0.5))
    y0 = int(wp.ceil(wp.clamp(low_y + origin[1], -1.0, float(view.height) + 1.0) - 0.5))
    y1 = int(wp.floor(wp.clamp(high_y + origin[1], -1.0, float(view.height) + 1.0) - 0.5))
    return wp.vec4i(wp.max(x0, 0), wp.min(x1, view.width - 1), wp.max(y0, 0), wp.min(y1, view.height - 1))


@wp.kernel(enable_backward=False)
def project_surfels(
    first: int,
    view: RasterView,
    centers: wp.array[wp.vec3],
    tangents: wp.array2d[float],
    opacities: wp.array[float],
    # outputs
    projected: ProjectedSurfels,
):
    i = first + wp.tid()
    projected.tile_counts[i] = 0
    projected.depths[i] = wp.float64(0.0)
    opacity = opacities[i]
    if not (opacity >= MIN_ALPHA):
        return
    rho_max = 2.0 * wp.log(opacity / MIN_ALPHA)
    p = wp.transform_point(view.camera_from_world, centers[i])
    origin = _origin(view, p)
    rows = _rows_about(view, p, tangents, i, origin)
    tw = rows.tw
    slope2 = tw[0] * tw[0] + tw[1] * tw[1]
    reach = wp.sqrt(rho_max * slope2)
    if not (tw[2] + reach > view.near):
        return  # wholly nearer than the near plane (or not a number)

    ax = wp.cross(rows.tv, tw)
    ay = wp.cross(tw, rows.tu)
    a1 = wp.cross(rows.tu, rows.tv)
    largest = wp.max(wp.max(wp.max(wp.abs(ax)), wp.max(wp.abs(ay))), wp.max(wp.abs(a1)))
    if not (largest > 0.0 and largest < 1.0e30):
        return
    scale = 1.0 / largest
    if wp.dot(a1, tw) < 0.0:
        scale = -scale
    center = _filter_center(rows, slope2, view.near)
    box = _screen_box(rows, view, rho_max, slope2, center, origin)
    if box[0] > box[1] or box[2] > box[3]:
        return

    for k in range(3):
        projected.parameters[i, 3 * k] = scale * ax[k]
        projected.parameters[i, 3 * k + 1] = scale * ay[k]
        projected.parameters[i, 3 * k + 2] = scale * a1[k]
    projected.parameters[i, 9] = origin[0]
    projected.parameters[i, 10] = origin[1]
    projected.parameters[i, 11] = center[0] + origin[0]
    projected.parameters[i, 12] = center[1] + origin[1]
    projected.parameters[i, 13] = opacity
    projected.parameters[i, 14] = rho_max
    projected.parameters[i, 15] = tw[2]
    projected.parameters[i, 16] = tw[0]
    projected.parameters[i, 17] = tw[1]
    projected.parameters[i, 18] = wp.where(tw[2] - reach > view.near, 0.0, view.near)
    for k in range(4):
        projected.parameters[i, 19 + k] = float(box[k])
        projected.tile_rects[i, k] = box[k] / 16
    projected.parameters[i, 23] = scale
    projected.parameters[i, 24] = view.filter_precision
    projected.tile_counts[i] = (box[1] / 16 - box[0] / 16 + 1) * (box[3] / 16 - box[2] / 16 + 1)
    # In float64: two opaque surfels whose float32 depths tie must not change places.
    c = centers[i]
    m = view.camera_from_world
    along = wp.float64(m[2, 0]) * wp.float64(c[0]) + wp.float64(m[2, 1]) * wp.float64(c[1])
    projected.depths[i] = along + wp.float64(m[2, 2]) * wp.float64(c[2]) + wp.float64(m[2, 3])


@wp.func_native("""
// Four numbers at a time, each sum in a register; the last four may overlap those before. There are at least twenty.
typedef float v4 __attribute__((ext_vector_type(4), aligned(4)));
const float* const first = pair_gradients.data + (long)begin * columns;
for (int step = 0; step < columns; step += 4) {
    const int k = step < columns - 4 ? step : columns - 4;
    v4 sum = v4(0.0f);
    for (int pair = 0; pair < end - begin; ++pair) sum += *(const v4*)(first + (long)pair * columns + k);
    *(v4*)(sums.data + (long)surfel * columns + k) = sum;
}
""")
def _sum_rows(surfel: int, begin: int, end: int, columns: int, pair_gradients: wp.array2d[float], sums: wp.array2d[float]): ...


@wp.kernel(enable_backward=False)
def sum_pair_gradients(
    first: int,
    pair_gradients: wp.array2d[float],
    offsets: wp.array[wp.int32],
    columns: int,
    # outputs
    surfel_gradients: wp.array2d[float],
):
    """On the CPU, where they are written pair by pair."""
    i = first + wp.tid()
    _sum_rows(i, offsets[i], offsets[i + 1], columns, pair_gradients, surfel_gradients)


@wp.kernel(enable_backward=False)
def project_surfels_backward(
    first: int,
    view: RasterView,
    centers: wp.array[wp.vec3],
    tangents: wp.array2d[float],
    parameters: wp.array2d[float],
    tile_counts: wp.array[wp.int32],
    surfel_gradients: wp.array2d[float],
    # outputs
    center_gradients: wp.array[wp.vec3],
    tangent_gradients: wp.array2d[float],
    opacity_gradients: wp.array[float],
):
    i = first + wp.tid()
    if tile_counts[i] == 0:
        return
    origin = wp.vec2(parameters[i, 9], parameters[i, 10])
    rows = _rows_about(view, wp.transform_point(view.camera_from_world, centers[i]), tangents, i, origin)
    tu = rows.tu
    tv = rows.tv
    tw = rows.tw

    scale = parameters[i, 23]  # h is homogeneous: its scale carries no gradient
    gx = scale * wp.vec3(surfel_gradients[i, 0], surfel_gradients[i, 3], surfel_gradients[i, 6])
    gy = scale * wp.vec3(surfel_gradients[i, 1], surfel_gradients[i, 4], surfel_gradients[i, 7])
    g1 = scale * wp.vec3(surfel_gradients[i, 2], surfel_gradients[i, 5], surfel_gradients[i, 8])
    gtv = wp.cross(tw, gx) + wp.cross(g1, tu)
    gtw = wp.cross(gx, tv) + wp.cross(tu, gy)
    gtu = wp.cross(gy, tw) + wp.cross(tv, g1)
    gtw = gtw + wp.vec3(surfel_gradients[i, 12], surfel_gradients[i, 13], surfel_gradients[i, 14])

    gcx = surfel_gradients[i, 9]
    gcy = surfel_gradients[i, 10]
    if tw[2] > view.near:
        d9 = FILTER_CUTOFF_SQUARED * (tw[0] * tw[0] + tw[1] * tw[1]) - tw[2] * tw[2]
        if d9 < 0.0:
            center_x = parameters[i, 11] - origin[0]
            center_y = parameters[i, 12] - origin[1]
            t = wp.vec3(FILTER_CUTOFF_SQUARED, FILTER_CUTOFF_SQUARED, -1.0) / d9
            gtu = gtu + gcx * wp.cw_mul(t, tw)
            gtv = gtv + gcy * wp.cw_mul(t, tw)
            gtw = gtw + gcx * wp.cw_mul(t, tu - 2.0 * center_x * tw) + gcy * wp.cw_mul(t, tv - 2.0 * center_y * tw)
        else:
            gtu = gtu + wp.vec3(0.0, 0.0, gcx / tw[2])
            gtv = gtv + wp.vec3(0.0, 0.0, gcy / tw[2])
            gtw = gtw - wp.vec3(0.0, 0.0, (gcx * tu[2] + gcy * tv[2]) / (tw[2] * tw[2]))

    # T = shift K (R V + t): back through the shift, K and R, column by column.
    gtw = gtw - origin[0] * gtu - origin[1] * gtv
    m = view.camera_from_world
    rotation = wp.mat33(m[0, 0], m[0, 1], m[0, 2], m[1, 0], m[1, 1], m[1, 2], m[2, 0], m[2, 1], m[2, 2])
    world = wp.transpose(rotation) * wp.transpose(view.pixel_from_camera)
    gbu = world * wp.vec3(gtu[0], gtv[0], gtw[0])
    gbv = world * wp.vec3(gtu[1], gtv[1], gtw[1])
    center_gradients[i] = world * wp.vec3(gtu[2], gtv[2], gtw[2])
    for k in range(3):
        tangent_gradients[i, 2 * k] = gbu[k]
        tangent_gradients[i, 2 * k + 1] = gbv[k]
    opacity_gradients[i] = surfel_gradients[i, 11]
