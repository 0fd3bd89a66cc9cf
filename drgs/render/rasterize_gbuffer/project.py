"""From surfels in the world to the numbers a pixel needs, and back.

A surfel is {p + B (u, v)}. With K [R | t] the pixel-homogeneous map of (u, v, 1) is the 3x3 matrix M with rows T_u, T_v, T_w,
and a pixel (x, y) meets the surfel's plane at (u, v, 1) ~ adj(M) (x, y, 1) =: h, so u = h_x / h_z, v = h_y / h_z: linear in the
pixel, which is what the tile loops exploit. Coordinates are taken about the surfel's own projected centre (`origin`), where float32
is fine-grained. Source: Huang et al. 2024, eq. 5-10, and Sigg et al. 2006 for the bounds (docs/sources.md: huang2024, sigg2006).

What we do differently: the box follows the opacity (no pixel with alpha >= 1/255 is missed, none is visited in vain), a surfel that
crosses the camera plane is kept and cut pixel by pixel at the near plane, and the screen-space filter's gradient is complete.
"""

import warp as wp

PARAMETERS = 24
"""A (9), origin (2), filter centre (2), opacity, rho_max, T_w.z, T_w.x, T_w.y, near (0: no test), box x0 x1 y0 y1, scale of A."""
MAX_ALPHA = 0.99
MIN_ALPHA = 1.0 / 255.0
MIN_TRANSMITTANCE = 1e-4
FILTER_CUTOFF_SQUARED = 9.0
"""The low-pass is centred on the middle of the surfel's screen box at this cutoff."""
DEPTH_CUTOFF = 3.0
"""Depth is that of the plane at (u, v), with |(u, v)| limited to this: bounded for surfels seen edge-on."""


@wp.func
def _screen_column(pixel_from_camera: wp.mat33, camera_vector: wp.vec3, origin_x: float, origin_y: float) -> wp.vec3:
    pixel = pixel_from_camera * camera_vector
    return wp.vec3(pixel[0] - origin_x * pixel[2], pixel[1] - origin_y * pixel[2], pixel[2])


@wp.func
def _origin(pixel_from_camera: wp.mat33, center_camera: wp.vec3, near: float, width: int, height: int) -> wp.vec2:
    if center_camera[2] > near:
        pixel = pixel_from_camera * center_camera
        x = wp.clamp(pixel[0] / pixel[2], -4.0 * float(width), 5.0 * float(width))
        y = wp.clamp(pixel[1] / pixel[2], -4.0 * float(height), 5.0 * float(height))
        return wp.vec2(wp.round(x), wp.round(y))
    return wp.vec2(0.5 * float(width), 0.5 * float(height))


@wp.kernel(enable_backward=False)
def project_surfels(
    first: int,
    centers: wp.array(dtype=wp.vec3),
    tangents: wp.array2d(dtype=float),
    opacities: wp.array(dtype=float),
    camera_from_world: wp.mat44,
    pixel_from_camera: wp.mat33,
    near: float,
    width: int,
    height: int,
    # outputs
    parameters: wp.array2d(dtype=float),
    depths: wp.array(dtype=wp.float64),
    tile_rects: wp.array2d(dtype=wp.int32),
    tile_counts: wp.array(dtype=wp.int32),
):
    i = first + wp.tid()
    tile_counts[i] = 0
    depths[i] = wp.float64(0.0)
    opacity = opacities[i]
    if not (opacity >= MIN_ALPHA):
        return
    rho_max = 2.0 * wp.log(opacity / MIN_ALPHA)

    p = wp.transform_point(camera_from_world, centers[i])
    bu = wp.transform_vector(camera_from_world, wp.vec3(tangents[i, 0], tangents[i, 2], tangents[i, 4]))
    bv = wp.transform_vector(camera_from_world, wp.vec3(tangents[i, 1], tangents[i, 3], tangents[i, 5]))
    origin = _origin(pixel_from_camera, p, near, width, height)
    cu = _screen_column(pixel_from_camera, bu, origin[0], origin[1])
    cv = _screen_column(pixel_from_camera, bv, origin[0], origin[1])
    cp = _screen_column(pixel_from_camera, p, origin[0], origin[1])
    tu = wp.vec3(cu[0], cv[0], cp[0])
    tv = wp.vec3(cu[1], cv[1], cp[1])
    tw = wp.vec3(cu[2], cv[2], cp[2])

    slope2 = tw[0] * tw[0] + tw[1] * tw[1]
    reach = wp.sqrt(rho_max * slope2)
    if not (tw[2] + reach > near):
        return  # wholly nearer than the near plane (or not a number)

    ax = wp.cross(tv, tw)
    ay = wp.cross(tw, tu)
    a1 = wp.cross(tu, tv)
    largest = wp.max(wp.max(wp.max(wp.abs(ax)), wp.max(wp.abs(ay))), wp.max(wp.abs(a1)))
    if not (largest > 0.0 and largest < 1.0e30):
        return
    scale = 1.0 / largest
    if wp.dot(a1, tw) < 0.0:
        scale = -scale

    # The filter's centre: middle of the box at the fixed cutoff.
    center_x = float(-1.0e6)
    center_y = float(-1.0e6)
    d9 = FILTER_CUTOFF_SQUARED * slope2 - tw[2] * tw[2]
    filtered = tw[2] > near
    if filtered:
        if d9 < 0.0:
            center_x = (FILTER_CUTOFF_SQUARED * (tu[0] * tw[0] + tu[1] * tw[1]) - tu[2] * tw[2]) / d9
            center_y = (FILTER_CUTOFF_SQUARED * (tv[0] * tw[0] + tv[1] * tw[1]) - tv[2] * tw[2]) / d9
        else:
            center_x = tu[2] / tw[2]
            center_y = tv[2] / tw[2]

    # Screen box of all pixels that may reach MIN_ALPHA: union of the plane's and the filter's, relative to origin.
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
        if filtered:
            filter_reach = wp.sqrt(0.5 * rho_max)
            low_x = wp.min(low_x, center_x - filter_reach)
            high_x = wp.max(high_x, center_x + filter_reach)
            low_y = wp.min(low_y, center_y - filter_reach)
            high_y = wp.max(high_y, center_y + filter_reach)
    x0 = int(wp.ceil(wp.clamp(low_x + origin[0], -1.0, float(width) + 1.0) - 0.5))
    x1 = int(wp.floor(wp.clamp(high_x + origin[0], -1.0, float(width) + 1.0) - 0.5))
    y0 = int(wp.ceil(wp.clamp(low_y + origin[1], -1.0, float(height) + 1.0) - 0.5))
    y1 = int(wp.floor(wp.clamp(high_y + origin[1], -1.0, float(height) + 1.0) - 0.5))
    x0 = wp.max(x0, 0)
    y0 = wp.max(y0, 0)
    x1 = wp.min(x1, width - 1)
    y1 = wp.min(y1, height - 1)
    if x0 > x1 or y0 > y1:
        return

    parameters[i, 0] = scale * ax[0]
    parameters[i, 1] = scale * ay[0]
    parameters[i, 2] = scale * a1[0]
    parameters[i, 3] = scale * ax[1]
    parameters[i, 4] = scale * ay[1]
    parameters[i, 5] = scale * a1[1]
    parameters[i, 6] = scale * ax[2]
    parameters[i, 7] = scale * ay[2]
    parameters[i, 8] = scale * a1[2]
    parameters[i, 9] = origin[0]
    parameters[i, 10] = origin[1]
    parameters[i, 11] = center_x + origin[0]
    parameters[i, 12] = center_y + origin[1]
    parameters[i, 13] = opacity
    parameters[i, 14] = rho_max
    parameters[i, 15] = tw[2]
    parameters[i, 16] = tw[0]
    parameters[i, 17] = tw[1]
    parameters[i, 18] = wp.where(tw[2] - reach > near, 0.0, near)
    parameters[i, 19] = float(x0)
    parameters[i, 20] = float(x1)
    parameters[i, 21] = float(y0)
    parameters[i, 22] = float(y1)
    parameters[i, 23] = scale
    # In float64: two opaque surfels whose float32 depths tie must not change places.
    c = centers[i]
    along = wp.float64(camera_from_world[2, 0]) * wp.float64(c[0]) + wp.float64(camera_from_world[2, 1]) * wp.float64(c[1])
    depths[i] = along + wp.float64(camera_from_world[2, 2]) * wp.float64(c[2]) + wp.float64(camera_from_world[2, 3])
    tile_rects[i, 0] = x0 / 16
    tile_rects[i, 1] = x1 / 16
    tile_rects[i, 2] = y0 / 16
    tile_rects[i, 3] = y1 / 16
    tile_counts[i] = (x1 / 16 - x0 / 16 + 1) * (y1 / 16 - y0 / 16 + 1)


@wp.kernel(enable_backward=False)
def sum_pair_gradients(
    first: int,
    pair_gradients: wp.array2d(dtype=float),
    offsets: wp.array(dtype=wp.int32),
    columns: int,
    # outputs
    surfel_gradients: wp.array2d(dtype=float),
):
    i = first + wp.tid()
    for pair in range(offsets[i], offsets[i + 1]):
        for k in range(columns):
            surfel_gradients[i, k] += pair_gradients[pair, k]


@wp.kernel(enable_backward=False)
def project_surfels_backward(
    first: int,
    centers: wp.array(dtype=wp.vec3),
    tangents: wp.array2d(dtype=float),
    parameters: wp.array2d(dtype=float),
    tile_counts: wp.array(dtype=wp.int32),
    surfel_gradients: wp.array2d(dtype=float),
    camera_from_world: wp.mat44,
    pixel_from_camera: wp.mat33,
    near: float,
    # outputs
    center_gradients: wp.array(dtype=wp.vec3),
    tangent_gradients: wp.array2d(dtype=float),
    opacity_gradients: wp.array(dtype=float),
):
    i = first + wp.tid()
    if tile_counts[i] == 0:
        return
    p = wp.transform_point(camera_from_world, centers[i])
    bu = wp.transform_vector(camera_from_world, wp.vec3(tangents[i, 0], tangents[i, 2], tangents[i, 4]))
    bv = wp.transform_vector(camera_from_world, wp.vec3(tangents[i, 1], tangents[i, 3], tangents[i, 5]))
    origin_x = parameters[i, 9]
    origin_y = parameters[i, 10]
    cu = _screen_column(pixel_from_camera, bu, origin_x, origin_y)
    cv = _screen_column(pixel_from_camera, bv, origin_x, origin_y)
    cp = _screen_column(pixel_from_camera, p, origin_x, origin_y)
    tu = wp.vec3(cu[0], cv[0], cp[0])
    tv = wp.vec3(cu[1], cv[1], cp[1])
    tw = wp.vec3(cu[2], cv[2], cp[2])

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
    if tw[2] > near:
        d9 = FILTER_CUTOFF_SQUARED * (tw[0] * tw[0] + tw[1] * tw[1]) - tw[2] * tw[2]
        if d9 < 0.0:
            center_x = parameters[i, 11] - origin_x
            center_y = parameters[i, 12] - origin_y
            t = wp.vec3(FILTER_CUTOFF_SQUARED, FILTER_CUTOFF_SQUARED, -1.0) / d9
            gtu = gtu + gcx * wp.cw_mul(t, tw)
            gtv = gtv + gcy * wp.cw_mul(t, tw)
            gtw = gtw + gcx * wp.cw_mul(t, tu - 2.0 * center_x * tw) + gcy * wp.cw_mul(t, tv - 2.0 * center_y * tw)
        else:
            gtu = gtu + wp.vec3(0.0, 0.0, gcx / tw[2])
            gtv = gtv + wp.vec3(0.0, 0.0, gcy / tw[2])
            gtw = gtw - wp.vec3(0.0, 0.0, (gcx * tu[2] + gcy * tv[2]) / (tw[2] * tw[2]))

    # T = shift K (R V + t): back through the shift, K and R, column by column.
    gtw = gtw - origin_x * gtu - origin_y * gtv
    camera_from_pixel_t = wp.transpose(pixel_from_camera)
    rotation = wp.mat33(
        camera_from_world[0, 0], camera_from_world[0, 1], camera_from_world[0, 2],
        camera_from_world[1, 0], camera_from_world[1, 1], camera_from_world[1, 2],
        camera_from_world[2, 0], camera_from_world[2, 1], camera_from_world[2, 2],
    )  # fmt: skip
    world = wp.transpose(rotation) * camera_from_pixel_t
    gbu = world * wp.vec3(gtu[0], gtv[0], gtw[0])
    gbv = world * wp.vec3(gtu[1], gtv[1], gtw[1])
    center_gradients[i] = world * wp.vec3(gtu[2], gtv[2], gtw[2])
    for k in range(3):
        tangent_gradients[i, 2 * k] = gbu[k]
        tangent_gradients[i, 2 * k + 1] = gbv[k]
    opacity_gradients[i] = surfel_gradients[i, 11]
