"""Bilinear lookups in tables of directions for kernels, with gradients: `rows` rows of twice as many columns, u around, v from pole to pole, 0..1."""

import warp as wp


@wp.struct
class Texels:
    """Four texels around a place of a table."""

    corner: wp.vec4i
    """Above left and right, below left and right."""
    fx: float
    fy: float
    inside: float
    """0 where the row is clamped: no slope across rows."""


@wp.func
def texels_at(start: int, rows: int, u: float, v: float) -> Texels:
    columns = 2 * rows
    x = u * float(columns) - 0.5
    row_place = v * float(rows) - 0.5
    y = wp.clamp(row_place, 0.0, float(rows) - 1.0)
    x_floor = wp.floor(x)
    y_floor = wp.min(wp.floor(y), float(rows) - 2.0)
    column0 = (int(x_floor) + columns) % columns
    column1 = (column0 + 1) % columns
    row = start + int(y_floor) * columns
    around = Texels()
    around.corner = wp.vec4i(row + column0, row + column1, row + columns + column0, row + columns + column1)
    around.fx = x - x_floor
    around.fy = y - y_floor
    around.inside = wp.where(row_place == y, 1.0, 0.0)
    return around


@wp.func
def texel_value(tables: wp.array[wp.vec3], around: Texels) -> wp.vec3:
    fx = around.fx
    top = tables[around.corner[0]] * (1.0 - fx) + tables[around.corner[1]] * fx
    bottom = tables[around.corner[2]] * (1.0 - fx) + tables[around.corner[3]] * fx
    return top * (1.0 - around.fy) + bottom * around.fy


@wp.func
def texel_slopes(tables: wp.array[wp.vec3], around: Texels, rows: int, gradient: wp.vec3) -> wp.vec2:
    """Slopes by u and v of texel_value times `gradient`."""
    a = wp.dot(tables[around.corner[0]], gradient)
    b = wp.dot(tables[around.corner[1]], gradient)
    c = wp.dot(tables[around.corner[2]], gradient)
    d = wp.dot(tables[around.corner[3]], gradient)
    by_x = (b - a) * (1.0 - around.fy) + (d - c) * around.fy
    by_y = (c - a) * (1.0 - around.fx) + (d - b) * around.fx
    return wp.vec2(by_x * float(2 * rows), by_y * float(rows) * around.inside)


@wp.func
def add_to_texels(table_gradients: wp.array[wp.vec3], around: Texels, gradient: wp.vec3):
    fx = around.fx
    top = gradient * (1.0 - around.fy)
    bottom = gradient * around.fy
    wp.atomic_add(table_gradients, around.corner[0], top * (1.0 - fx))
    wp.atomic_add(table_gradients, around.corner[1], top * fx)
    wp.atomic_add(table_gradients, around.corner[2], bottom * (1.0 - fx))
    wp.atomic_add(table_gradients, around.corner[3], bottom * fx)
