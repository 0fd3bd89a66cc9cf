"""Split sum at one point, as Warp functions: what light a point sends towards the camera, and the gradients of that by all that it depends on.

split_sum.py has the formula and makes the tables. Gradients are written out: Warp's own adjoint of these functions takes three times as long, and
fits spend a tenth of their time there. Kernels that shade places of a mesh call the same two functions (surface_color.py, mesh_light_kernels.py).
"""

import warp as wp

from drgs.maths.angles_warp import arc_cosine, azimuth
from drgs.maths.lat_long_warp import Texels, add_to_texels, texel_slopes, texel_value, texels_at

wp.set_module_options({"enable_backward": False})

LEVELS = ((0.05, 128), (0.2, 128), (0.35, 64), (0.5, 32), (0.7, 16), (1.0, 16))
"""(roughness, rows) of each filtered table; between them the lookup is linear in roughness. The first is the environment itself."""
IRRADIANCE_ROWS = 16
"""Of the last table: the cosine-weighted mean of the environment about a normal."""
OFFSETS = tuple(sum(2 * rows * rows for _, rows in LEVELS[:k]) for k in range(len(LEVELS)))
IRRADIANCE_START = sum(2 * rows * rows for _, rows in LEVELS)
_ROUGHNESS = wp.constant(wp.types.vector(length=len(LEVELS), dtype=float)(*(r for r, _ in LEVELS)))
_ROWS = wp.constant(wp.types.vector(length=len(LEVELS), dtype=wp.int32)(*(rows for _, rows in LEVELS)))
_OFFSET = wp.constant(wp.types.vector(length=len(LEVELS), dtype=wp.int32)(*OFFSETS))
_LEVEL_COUNT = wp.constant(len(LEVELS))
_IRRADIANCE_ROWS = wp.constant(IRRADIANCE_ROWS)
_IRRADIANCE_START = wp.constant(IRRADIANCE_START)
TABLE_SIZE = 32
"""Of brdf_table, along both sides."""


@wp.func
def _uv(direction: wp.vec3) -> wp.vec2:
    # Neither angle has a derivative at the poles; a nudge of 1e-6 is a millionth of a turn.
    u = 0.5 - azimuth(direction[0] + 1.0e-8, direction[1]) / (2.0 * wp.pi)
    return wp.vec2(u, arc_cosine(wp.clamp(direction[2], -0.999999, 0.999999)) / wp.pi)


@wp.func
def _uv_gradient(direction: wp.vec3, g_u: float, g_v: float) -> wp.vec3:
    # Of g_u u + g_v v, as _uv has them.
    x = direction[0] + 1.0e-8
    y = direction[1]
    around = g_u / (2.0 * wp.pi * wp.max(x * x + y * y, 1.0e-12))
    z = direction[2]
    down = wp.where(wp.abs(z) <= 0.999999, -g_v / (wp.pi * wp.sqrt(wp.max(1.0 - z * z, 1.0e-12))), 0.0)
    return wp.vec3(around * y, -around * x, down)


@wp.struct
class _Factors:
    """F1 and F2 of the BRDF, and their slopes."""

    value: wp.vec2
    by_cosine: wp.vec2
    by_roughness: wp.vec2


@wp.func
def _factors(table: wp.array[wp.vec2], n_dot_v: float, roughness: float) -> _Factors:
    last = float(TABLE_SIZE) - 1.0
    across = n_dot_v * float(TABLE_SIZE) - 0.5
    down = roughness * float(TABLE_SIZE) - 0.5
    x = wp.clamp(across, 0.0, last)
    y = wp.clamp(down, 0.0, last)
    x_floor = wp.min(wp.floor(x), last - 1.0)
    y_floor = wp.min(wp.floor(y), last - 1.0)
    fx = x - x_floor
    fy = y - y_floor
    k = int(y_floor) * TABLE_SIZE + int(x_floor)
    low = table[k] * (1.0 - fx) + table[k + 1] * fx
    high = table[k + TABLE_SIZE] * (1.0 - fx) + table[k + TABLE_SIZE + 1] * fx
    found = _Factors()
    found.value = low * (1.0 - fy) + high * fy
    step = float(TABLE_SIZE)
    by_x = (table[k + 1] - table[k]) * (1.0 - fy) + (table[k + TABLE_SIZE + 1] - table[k + TABLE_SIZE]) * fy
    found.by_cosine = by_x * wp.where(across == x, step, 0.0)
    found.by_roughness = (high - low) * wp.where(down == y, step, 0.0)
    return found


@wp.func
def _level_below(r: float) -> int:
    level = wp.where(r >= _ROUGHNESS[1], 1, 0) + wp.where(r >= _ROUGHNESS[2], 1, 0)
    return level + wp.where(r >= _ROUGHNESS[3], 1, 0) + wp.where(r >= _ROUGHNESS[4], 1, 0)


@wp.struct
class _Mirrored:
    """Where the mirrored light is looked up."""

    direction: wp.vec3
    near: Texels
    far: Texels
    level: int
    fraction: float
    """Of the table of the next level."""


@wp.func
def _mirrored(normal: wp.vec3, wo: wp.vec3, roughness: float) -> _Mirrored:
    found = _Mirrored()
    found.direction = 2.0 * wp.dot(normal, wo) * normal - wo
    uv = _uv(found.direction)
    r = wp.clamp(roughness, _ROUGHNESS[0], _ROUGHNESS[_LEVEL_COUNT - 1])
    level = _level_below(r)
    found.level = level
    found.fraction = (r - _ROUGHNESS[level]) / (_ROUGHNESS[level + 1] - _ROUGHNESS[level])
    found.near = texels_at(_OFFSET[level], _ROWS[level], uv[0], uv[1])
    found.far = texels_at(_OFFSET[level + 1], _ROWS[level + 1], uv[0], uv[1])
    return found


@wp.func
def looked_up(direction: wp.vec3, first: int, rows: int, tables: wp.array[wp.vec3]) -> wp.vec3:
    """Of the table of so many rows that begins at `first`."""
    uv = _uv(direction)
    return texel_value(tables, texels_at(first, rows, uv[0], uv[1]))


@wp.func
def lookup_gradient(
    g: wp.vec3, direction: wp.vec3, first: int, rows: int, tables: wp.array[wp.vec3], table_gradients: wp.array[wp.vec3]
) -> wp.vec3:
    """Of g times looked_up, by the direction; that of the table is added to `table_gradients`."""
    uv = _uv(direction)
    about = texels_at(first, rows, uv[0], uv[1])
    by_uv = texel_slopes(tables, about, rows, g)
    add_to_texels(table_gradients, about, g)
    return _uv_gradient(direction, by_uv[0], by_uv[1])


@wp.func
def radiance_of_point(
    diffuse_albedo: wp.vec3,
    f0: wp.vec3,
    roughness: float,
    normal: wp.vec3,
    wo: wp.vec3,
    transmittance: float,
    hit_radiance: wp.vec3,
    open_share: wp.vec3,
    tables: wp.array[wp.vec3],
    factor_table: wp.array[wp.vec2],
) -> wp.vec3:
    mirror = _mirrored(normal, wo, roughness)
    sky = texel_value(tables, mirror.near) * (1.0 - mirror.fraction) + texel_value(tables, mirror.far) * mirror.fraction
    reflected = sky * transmittance + hit_radiance
    factors = _factors(factor_table, wp.dot(normal, wo), roughness).value
    irradiance = looked_up(normal, _IRRADIANCE_START, _IRRADIANCE_ROWS, tables)
    specular = wp.cw_mul(reflected, f0 * factors[0] + wp.vec3(factors[1], factors[1], factors[1]))
    return wp.cw_mul(diffuse_albedo, wp.cw_mul(irradiance, open_share)) + specular


@wp.struct
class PointGradients:
    """Of what a point sends, by the point's own."""

    diffuse_albedo: wp.vec3
    f0: wp.vec3
    roughness: float
    normal: wp.vec3
    open_share: wp.vec3


@wp.func
def gradients_of_point(
    g: wp.vec3,
    diffuse_albedo: wp.vec3,
    f0: wp.vec3,
    roughness: float,
    normal: wp.vec3,
    wo: wp.vec3,
    transmittance: float,
    hit_radiance: wp.vec3,
    open_share: wp.vec3,
    tables: wp.array[wp.vec3],
    factor_table: wp.array[wp.vec2],
    table_gradients: wp.array[wp.vec3],
) -> PointGradients:
    """Of g times radiance_of_point; those of the tables are added to `table_gradients`."""
    n_dot_v = wp.dot(normal, wo)
    mirror = _mirrored(normal, wo, roughness)
    near = texel_value(tables, mirror.near)
    far = texel_value(tables, mirror.far)
    f = mirror.fraction
    reflected = (near * (1.0 - f) + far * f) * transmittance + hit_radiance
    factors = _factors(factor_table, n_dot_v, roughness)
    irradiance = looked_up(normal, _IRRADIANCE_START, _IRRADIANCE_ROWS, tables)
    g_open = wp.cw_mul(g, open_share)

    g_reflectance = wp.cw_mul(g, reflected)
    g_factors = wp.vec2(wp.dot(g_reflectance, f0), g_reflectance[0] + g_reflectance[1] + g_reflectance[2])
    edge = wp.vec3(factors.value[1], factors.value[1], factors.value[1])
    g_sky = wp.cw_mul(g, f0 * factors.value[0] + edge) * transmittance
    g_near = g_sky * (1.0 - f)
    g_far = g_sky * f
    level = mirror.level
    between = wp.dot(g_sky, far - near) / (_ROUGHNESS[level + 1] - _ROUGHNESS[level])
    within = wp.where(roughness >= _ROUGHNESS[0], 1.0, 0.0) * wp.where(roughness <= _ROUGHNESS[_LEVEL_COUNT - 1], 1.0, 0.0)
    by_uv = texel_slopes(tables, mirror.near, _ROWS[level], g_near) + texel_slopes(tables, mirror.far, _ROWS[level + 1], g_far)
    g_mirror = _uv_gradient(mirror.direction, by_uv[0], by_uv[1])
    add_to_texels(table_gradients, mirror.near, g_near)
    add_to_texels(table_gradients, mirror.far, g_far)

    found = PointGradients()
    found.diffuse_albedo = wp.cw_mul(g_open, irradiance)
    found.open_share = wp.cw_mul(wp.cw_mul(g, diffuse_albedo), irradiance)
    found.f0 = g_reflectance * factors.value[0]
    found.roughness = wp.dot(g_factors, factors.by_roughness) + between * within
    g_cosine = wp.dot(g_factors, factors.by_cosine) + 2.0 * wp.dot(g_mirror, normal)
    g_irradiance = wp.cw_mul(g_open, diffuse_albedo)
    by_irradiance = lookup_gradient(g_irradiance, normal, _IRRADIANCE_START, _IRRADIANCE_ROWS, tables, table_gradients)
    found.normal = 2.0 * n_dot_v * g_mirror + g_cosine * wo + by_irradiance
    return found


@wp.kernel
def split_sum_kernel(
    first: int,
    diffuse_albedo: wp.array[wp.vec3],
    residual: wp.array[wp.vec3],
    f0: wp.array[wp.vec3],
    roughness: wp.array[float],
    normal: wp.array[wp.vec3],
    wo: wp.array[wp.vec3],
    transmittance: wp.array[float],
    hit_radiance: wp.array[wp.vec3],
    open_share: wp.array[wp.vec3],
    tables: wp.array[wp.vec3],
    factor_table: wp.array[wp.vec2],
    # outputs
    radiance: wp.array[wp.vec3],
):
    """Many arguments because a struct of them would be filled anew, array by array, for each launch."""
    i = first + wp.tid()
    radiance[i] = residual[i] + radiance_of_point(
        diffuse_albedo[i], f0[i], roughness[i], normal[i], wo[i], transmittance[i], hit_radiance[i], open_share[i], tables, factor_table
    )


@wp.kernel
def split_sum_adjoint(
    first: int,
    diffuse_albedo: wp.array[wp.vec3],
    residual: wp.array[wp.vec3],
    f0: wp.array[wp.vec3],
    roughness: wp.array[float],
    normal: wp.array[wp.vec3],
    wo: wp.array[wp.vec3],
    transmittance: wp.array[float],
    hit_radiance: wp.array[wp.vec3],
    open_share: wp.array[wp.vec3],
    tables: wp.array[wp.vec3],
    factor_table: wp.array[wp.vec2],
    radiance_gradient: wp.array[wp.vec3],
    # outputs
    diffuse_gradient: wp.array[wp.vec3],
    f0_gradient: wp.array[wp.vec3],
    roughness_gradient: wp.array[float],
    normal_gradient: wp.array[wp.vec3],
    table_gradients: wp.array[wp.vec3],
):
    """Many arguments because a struct of them would be filled anew, array by array, for each launch."""
    i = first + wp.tid()
    found = gradients_of_point(
        radiance_gradient[i], diffuse_albedo[i], f0[i], roughness[i], normal[i], wo[i], transmittance[i], hit_radiance[i], open_share[i],
        tables, factor_table, table_gradients,
    )  # fmt: skip
    diffuse_gradient[i] = found.diffuse_albedo
    f0_gradient[i] = found.f0
    roughness_gradient[i] = found.roughness
    normal_gradient[i] = found.normal
