"""What a moving picture sees, one point a pixel, as maps of the window: points in, GBuffer out.

Frames at rest add up what their passes see (frame_sums.py) and take the mean. A moving picture has one pass, which is its own mean.
"""

import torch
import warp as wp

from drgs.render.integrate.sample_rays import PointArrays, point_arrays
from drgs.render.records import GBuffer, PrimaryPoints
from drgs.render.visible.image_tiles import Window
from drgs.render.visible.rasterize.gbuffer import GBufferArrays, gbuffer_arrays
from drgs.warp_torch import launch, warp_array, warp_device

wp.set_module_options({"enable_backward": False})


@wp.kernel
def scatter_points(
    first: int,
    points: PointArrays,
    depth: wp.array[float],
    image_width: int,
    row: int,
    column: int,
    width: int,
    # outputs
    maps: GBufferArrays,
):
    i = first + wp.tid()
    y = points.pixel[i] / image_width
    at = (y - row) * width + points.pixel[i] - y * image_width - column
    maps.coverage[at] = 1.0
    maps.depth[at] = depth[i]
    maps.position[at] = points.position[i]
    maps.normal[at] = wp.normalize(points.normal[i])
    maps.wo[at] = wp.normalize(points.wo[i])
    maps.albedo[at] = points.albedo[i]
    maps.roughness[at] = points.roughness[i]
    maps.metallic[at] = points.metallic[i]


def see_middles(primary: PrimaryPoints, window: Window) -> GBuffer:
    """The maps of a window that holds all of the points, no pixel twice."""
    shape = (window.rows.stop - window.rows.start, window.columns.stop - window.columns.start)
    coverage, roughness, metallic = (primary.depth.new_zeros(shape) for _ in range(3))
    position, normal, wo, albedo = (primary.depth.new_zeros(*shape, 3) for _ in range(4))
    maps = GBuffer(coverage, primary.depth.new_full(shape, torch.inf), position, normal, wo, albedo, roughness, metallic)
    inputs = [point_arrays(primary.points), warp_array(primary.depth), window.width, window.rows.start, window.columns.start, shape[1]]
    launch(scatter_points, len(primary.depth), inputs, [gbuffer_arrays(maps)], warp_device(primary.depth))
    return maps
