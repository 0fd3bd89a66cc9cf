"""Points of neighbouring pixels, and whether one's light will do for another's.

In: the points that a camera sees, one a pixel, and where each lies in a window.
"""

from typing import Any

import warp as wp
from torch import Tensor

from drgs.render.integrate.sample_arrays import PointArrays
from drgs.render.visible.image_tiles import Window
from drgs.warp_torch import warp_array

wp.set_module_options({"enable_backward": False})

LEAST_COSINE = wp.constant(0.9)
"""Between the normals of neighbours that take each other's light."""
MOST_OFF_PLANE = wp.constant(2.0)
"""That one lies off the other's tangent plane [pixel footprints]."""
MOST_UNLIKE = wp.constant(0.1)
"""That their roughness, or metallic, differs by."""
SIDES = 8
"""Neighbours of a pixel: above, below, left and right, then those at its corners."""


@wp.struct
class Neighbourhood:
    """Where points lie in a window that begins at a tile's corner [pixels]."""

    row: int
    column: int
    image_width: int
    footprint: float
    """Of a pixel at distance 1 [world units]."""
    place: wp.array2d[int]
    """Of each pixel of the window its point's number and one; where there is no point, 0 or another pixel's."""


def neighbourhood(window: Window, footprint: float, place: Tensor | None = None) -> Any:
    """The struct that kernels read.

    Args:
        footprint: of a pixel at distance 1 [world units]. place: (rows, columns) int32, see Neighbourhood; None: it comes later.
    """
    there = Neighbourhood()
    there.row, there.column, there.image_width, there.footprint = window.rows.start, window.columns.start, window.width, footprint
    if place is not None:
        there.place = warp_array(place)
    return there


@wp.func
def row_of(there: Neighbourhood, pixel: int) -> int:
    return pixel // there.image_width - there.row


@wp.func
def column_of(there: Neighbourhood, pixel: int) -> int:
    return pixel % there.image_width - there.column


@wp.func
def point_beside(points: PointArrays, there: Neighbourhood, p: int, side: int) -> int:
    """The point on one of a point's SIDES; -1 where there is none."""
    down = wp.where(side == 0, -1, wp.where(side == 1, 1, 0))
    right = wp.where(side == 2, -1, wp.where(side == 3, 1, 0))
    if side >= 4:
        down = wp.where(side < 6, -1, 1)
        right = wp.where(side % 2 == 0, -1, 1)
    y = row_of(there, points.pixel[p]) + down
    x = column_of(there, points.pixel[p]) + right
    if y < 0 or x < 0 or y >= there.place.shape[0] or x >= there.place.shape[1]:
        return -1
    q = there.place[y, x] - 1
    if q >= 0:  # noqa: SIM102 (some of Warp's `and` evaluate both)
        if points.pixel[q] != points.pixel[p] + down * there.image_width + right:
            return -1
    return q


@wp.func
def neighbour_alike(points: PointArrays, depth: wp.array[float], there: Neighbourhood, p: int, side: int) -> int:
    """The point on this side of a point, if its light will do for both; else -1."""
    q = point_beside(points, there, p, side)
    if q < 0:
        return -1
    if wp.dot(points.normal[p], points.normal[q]) < LEAST_COSINE:
        return -1
    off_plane = wp.abs(wp.dot(points.normal[p], points.position[q] - points.position[p]))
    unlike = wp.max(wp.abs(points.roughness[p] - points.roughness[q]), wp.abs(points.metallic[p] - points.metallic[q]))
    return wp.where(off_plane <= MOST_OFF_PLANE * there.footprint * depth[p] and unlike <= MOST_UNLIKE, q, -1)
