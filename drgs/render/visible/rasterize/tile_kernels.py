"""Tile loops, one compiled variant per channel count: hand-vectorised blocks of 4x4 pixels on the CPU, a thread a pixel on CUDA.

The CPU body is C++ with Clang's vector types, kept in the .h files beside this one and compiled by Warp itself, so a user needs no
toolchain. Both follow drgs/reference/rasterize_gbuffer.py, which is their specification.
"""

from functools import cache
from pathlib import Path
from typing import Any

import warp as wp

from drgs.maths.constants import MAX_ALPHA, MIN_TRANSMITTANCE
from drgs.render.native_source import native_source
from drgs.render.visible.rasterize.project import DEPTH_CUTOFF, PARAMETERS

FAR = 100.0
"""Squared distance from a surfel, in standard deviations, that counts for all farther ones. No pixel is live beyond 12: its opacity there is below MIN_ALPHA."""
TILE_BLOCKS = Path(__file__).with_name("tile_blocks.h")
CHANNEL_STEPS = (4, 8, 12, 13, 16, 20, 24, 32, 48)
"""Compiled widths; features are padded with zeros to the next one. Stage 1 of a build blends 13."""


def padded_channels(channels: int) -> int:
    """The compiled width that holds `channels`.

    Raises:
        ValueError: more channels than the widest variant.
    """
    for step in CHANNEL_STEPS:
        if channels <= step:
            return step
    raise ValueError(f"the rasteriser blends at most {CHANNEL_STEPS[-1]} feature channels at once; found {channels}: split them")


def _source(name: str, channels: int, depth: int) -> str:
    limits = {"FAR": FAR, "MAX_ALPHA": MAX_ALPHA, "MIN_TRANSMITTANCE": MIN_TRANSMITTANCE, "DEPTH_CUTOFF": DEPTH_CUTOFF}
    sizes = {"CHANNELS": channels, "DEPTH": depth, "PARAMETERS": PARAMETERS}
    return native_source(Path(__file__).with_name(name), TILE_BLOCKS, constants={**sizes, **limits})


@wp.struct
class TileTable:
    """What the tile loops read: the lists of tiles.py, and of each surfel the numbers of project.py and its features."""

    tiles_x: int
    """Tiles side by side."""
    first_row: int
    """Row of tiles of the image with which the tiles begin that are blended."""
    stride: int
    """Padded width of the image [pixels]."""
    plane: int
    """Padded pixels of the image."""
    depth_origin: float
    starts: wp.array[wp.int32]
    list_surfel: wp.array[wp.int32]
    list_pair: wp.array[wp.int32]
    parameters: wp.array2d[float]
    features: wp.array2d[float]


@cache
def tile_kernel(channels: int, depth: int) -> Any:
    """Blending on the CPU, one launch index a tile.

    Args:
        depth: planes of it, here and below: none, the mean, or the mean and the median.
    """

    @wp.func_native(_source("tile_forward.h", channels, depth))
    def tile_forward(tile: int, table: TileTable, planes: wp.array2d[float], median_entry: wp.array[wp.int32]): ...

    @wp.kernel(enable_backward=False, module="unique")
    def blend_tiles(
        first: int,
        table: TileTable,
        # outputs
        planes: wp.array2d[float],
        median_entry: wp.array[wp.int32],
    ):
        tile_forward(first + wp.tid(), table, planes, median_entry)

    return blend_tiles


@cache
def tile_backward_kernel(channels: int, depth: int) -> Any:
    """Gradients on the CPU, one launch index a tile."""

    @wp.func_native(_source("tile_backward.h", channels, depth))
    def tile_backward(
        tile: int,
        table: TileTable,
        planes: wp.array2d[float],
        gradients: wp.array2d[float],
        median_entry: wp.array[wp.int32],
        pair_gradients: wp.array2d[float],
    ): ...

    @wp.kernel(enable_backward=False, module="unique")
    def blend_tiles_backward(
        first: int,
        table: TileTable,
        planes: wp.array2d[float],
        gradients: wp.array2d[float],
        median_entry: wp.array[wp.int32],
        # outputs
        pair_gradients: wp.array2d[float],
    ):
        tile_backward(first + wp.tid(), table, planes, gradients, median_entry, pair_gradients)

    return blend_tiles_backward


@wp.struct
class PixelSurfel:
    """One surfel seen through one pixel."""

    live: bool
    alpha: float
    falloff: float
    capped: bool
    plane_wins: bool
    rho_plane: float
    hx: float
    hy: float
    hz: float
    dx: float
    dy: float
    reach: float
    limited: bool
    radius: float
    z: float


@wp.func
def evaluate_surfel(parameters: wp.array2d[float], surfel: int, x_pixel: float, y_pixel: float) -> PixelSurfel:
    s = PixelSurfel()
    x = x_pixel - parameters[surfel, 9]
    y = y_pixel - parameters[surfel, 10]
    s.dx = x_pixel - parameters[surfel, 11]
    s.dy = y_pixel - parameters[surfel, 12]
    s.hx = parameters[surfel, 0] * x + parameters[surfel, 1] * y + parameters[surfel, 2]
    s.hy = parameters[surfel, 3] * x + parameters[surfel, 4] * y + parameters[surfel, 5]
    s.hz = parameters[surfel, 6] * x + parameters[surfel, 7] * y + parameters[surfel, 8]
    h2 = s.hx * s.hx + s.hy * s.hy
    hz2 = s.hz * s.hz
    front = s.hz > 0.0
    near = parameters[surfel, 18]
    if near > 0.0:
        front = front and ((parameters[surfel, 15] - near) * s.hz + parameters[surfel, 16] * s.hx + parameters[surfel, 17] * s.hy > 0.0)
    rho_screen = parameters[surfel, 24] * (s.dx * s.dx + s.dy * s.dy)
    rho_max = parameters[surfel, 14]
    s.live = (front and h2 <= rho_max * hz2) or rho_screen <= rho_max
    s.rho_plane = 1.0e30
    if front:
        s.rho_plane = h2 / (hz2 + 1.0e-30)
    s.plane_wins = s.rho_plane <= rho_screen
    s.falloff = wp.exp(-0.5 * wp.min(s.rho_plane, rho_screen))
    raw = parameters[surfel, 13] * s.falloff
    s.capped = raw >= MAX_ALPHA
    s.alpha = wp.min(MAX_ALPHA, raw)
    s.radius = wp.sqrt(h2)
    s.limited = s.radius / DEPTH_CUTOFF > wp.abs(s.hz)
    s.reach = wp.max(wp.abs(s.hz), s.radius / DEPTH_CUTOFF) + 1.0e-30
    s.z = parameters[surfel, 15] + (parameters[surfel, 16] * s.hx + parameters[surfel, 17] * s.hy) / s.reach
    return s


@cache
def pixel_kernel(channels: int, depth: int) -> Any:
    """Blending in plain Warp for any device, one launch index a pixel of the padded image."""
    feature_vector = wp.types.vector(length=channels, dtype=float)

    @wp.kernel(enable_backward=False, module="unique")
    def blend_pixels(
        first: int,
        table: TileTable,
        # outputs
        planes: wp.array2d[float],
        median_entry: wp.array[wp.int32],
    ):
        pixel = first + wp.tid()
        px = pixel % table.stride
        py = pixel / table.stride
        tile = (py / 16) * table.tiles_x + px / 16
        y_pixel = float(16 * table.first_row + py) + 0.5
        sums = feature_vector()
        coverage = float(0.0)
        transmittance = float(1.0)
        sum_z = float(0.0)
        median_z = float(0.0)
        median = int(-1)
        for entry in range(table.starts[tile], table.starts[tile + 1]):
            surfel = table.list_surfel[entry]
            s = evaluate_surfel(table.parameters, surfel, float(px) + 0.5, y_pixel)
            if s.live:
                w = s.alpha * transmittance
                for k in range(channels):
                    sums[k] = sums[k] + w * table.features[surfel, k]
                coverage = coverage + w
                z = s.z - table.depth_origin
                sum_z = sum_z + w * z
                if transmittance > 0.5:
                    median_z = s.z
                    median = entry
                transmittance = transmittance - w
                if transmittance < MIN_TRANSMITTANCE:
                    break
        for k in range(channels):
            planes[k, pixel] = sums[k]
        planes[channels, pixel] = coverage
        if wp.static(depth > 0):
            planes[channels + 1, pixel] = sum_z
        if wp.static(depth > 1):
            planes[channels + depth, pixel] = median_z
            median_entry[pixel] = median

    return blend_pixels


@cache
def pixel_backward_kernel(channels: int, depth: int) -> Any:
    """Gradients in plain Warp for any device, one launch index a pixel of the padded image.

    It adds with atomics, so on the CPU it must be launched on one thread (tests do); the CPU's own is `tile_backward_kernel`.
    """
    feature_vector = wp.types.vector(length=channels, dtype=float)

    @wp.kernel(enable_backward=False, module="unique")
    def blend_pixels_backward(
        first: int,
        table: TileTable,
        planes: wp.array2d[float],
        gradients: wp.array2d[float],
        median_entry: wp.array[wp.int32],
        # outputs
        surfel_gradients: wp.array2d[float],
    ):
        # Long because the gradient of a pixel is one walk over its surfels, whose running sums all its parts need.
        pixel = first + wp.tid()
        px = pixel % table.stride
        py = pixel / table.stride
        tile = (py / 16) * table.tiles_x + px / 16
        g = feature_vector()
        for k in range(channels):
            g[k] = gradients[k, pixel]
        # S of all that is blended with weight w, which the median is not.
        behind = float(0.0)
        for k in range(channels + 1 + min(depth, 1)):
            behind = behind + gradients[k, pixel] * planes[k, pixel]
        transmittance = float(1.0)
        for entry in range(table.starts[tile], table.starts[tile + 1]):
            surfel = table.list_surfel[entry]
            x_pixel = float(px) + 0.5
            y_pixel = float(py) + 0.5
            s = evaluate_surfel(table.parameters, surfel, x_pixel, y_pixel)
            if s.live:
                w = s.alpha * transmittance
                gf = gradients[channels, pixel]
                for k in range(channels):
                    gf = gf + g[k] * table.features[surfel, k]
                    wp.atomic_add(surfel_gradients, surfel, 16 + k, g[k] * w)
                dhx = float(0.0)
                dhy = float(0.0)
                dhz = float(0.0)
                if wp.static(depth > 0):
                    z = s.z - table.depth_origin
                    g1 = gradients[channels + 1, pixel]
                    gf = gf + g1 * z
                    dz = w * g1
                    if wp.static(depth > 1) and entry == median_entry[pixel]:
                        dz = dz + gradients[channels + depth, pixel]
                    u = s.hx / s.reach
                    v = s.hy / s.reach
                    wp.atomic_add(surfel_gradients, surfel, 12, dz * u)
                    wp.atomic_add(surfel_gradients, surfel, 13, dz * v)
                    wp.atomic_add(surfel_gradients, surfel, 14, dz)
                    du = dz * table.parameters[surfel, 16]
                    dv = dz * table.parameters[surfel, 17]
                    dreach = -(du * u + dv * v) / s.reach
                    dhx = du / s.reach
                    dhy = dv / s.reach
                    if s.limited:
                        dh = dreach / (DEPTH_CUTOFF * (s.radius + 1.0e-30))
                        dhx = dhx + dh * s.hx
                        dhy = dhy + dh * s.hy
                    else:
                        dhz = wp.where(s.hz < 0.0, -dreach, dreach)
                behind = behind - w * gf
                if not s.capped:
                    dalpha = transmittance * gf - behind / (1.0 - s.alpha)
                    wp.atomic_add(surfel_gradients, surfel, 11, dalpha * s.falloff)
                    drho = -0.5 * s.alpha * dalpha
                    if s.plane_wins:
                        scale = 2.0 * drho / (s.hz * s.hz + 1.0e-30)
                        dhx = dhx + scale * s.hx
                        dhy = dhy + scale * s.hy
                        dhz = dhz - scale * s.rho_plane * s.hz
                    else:
                        wp.atomic_add(surfel_gradients, surfel, 9, -2.0 * table.parameters[surfel, 24] * drho * s.dx)
                        wp.atomic_add(surfel_gradients, surfel, 10, -2.0 * table.parameters[surfel, 24] * drho * s.dy)
                x = x_pixel - table.parameters[surfel, 9]
                y = y_pixel - table.parameters[surfel, 10]
                wp.atomic_add(surfel_gradients, surfel, 0, dhx * x)
                wp.atomic_add(surfel_gradients, surfel, 1, dhx * y)
                wp.atomic_add(surfel_gradients, surfel, 2, dhx)
                wp.atomic_add(surfel_gradients, surfel, 3, dhy * x)
                wp.atomic_add(surfel_gradients, surfel, 4, dhy * y)
                wp.atomic_add(surfel_gradients, surfel, 5, dhy)
                wp.atomic_add(surfel_gradients, surfel, 6, dhz * x)
                wp.atomic_add(surfel_gradients, surfel, 7, dhz * y)
                wp.atomic_add(surfel_gradients, surfel, 8, dhz)
                transmittance = transmittance - w
                if transmittance < MIN_TRANSMITTANCE:
                    break

    return blend_pixels_backward
