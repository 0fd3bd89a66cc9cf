"""The G-buffer of posed surfels: material, normal and depth maps divided by coverage (Eq. 2 of the paper).

What comes before and after blending is written twice: in torch, where somebody asks for gradients, and as two kernels where nobody
does, which is every frame that is shown. A test compares the two.
"""

from typing import Any

import torch
import warp as wp
from torch import Tensor

from drgs.maths.constants import MIN_COVERAGE
from drgs.render.records import GBuffer
from drgs.render.visible.image_tiles import TILE, window_of_tiles
from drgs.render.visible.rasterize.near_plane import near_plane_of
from drgs.render.visible.rasterize.rasterize import RasterSettings, rasterize
from drgs.scene.camera import Camera, pixel_rays_world, world_from_pixel
from drgs.scene.posed_scene import PosedSurfels
from drgs.warp_torch import launch, warp_array, warp_device, warp_view

wp.set_module_options({"enable_backward": False})

SEEN_FROM_BEHIND = 0.3
"""Cosine between a surfel's normal and the viewing ray above which the surfel is taken to show its back."""
LEAST_FACING = 0.02
"""Blended normals face the camera at least by this cosine."""


@wp.struct
class PixelView:
    """The camera, as pixels look through it."""

    width: int
    top: int
    """Row of the image with which the G-buffer begins."""
    ray_from_pixel: wp.mat33
    """World directions of pixel-homogeneous places."""
    center: wp.vec3
    axis: wp.vec3
    """Unit viewing axis [world]."""
    depth_origin: float


@wp.struct
class GBufferArrays:
    """GBuffer as the kernel writes it, row-major."""

    coverage: wp.array[float]
    depth: wp.array[float]
    position: wp.array[wp.vec3]
    normal: wp.array[wp.vec3]
    wo: wp.array[wp.vec3]
    albedo: wp.array[wp.vec3]
    roughness: wp.array[float]
    metallic: wp.array[float]


@wp.kernel
def write_features(
    first: int,
    center: wp.array[wp.vec3],
    tangents: wp.array2d[float],
    albedo: wp.array[wp.vec3],
    roughness: wp.array[float],
    metallic: wp.array[float],
    camera_center: wp.vec3,
    # outputs
    features: wp.array2d[float],
):
    i = first + wp.tid()
    across = wp.vec3(tangents[i, 0], tangents[i, 2], tangents[i, 4])
    down = wp.vec3(tangents[i, 1], tangents[i, 3], tangents[i, 5])
    normal = wp.normalize(wp.cross(across, down))
    if wp.dot(normal, wp.normalize(center[i] - camera_center)) > SEEN_FROM_BEHIND:
        normal = -normal
    base = albedo[i]
    for k in range(3):
        features[i, k] = normal[k]
        features[i, 3 + k] = base[k]
    features[i, 6] = roughness[i]
    features[i, 7] = metallic[i]


@wp.kernel
def write_gbuffer(
    first: int,
    view: PixelView,
    feature_sum: wp.array3d[float],
    coverage_sum: wp.array2d[float],
    depth_sum: wp.array2d[float],
    # outputs
    gbuffer: GBufferArrays,
):
    i = first + wp.tid()
    y = i // view.width
    x = i - y * view.width
    direction = wp.normalize(view.ray_from_pixel * wp.vec3(float(x) + 0.5, float(view.top + y) + 0.5, 1.0))
    gbuffer.wo[i] = -direction
    share = coverage_sum[y, x]
    gbuffer.coverage[i] = share
    if not (share >= MIN_COVERAGE):
        nowhere = wp.vec3(0.0, 0.0, 0.0)
        gbuffer.depth[i] = wp.inf
        gbuffer.position[i] = nowhere
        gbuffer.normal[i] = nowhere
        gbuffer.albedo[i] = nowhere
        gbuffer.roughness[i] = 0.0
        gbuffer.metallic[i] = 0.0
        return
    inverse = 1.0 / share
    along = depth_sum[y, x] * inverse + view.depth_origin
    gbuffer.depth[i] = along
    gbuffer.position[i] = view.center + direction * (along / wp.dot(direction, view.axis))
    unit = wp.normalize(wp.vec3(feature_sum[0, y, x], feature_sum[1, y, x], feature_sum[2, y, x]) * inverse)
    lacking = wp.max(LEAST_FACING + wp.dot(unit, direction), 0.0)
    gbuffer.normal[i] = wp.normalize(unit - lacking * direction)
    red = wp.clamp(feature_sum[3, y, x] * inverse, 0.0, 1.0)
    green = wp.clamp(feature_sum[4, y, x] * inverse, 0.0, 1.0)
    blue = wp.clamp(feature_sum[5, y, x] * inverse, 0.0, 1.0)
    gbuffer.albedo[i] = wp.vec3(red, green, blue)
    gbuffer.roughness[i] = wp.clamp(feature_sum[6, y, x] * inverse, 0.0, 1.0)
    gbuffer.metallic[i] = wp.clamp(feature_sum[7, y, x] * inverse, 0.0, 1.0)


def facing_normals(normals: Tensor, centers: Tensor, camera: Camera) -> Tensor:
    """(surfel, 3) normals to blend: turned round where the camera clearly sees the back.

    Surfels of a closed surface point outward, and near an outline some tip away from the camera by a few degrees. Turned round one by one
    they would spoil the blended normal there; left alone they average to the outline's own. `face_camera` then bends what is left.
    """
    with torch.no_grad():
        to_surfel = torch.nn.functional.normalize(centers - camera.center_world, dim=-1)
        sign = torch.where((normals * to_surfel).sum(-1, keepdim=True) > SEEN_FROM_BEHIND, -1.0, 1.0)
    return normals * sign


def face_camera(normals: Tensor, wo: Tensor) -> Tensor:
    """(..., 3) unit normals of blended (..., 3), bent towards wo as little as makes their cosine LEAST_FACING; differentiable."""
    # Blended maps lie plane by plane, and torch's norm of such vectors takes forty times as long.
    unit = torch.nn.functional.normalize(normals.contiguous(), dim=-1)
    lacking = (LEAST_FACING - (unit * wo).sum(-1, keepdim=True)).clamp(min=0)
    return torch.nn.functional.normalize(unit + lacking * wo, dim=-1)


def rasterize_gbuffer(surfels: PosedSurfels, camera: Camera, settings: RasterSettings | None = None, band: slice | None = None) -> GBuffer:
    """What the camera sees of the surfels.

    Depth is the expected one; the shaded point lies on the pixel's ray at that depth. Where nothing is met: depth inf, the rest 0.

    Args:
        settings: None: the near plane follows the surfels' span.
        band: rows of the image, from a tile's edge to a tile's edge, that the maps are to hold; None: all, and only then differentiable.
    """
    settings = settings or RasterSettings(near=near_plane_of(surfels.centers))
    device, materials = surfels.centers.device, surfels.materials
    given = (surfels.centers, surfels.tangents, surfels.opacities, *vars(materials).values(), camera.camera_from_world, camera.intrinsics)
    if torch.is_grad_enabled() and any(values.requires_grad for values in given):
        return differentiable_gbuffer(surfels, camera, settings)
    warp, center = warp_device(surfels.centers), wp.vec3(*camera.center_world.tolist())
    features = torch.empty(len(surfels.centers), 8, device=device)
    launch(
        write_features,
        len(features),
        [warp_array(surfels.centers, wp.vec3), warp_array(surfels.tangents.reshape(-1, 6)), warp_array(materials.albedo, wp.vec3),
         warp_array(materials.roughness), warp_array(materials.metallic), center],
        [warp_array(features)],
        warp,
    )  # fmt: skip
    maps = rasterize(surfels.centers, surfels.tangents, surfels.opacities, features, camera, settings, band=band)
    assert maps.depth_sum is not None
    rows = slice(0, camera.height) if band is None else band
    size = (rows.stop - rows.start, camera.width)
    coverage, depth, roughness, metallic = (torch.empty(size, device=device) for _ in range(4))
    position, normal, wo, albedo = (torch.empty(*size, 3, device=device) for _ in range(4))
    gbuffer = GBuffer(coverage, depth, position, normal, wo, albedo, roughness, metallic)
    sums = [warp_view(values) for values in (maps.features, maps.coverage, maps.depth_sum)]
    inputs = [_pixel_view(camera, rows.start, maps.depth_origin), *sums]
    launch(write_gbuffer, size[0] * size[1], inputs, [gbuffer_arrays(gbuffer)], warp)
    return gbuffer


def _pixel_view(camera: Camera, top: int, depth_origin: float) -> Any:
    view = PixelView()
    view.width, view.top, view.depth_origin = camera.width, top, depth_origin
    view.ray_from_pixel = wp.mat33(*world_from_pixel(camera).flatten().tolist())
    view.center, view.axis = wp.vec3(*camera.center_world.tolist()), wp.vec3(*camera.camera_from_world[2, :3].tolist())
    return view


def gbuffer_arrays(gbuffer: GBuffer) -> Any:
    """Its memory, for kernels to write."""
    arrays = GBufferArrays()
    arrays.coverage, arrays.depth = warp_array(gbuffer.coverage.view(-1)), warp_array(gbuffer.depth.view(-1))
    arrays.position = warp_array(gbuffer.position_world.view(-1, 3), wp.vec3)
    arrays.normal = warp_array(gbuffer.normal_world.view(-1, 3), wp.vec3)
    arrays.wo = warp_array(gbuffer.wo_world.view(-1, 3), wp.vec3)
    arrays.albedo = warp_array(gbuffer.albedo.view(-1, 3), wp.vec3)
    arrays.roughness, arrays.metallic = warp_array(gbuffer.roughness.view(-1)), warp_array(gbuffer.metallic.view(-1))
    return arrays


def differentiable_gbuffer(surfels: PosedSurfels, camera: Camera, settings: RasterSettings) -> GBuffer:
    """rasterize_gbuffer in torch, whose gradients reach surfels and materials; the twin of its kernels."""
    materials = surfels.materials
    crosses = torch.linalg.cross(surfels.tangents[:, :, 0], surfels.tangents[:, :, 1])
    normals = facing_normals(torch.nn.functional.normalize(crosses, dim=-1, eps=1e-20), surfels.centers, camera)
    features = torch.cat([normals, materials.albedo, materials.roughness[:, None], materials.metallic[:, None]], -1)
    maps = rasterize(surfels.centers, surfels.tangents, surfels.opacities, features, camera, settings)
    assert maps.depth_sum is not None, "a G-buffer needs RasterSettings.depth"
    # What lies around the tiles that show something is empty, and most of many pictures.
    window = window_of_tiles(_tiles_with_any(maps.coverage.detach() >= MIN_COVERAGE), camera.width, camera.height)
    coverage = window.crop(maps.coverage)
    covered = coverage >= MIN_COVERAGE
    inverse = torch.where(covered, 1 / coverage.clamp(min=MIN_COVERAGE), torch.zeros_like(coverage))
    normalised = (maps.features[:, window.rows, window.columns] * inverse).permute(1, 2, 0)
    depth = torch.where(covered, window.crop(maps.depth_sum) * inverse + maps.depth_origin, torch.full_like(inverse, torch.inf))
    origin, all_directions = pixel_rays_world(camera)
    directions = window.crop(all_directions)
    along_axis = directions @ camera.camera_from_world[2, :3]
    position = (origin + directions * (torch.where(covered, depth, torch.zeros_like(depth)) / along_axis)[..., None]) * covered[..., None]
    return GBuffer(
        coverage=maps.coverage,
        depth=window.pad(depth, torch.inf),
        position_world=window.pad(position),
        normal_world=window.pad(face_camera(normalised[..., :3], -directions) * covered[..., None]),
        wo_world=-all_directions,
        albedo=window.pad(normalised[..., 3:6].clamp(0, 1)),
        roughness=window.pad(normalised[..., 6].clamp(0, 1)),
        metallic=window.pad(normalised[..., 7].clamp(0, 1)),
    )


def _tiles_with_any(mask: Tensor) -> Tensor:
    """(tile,) bool: whether a tile of the image (height, width) has a True; the first if none has."""
    height, width = mask.shape
    padded = torch.nn.functional.pad(mask, (0, -width % TILE, 0, -height % TILE))
    tiles = padded.unflatten(0, (-1, TILE)).unflatten(2, (-1, TILE)).any(3).any(1).flatten()
    if not bool(tiles.any()):
        tiles[0] = True
    return tiles
