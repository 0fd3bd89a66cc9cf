"""What a moving picture sees: one point a pixel, through its middle, packed and as maps of the window.

In: the mesh (through its tracer), the camera, tiles to look at. Out: Middles. Frames at rest add up what their
passes see (frame_sums.py) and take the mean. A moving picture has one pass, which is its own mean.

Where Embree traces, it takes the rays of four by four pixels at once (see_sixteen_middles.h), and one kernel writes both the points and the maps.
Elsewhere the points are those of trace_primary.py.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import warp as wp
from jaxtyping import Bool, Int
from torch import Tensor

from drgs.render.integrate.sample_rays import PointArrays, StartArrays, point_arrays, start_arrays
from drgs.render.intersect.embree_library import function_address
from drgs.render.intersect.mesh_surface import MeshArrays, mesh_arrays, surface_at
from drgs.render.intersect.tracer import AbstractTracer
from drgs.render.intersect.tracer_embree import EmbreeHandles, EmbreeTracer
from drgs.render.native_source import native_source
from drgs.render.records import GBuffer, PrimaryPoints, RayStarts, ShadingPoints
from drgs.render.visible.image_tiles import TILE, Window, pixels_of_tiles, tile_grid, tile_of_pixels, window_of_tiles
from drgs.render.visible.rasterize.gbuffer import GBufferArrays, gbuffer_arrays
from drgs.render.visible.trace_primary import camera_rotations, seen_normal, trace_primary_points
from drgs.scene.camera import Camera
from drgs.warp_torch import launch, warp_array, warp_device

wp.set_module_options({"enable_backward": False})


@dataclass(frozen=True, eq=False)
class Middles:
    """What is seen through the middles of pixels. Read by shade_moving and moving_picture."""

    primary: PrimaryPoints
    """Packed, by pixel."""
    tiles: Bool[Tensor, "tile"]
    """Those that show something; at least one."""
    window: Window
    """Around these."""
    surface: GBuffer
    """Of the window."""
    place: Int[Tensor, "rows columns"]
    """int32; of each pixel of the window its point's number and one; means nothing where nothing is covered."""


@wp.struct
class MiddleView:
    """A camera."""

    image_width: int
    image_height: int
    tiles_across: int
    camera_from_pixel: wp.mat33
    world_from_camera: wp.mat33
    center: wp.vec3
    axis: wp.vec3
    """Unit viewing axis [world]."""


@wp.func_native(native_source(Path(__file__).with_name("see_sixteen_middles.h")))
def see_sixteen_middles(
    embree: EmbreeHandles, intersect_sixteen_fn: wp.uint64, view: MiddleView, x: int, y: int,
    face: wp.array[int], barycentric: wp.array[wp.vec2],
) -> wp.int32: ...  # fmt: skip


@wp.kernel
def trace_tiles(
    first: int,
    embree: EmbreeHandles,
    intersect_sixteen_fn: wp.uint64,
    view: MiddleView,
    tiles: wp.array[int],
    # outputs
    face: wp.array[int],
    barycentric: wp.array[wp.vec2],
    shows: wp.array[wp.bool],
):
    tile = tiles[first + wp.tid()]
    x = tile % view.tiles_across * TILE
    y = tile // view.tiles_across * TILE
    seen = wp.int32(0)
    for block in range(16):
        seen += see_sixteen_middles(embree, intersect_sixteen_fn, view, x + 4 * (block % 4), y + 4 * (block // 4), face, barycentric)
    shows[tile] = seen > 0


@wp.struct
class SeenArrays:
    """PrimaryPoints as the kernel writes them."""

    points: PointArrays
    starts: StartArrays
    depth: wp.array[float]
    barycentric: wp.array[wp.vec2]


@wp.kernel
def write_middles(
    first: int,
    view: MiddleView,
    row: int,
    column: int,
    width: int,
    mesh: MeshArrays,
    face: wp.array[int],
    barycentric: wp.array[wp.vec2],
    place: wp.array[int],
    # outputs
    seen: SeenArrays,
    maps: GBufferArrays,
):
    i = first + wp.tid()
    y = row + i // width
    x = column + i % width
    pixel = y * view.image_width + x
    if face[pixel] < 0:
        nothing = wp.vec3(0.0, 0.0, 0.0)
        maps.coverage[i] = 0.0
        maps.depth[i] = wp.inf
        maps.position[i] = nothing
        maps.normal[i] = nothing
        maps.wo[i] = nothing
        maps.albedo[i] = nothing
        maps.roughness[i] = 0.0
        maps.metallic[i] = 0.0
        return
    arriving = wp.normalize(view.world_from_camera * (view.camera_from_pixel * wp.vec3(float(x) + 0.5, float(y) + 0.5, 1.0)))
    surface = surface_at(mesh, face[pixel], barycentric[pixel])
    normal = seen_normal(surface, arriving)
    depth = wp.dot(surface.position - view.center, view.axis)
    maps.coverage[i] = 1.0
    maps.depth[i] = depth
    maps.position[i] = surface.position
    maps.normal[i] = normal
    maps.wo[i] = -arriving
    maps.albedo[i] = surface.albedo
    maps.roughness[i] = surface.roughness
    maps.metallic[i] = surface.metallic
    p = place[pixel] - 1
    seen.points.position[p] = surface.position
    seen.points.normal[p] = normal
    seen.points.wo[p] = -arriving
    seen.points.albedo[p] = surface.albedo
    seen.points.roughness[p] = surface.roughness
    seen.points.metallic[p] = surface.metallic
    seen.points.pixel[p] = pixel
    seen.starts.origin[p] = surface.position + mesh.lift * surface.face_normal
    seen.starts.surface_normal[p] = surface.face_normal
    seen.starts.face[p] = face[pixel]
    seen.depth[p] = depth
    seen.barycentric[p] = barycentric[pixel]


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
    maps.normal[at] = points.normal[i]
    maps.wo[at] = points.wo[i]
    maps.albedo[at] = points.albedo[i]
    maps.roughness[at] = points.roughness[i]
    maps.metallic[at] = points.metallic[i]


def see_middles(tracer: AbstractTracer, camera: Camera, tiles: Tensor) -> Middles:
    """Through the pixels of chosen tiles (tile,) bool."""
    return see_by_sixteens(tracer, camera, tiles) if isinstance(tracer, EmbreeTracer) else see_by_points(tracer, camera, tiles)


def see_by_points(tracer: AbstractTracer, camera: Camera, tiles: Tensor) -> Middles:
    """The same by any tracer."""
    primary = trace_primary_points(tracer, camera, 0, 0, jitter=False, pixels=pixels_of_tiles(tiles, camera.width, camera.height))
    shows = torch.zeros_like(tiles)
    shows[tile_of_pixels(primary.points.pixel, camera.width)] = True
    window = _window_of(shows, camera)
    shape = window.shape
    coverage, roughness, metallic = (primary.depth.new_zeros(shape) for _ in range(3))
    position, normal, wo, albedo = (primary.depth.new_zeros(*shape, 3) for _ in range(4))
    maps = GBuffer(coverage, primary.depth.new_full(shape, torch.inf), position, normal, wo, albedo, roughness, metallic)
    inputs = [point_arrays(primary.points), warp_array(primary.depth), window.width, window.rows.start, window.columns.start, shape[1]]
    launch(scatter_points, len(primary.depth), inputs, [gbuffer_arrays(maps)], warp_device(primary.depth))
    return Middles(primary, shows, window, maps, torch.cumsum(coverage.view(-1) > 0, 0, dtype=torch.int32).view(shape))


def see_by_sixteens(tracer: EmbreeTracer, camera: Camera, tiles: Tensor) -> Middles:
    """The same on the CPU, sixteen rays at once."""
    pixels, view = camera.width * camera.height, _middle_view(camera)
    face, barycentric, shows = torch.full((pixels,), -1, dtype=torch.int32), torch.empty(pixels, 2), torch.zeros_like(tiles)
    chosen = torch.nonzero(tiles).squeeze(-1).int()
    face_array, barycentric_array = warp_array(face), warp_array(barycentric, wp.vec2)
    inputs = [tracer.handle, wp.uint64(function_address("rtcIntersect16")), view, warp_array(chosen)]
    launch(trace_tiles, len(chosen), inputs, [face_array, barycentric_array, warp_array(shows)], "cpu")
    window = _window_of(shows, camera)
    place = torch.cumsum(face >= 0, 0, dtype=torch.int32)
    primary, maps = _empty_points(int(place[-1])), _empty_maps(window.shape)
    where = [window.rows.start, window.columns.start, window.shape[1]]
    inputs = [view, *where, mesh_arrays(tracer.mesh, tracer.lift), face_array, barycentric_array, warp_array(place)]
    launch(write_middles, maps.coverage.numel(), inputs, [_seen_arrays(primary), gbuffer_arrays(maps)], "cpu")
    return Middles(primary, shows, window, maps, window.crop(place.view(camera.height, camera.width)).contiguous())


def _window_of(shows: Tensor, camera: Camera) -> Window:
    shows[0] |= ~shows.any()  # a window is around something
    return window_of_tiles(shows, camera.width, camera.height)


def _middle_view(camera: Camera) -> Any:
    view = MiddleView()
    view.image_width, view.image_height = camera.width, camera.height
    view.tiles_across = tile_grid(camera.width, camera.height)[0]
    view.camera_from_pixel, view.world_from_camera = camera_rotations(camera)
    view.center, view.axis = wp.vec3(*camera.center_world.tolist()), wp.vec3(*camera.camera_from_world[2, :3].tolist())
    return view


def _empty_points(count: int) -> PrimaryPoints:
    position, normal, wo, albedo, origin, face_normal = (torch.empty(count, 3) for _ in range(6))
    roughness, metallic, depth = (torch.empty(count) for _ in range(3))
    pixel, face = (torch.empty(count, dtype=torch.int32) for _ in range(2))
    points = ShadingPoints(position, normal, wo, albedo, roughness, metallic, pixel)
    return PrimaryPoints(points, RayStarts(origin, face_normal, face), depth, torch.empty(count, 2))


def _empty_maps(shape: tuple[int, int]) -> GBuffer:
    coverage, depth, roughness, metallic = (torch.empty(shape) for _ in range(4))
    position, normal, wo, albedo = (torch.empty(*shape, 3) for _ in range(4))
    return GBuffer(coverage, depth, position, normal, wo, albedo, roughness, metallic)


def _seen_arrays(primary: PrimaryPoints) -> Any:
    assert primary.barycentric is not None
    arrays = SeenArrays()
    arrays.points, arrays.starts = point_arrays(primary.points), start_arrays(primary.starts)
    arrays.depth, arrays.barycentric = warp_array(primary.depth), warp_array(primary.barycentric, wp.vec2)
    return arrays
