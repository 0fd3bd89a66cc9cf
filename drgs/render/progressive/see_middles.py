"""What a moving picture sees: one point a pixel, through its middle, packed and as maps of the window.

In: the mesh (through its tracer), the camera, tiles to look at. Out: Middles. Frames at rest add up what their
passes see (frame_sums.py) and take the mean. A moving picture has one pass, which is its own mean.

One kernel finds what blocks of four by four pixels see, all rays of one at once, where a tracer has a way (KernelQuery.block_fn), and what single
pixels see elsewhere; another writes both the points and the maps.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import torch
import warp as wp
from jaxtyping import Bool, Int
from torch import Tensor

from drgs.render.integrate.sample_arrays import PointArrays, StartArrays, point_arrays, start_arrays
from drgs.render.intersect.mesh_surface import MeshArrays, mesh_arrays, surface_at
from drgs.render.intersect.tracer import AbstractTracer, KernelQuery, MiddleView, middle_direction
from drgs.render.records import GBuffer, PrimaryPoints, RayStarts, ShadingPoints
from drgs.render.visible.image_tiles import TILE, Window, tile_grid, window_of_tiles
from drgs.render.visible.rasterize.gbuffer import GBufferArrays, gbuffer_arrays
from drgs.render.visible.trace_primary import camera_rotations, seen_normal
from drgs.scene.camera import Camera
from drgs.warp_torch import launch, warp_array, warp_device

wp.set_module_options({"enable_backward": False})


@dataclass(frozen=True, eq=False)
class Middles:
    """What is seen through the middles of pixels. Read by shade_moving and quick_picture."""

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


BLOCK = 4
"""Side [pixels] of what KernelQuery.block_fn sees at once."""


def _block_of_one_ray(closest_fn: Any, handle_type: Any) -> Any:
    """KernelQuery.block_fn, of one pixel, of a tracer that has none."""

    @wp.func
    def block_of_one_ray(
        tracer: handle_type,  # type: ignore[valid-type]  # known when the kernel is made
        view: MiddleView,
        x: int,
        y: int,
        face: wp.array[int],
        barycentric: wp.array[wp.vec2],
    ) -> int:
        if x >= view.image_width or y >= view.image_height:
            return 0
        hit = closest_fn(tracer, view.center, middle_direction(view, x, y), wp.inf)
        if hit.face < 0:
            return 0
        pixel = y * view.image_width + x
        face[pixel] = hit.face
        barycentric[pixel] = hit.barycentric
        return 1

    return block_of_one_ray


def block_side(query: KernelQuery) -> int:
    """Of what one index of see_blocks looks at [pixels]: tiles hold whole ones."""
    return 1 if query.block_fn is None else BLOCK


@cache
def see_blocks_kernel(query: KernelQuery) -> Any:
    """The kernel that finds what a kind of tracer sees."""
    handle_type = query.handle_type
    block_fn = _block_of_one_ray(query.closest_fn, handle_type) if query.block_fn is None else query.block_fn
    side = block_side(query)

    @wp.kernel(enable_backward=False, module="unique")
    def see_blocks(
        first: int,
        tracer: handle_type,  # type: ignore[valid-type]  # known when the kernel is made
        view: MiddleView,
        tiles: wp.array[int],
        tiles_across: int,
        # outputs
        face: wp.array[int],
        barycentric: wp.array[wp.vec2],
        shows: wp.array[wp.bool],
    ):
        i = first + wp.tid()
        across = wp.static(TILE // side)
        tile = tiles[i / (across * across)]
        block = i % (across * across)
        x = tile % tiles_across * TILE + block % across * wp.static(side)
        y = tile / tiles_across * TILE + block / across * wp.static(side)
        if block_fn(tracer, view, x, y, face, barycentric) > 0:
            shows[tile] = True  # blocks of one tile write the same

    return see_blocks


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
    arriving = middle_direction(view, x, y)
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


def see_middles(tracer: AbstractTracer, camera: Camera, tiles: Tensor) -> Middles:
    """Through the pixels of chosen tiles (tile,) bool."""
    pixels, device, view = camera.width * camera.height, tiles.device, _middle_view(camera)
    face, barycentric = torch.full((pixels,), -1, dtype=torch.int32, device=device), torch.empty(pixels, 2, device=device)
    chosen, shows = torch.nonzero(tiles).squeeze(-1).int(), torch.zeros_like(tiles)
    face_array, barycentric_array = warp_array(face), warp_array(barycentric, wp.vec2)
    inputs = [tracer.handle, view, warp_array(chosen), tile_grid(camera.width, camera.height)[0]]
    outputs = [face_array, barycentric_array, warp_array(shows)]
    query = tracer.kernel_query
    launch(see_blocks_kernel(query), len(chosen) * (TILE // block_side(query)) ** 2, inputs, outputs, warp_device(face))
    window = _window_of(shows, camera)
    place = torch.cumsum(face >= 0, 0, dtype=torch.int32)
    primary, maps = _empty_points(int(place[-1]), device), _empty_maps(window.shape, device)
    where = [window.rows.start, window.columns.start, window.shape[1]]
    inputs = [view, *where, mesh_arrays(tracer.mesh, tracer.lift), face_array, barycentric_array, warp_array(place)]
    launch(write_middles, maps.coverage.numel(), inputs, [_seen_arrays(primary), gbuffer_arrays(maps)], warp_device(face))
    return Middles(primary, shows, window, maps, window.crop(place.view(camera.height, camera.width)).contiguous())


def _window_of(shows: Tensor, camera: Camera) -> Window:
    shows[0] |= ~shows.any()  # a window is around something
    return window_of_tiles(shows, camera.width, camera.height)


def _middle_view(camera: Camera) -> Any:
    view = MiddleView()
    view.image_width, view.image_height = camera.width, camera.height
    view.camera_from_pixel, view.world_from_camera = camera_rotations(camera)
    view.center, view.axis = wp.vec3(*camera.center_world.tolist()), wp.vec3(*camera.camera_from_world[2, :3].tolist())
    return view


def _empty_points(count: int, device: torch.device) -> PrimaryPoints:
    position, normal, wo, albedo, origin, face_normal = (torch.empty(count, 3, device=device) for _ in range(6))
    roughness, metallic, depth = (torch.empty(count, device=device) for _ in range(3))
    pixel, face = (torch.empty(count, dtype=torch.int32, device=device) for _ in range(2))
    points = ShadingPoints(position, normal, wo, albedo, roughness, metallic, pixel)
    return PrimaryPoints(points, RayStarts(origin, face_normal, face), depth, torch.empty(count, 2, device=device))


def _empty_maps(shape: tuple[int, int], device: torch.device) -> GBuffer:
    coverage, depth, roughness, metallic = (torch.empty(shape, device=device) for _ in range(4))
    position, normal, wo, albedo = (torch.empty(*shape, 3, device=device) for _ in range(4))
    return GBuffer(coverage, depth, position, normal, wo, albedo, roughness, metallic)


def _seen_arrays(primary: PrimaryPoints) -> Any:
    assert primary.barycentric is not None
    arrays = SeenArrays()
    arrays.points, arrays.starts = point_arrays(primary.points), start_arrays(primary.starts)
    arrays.depth, arrays.barycentric = warp_array(primary.depth), warp_array(primary.barycentric, wp.vec2)
    return arrays
