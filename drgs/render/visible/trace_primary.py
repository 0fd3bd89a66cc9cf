"""What the camera sees of a mesh, by rays: one position inside each pixel a pass (box filter).

In: mesh (through its tracer), camera, seed and pass. Out: shading points with the places their rays start from, packed by pixel, or
a GBuffer. Passes of one pixel follow an Owen-scrambled Sobol sequence over its area, so edges and textures are antialiased by
accumulation. Shading normals are the interpolated vertex normals, not turned towards the camera: at a silhouette
where they face away the surface is black, as in any path tracer; the back of a triangle is not seen at all.
"""

import torch
import warp as wp
from torch import Tensor

from drgs.render.integrate.random_warp import hash_combine, sobol_2d
from drgs.render.integrate.sample_arrays import PointArrays, StartArrays, point_arrays, start_arrays
from drgs.render.intersect.mesh_surface import MeshArrays, Surface, mesh_arrays, surface_at
from drgs.render.intersect.trace_rays import build_tracer, trace_rays
from drgs.render.intersect.tracer import AbstractTracer
from drgs.render.records import GBuffer, PrimaryPoints, RayStarts, ShadingPoints
from drgs.render.visible.image_tiles import pixels_of_tiles, tiles_of_mesh
from drgs.scene.camera import Camera
from drgs.scene.mesh import TriangleMesh
from drgs.warp_torch import launch, warp_array, warp_device

wp.set_module_options({"enable_backward": False})

PRIMARY_STREAM = wp.constant(0x5EED)
"""Keeps the jitter's random numbers apart from those of the light samples."""


@wp.kernel
def primary_rays(
    first: int,
    camera_from_pixel: wp.mat33,
    world_from_camera: wp.mat33,
    center: wp.vec3,
    pixels: wp.array[int],
    rounds: wp.array[int],
    image_width: int,
    seed: wp.uint32,
    index: wp.uint32,
    jitter: float,
    # outputs
    origin: wp.array[wp.vec3],
    direction: wp.array[wp.vec3],
):
    i = first + wp.tid()
    pixel = pixels[i]
    number = index
    if rounds.shape[0] > 0:
        number = wp.uint32(rounds[i])
    x = pixel % image_width
    y = pixel // image_width
    u = sobol_2d(number, hash_combine(hash_combine(seed, wp.uint32(pixel)), wp.uint32(PRIMARY_STREAM)))
    place = wp.vec3(float(x) + 0.5 + jitter * (u[0] - 0.5), float(y) + 0.5 + jitter * (u[1] - 0.5), 1.0)
    origin[i] = center
    direction[i] = wp.normalize(world_from_camera * (camera_from_pixel * place))


@wp.func
def seen_normal(surface: Surface, arriving: wp.vec3) -> wp.vec3:
    """Seen from the back a triangle is black: a normal that faces away makes it so whatever its vertices say."""
    if wp.dot(surface.face_normal, arriving) > 0.0 and wp.dot(surface.normal, arriving) < 0.0:
        return -surface.normal
    return surface.normal


@wp.kernel
def surface_points(
    first: int,
    ray: wp.array[wp.int64],
    face: wp.array[int],
    barycentric: wp.array[wp.vec2],
    ray_direction: wp.array[wp.vec3],
    mesh: MeshArrays,
    center: wp.vec3,
    view_axis: wp.vec3,
    pixels: wp.array[int],
    # outputs
    points: PointArrays,
    starts: StartArrays,
    depth: wp.array[float],
):
    i = first + wp.tid()
    r = int(ray[i])
    surface = surface_at(mesh, face[r], barycentric[r])
    arriving = ray_direction[r]
    points.position[i] = surface.position
    points.normal[i] = seen_normal(surface, arriving)
    points.wo[i] = -arriving
    points.albedo[i] = surface.albedo
    points.roughness[i] = surface.roughness
    points.metallic[i] = surface.metallic
    points.pixel[i] = pixels[r]
    starts.surface_normal[i] = surface.face_normal
    starts.origin[i] = surface.position + mesh.lift * surface.face_normal
    depth[i] = wp.dot(surface.position - center, view_axis)


def _mat33(matrix: Tensor) -> wp.mat33:
    return wp.mat33(*matrix.detach().double().cpu().reshape(-1).tolist())


def camera_rotations(camera: Camera) -> tuple[wp.mat33, wp.mat33]:
    """camera_from_pixel, which takes (x, y, 1) of a place on the image [pixels] to a viewing direction, and world_from_camera."""
    return _mat33(torch.linalg.inv(camera.intrinsics.double())), _mat33(camera.camera_from_world[:3, :3].T)


def trace_primary_points(
    tracer: AbstractTracer,
    camera: Camera,
    seed: int,
    pass_index: int,
    jitter: bool = True,
    pixels: Tensor | None = None,
    rounds: Tensor | None = None,
) -> PrimaryPoints:
    """One ray through each pixel that may see the mesh, or through those that are listed.

    Args:
        jitter: False sends it through the pixel's centre.
        pixels: (ray,) int32; None: of all tiles that the mesh may be seen in.
        rounds: (ray,) int32, which of its pixel's places each looks through; None: place `pass_index` of all.
    """
    mesh, device = tracer.mesh, tracer.mesh.vertices.device
    if pixels is None:
        pixels = pixels_of_tiles(tiles_of_mesh(mesh, camera), camera.width, camera.height)
    ray_count = len(pixels)
    origin, direction = torch.empty(ray_count, 3, device=device), torch.empty(ray_count, 3, device=device)
    center, view_axis = wp.vec3(*camera.center_world.tolist()), wp.vec3(*camera.camera_from_world[2, :3].tolist())
    pixel_array = warp_array(pixels)
    launch(
        primary_rays,
        ray_count,
        [*camera_rotations(camera), center, pixel_array, warp_array(pixels[:0] if rounds is None else rounds), camera.width,
         wp.uint32(seed & 0xFFFFFFFF), wp.uint32(pass_index), float(jitter)],
        [warp_array(origin, wp.vec3), warp_array(direction, wp.vec3)],
        warp_device(origin),
    )  # fmt: skip
    hits = trace_rays(origin, direction, tracer)
    ray = torch.nonzero(hits.hit).squeeze(-1)
    count = len(ray)
    position, normal, wo, albedo, face_normal, start = (torch.empty(count, 3, device=device) for _ in range(6))
    roughness, metallic, depth = (torch.empty(count, device=device) for _ in range(3))
    points = ShadingPoints(position, normal, wo, albedo, roughness, metallic, torch.empty(count, dtype=torch.int32, device=device))
    starts = RayStarts(start, face_normal, hits.face[ray])
    launch(
        surface_points,
        count,
        [warp_array(ray), warp_array(hits.face), warp_array(hits.barycentric, wp.vec2), warp_array(direction, wp.vec3),
         mesh_arrays(mesh, tracer.lift), center, view_axis, pixel_array],
        [point_arrays(points), start_arrays(starts), warp_array(depth)],
        warp_device(origin),
    )  # fmt: skip
    return PrimaryPoints(points, starts, depth, hits.barycentric[ray], None if rounds is None else ray)


def trace_primary(
    mesh: TriangleMesh, camera: Camera, seed: int = 0, pass_index: int = 0, jitter: bool = False, tracer: AbstractTracer | None = None
) -> GBuffer:
    """A G-buffer of one ray a pixel; coverage is 0 or 1."""
    primary = trace_primary_points(build_tracer(mesh) if tracer is None else tracer, camera, seed, pass_index, jitter)
    points, pixel = primary.points, primary.points.pixel.long()

    def image(values: Tensor, empty: float = 0.0) -> Tensor:
        flat = torch.full((camera.height * camera.width, *values.shape[1:]), empty, device=values.device)
        flat[pixel] = values
        return flat.reshape(camera.height, camera.width, *values.shape[1:])

    return GBuffer(
        image(torch.ones_like(primary.depth)),
        image(primary.depth, torch.inf),
        image(points.position_world),
        image(points.normal_world),
        image(points.wo_world),
        image(points.albedo),
        image(points.roughness),
        image(points.metallic),
    )
