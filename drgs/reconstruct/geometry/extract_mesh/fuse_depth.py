"""Fuse depth maps into a truncated signed distance field on a grid of voxels; the narrow band only.

In: depth maps and a box. Out: `DistanceField`, in truncation distances, positive outside, -1 or +1 off the band.

A coarse pass classifies every 8th grid point; the fine pass visits only blocks of 8x8x8 points that hold a depth sample,
touch such a block, or lie where the coarse sign changes. Per view and point, after Curless and Levoy 1996, with three
changes: distance is measured along the pixel's normal instead of the viewing axis (the field then has slope 1 however
oblique the view); pixels that show background count as distance to the silhouette, so the outline is carved smoothly;
and points that nobody sees are inside, so the surface closes under the object and in deep hollows.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
import warp as wp
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from drgs.reconstruct.geometry.extract_mesh.records import DepthMap, MeshSettings
from drgs.scene.camera import Camera
from drgs.warp_torch import launch, thread_pool, warp_array, warp_device

wp.set_module_options({"enable_backward": False})

BLOCK = 8
"""Grid points along a block's edge; also the step of the coarse pass."""
BATCH_BYTES = 192 * 2**20
"""Views are fused in batches whose pixels take at most this much memory."""
GRAZING_COSINE = 0.1
"""Normals more oblique than this are treated as this: their depth says little, and distance must not collapse to zero."""
SILHOUETTE_REACH = 16.0
"""[pixels] distances to the silhouette are capped here."""
SILHOUETTE_RAMP = 3.0
"""[pixels] inside the silhouette over which a pixel's weight rises to one: rendered depth is poor at the rim."""


@dataclass(frozen=True, eq=False)
class DistanceField:
    """Written by fuse_depth, read by extract_mesh. Point (i, j, k) of `values` lies at origin + voxel_size * (i, j, k)."""

    values: Float[Tensor, "x y z"]
    """Signed distance over truncation, clamped to [-1, 1], positive outside. The outermost layer is 1."""
    origin: Float[Tensor, "3"]
    """World position of point (0, 0, 0)."""
    voxel_size: float
    """[world units]"""


@wp.struct
class ViewPixels:
    """Views of one image size."""

    count: int
    height: int
    width: int
    pixel_from_world: wp.array[wp.vec4]
    """Three rows a view."""
    pixel_size: wp.array[float]
    """Of each view: width of a pixel at depth 1."""
    pixels: wp.array[wp.vec4]
    """(1/depth, normal factor, weight, silhouette distance), depth 0 for none; views one after the other."""


@wp.kernel
def integrate_rows(
    first: int,
    views: ViewPixels,
    row_origin: wp.array[wp.vec3],
    spacing: float,
    truncation: float,
    soft_band: float,
    # outputs
    weighted_distance: wp.array2d[float],
    weight_sum: wp.array2d[float],
    free_views: wp.array2d[float],
    seen_views: wp.array2d[float],
):
    """One thread a row of BLOCK points along z."""
    row = first + wp.tid()
    for view in range(views.count):
        px = views.pixel_from_world[3 * view]
        py = views.pixel_from_world[3 * view + 1]
        pz = views.pixel_from_world[3 * view + 2]
        for k in range(BLOCK):
            p = row_origin[row]
            x4 = wp.vec4(p[0], p[1], p[2] + spacing * float(k), 1.0)
            z = wp.dot(pz, x4)
            if z > 0.0:
                u = wp.dot(px, x4) / z - 0.5
                v = wp.dot(py, x4) / z - 0.5
                if u >= 0.0 and v >= 0.0 and u < float(views.width - 1) and v < float(views.height - 1):
                    i = int(u)
                    j = int(v)
                    fu = u - float(i)
                    fv = v - float(j)
                    base = (view * views.height + j) * views.width + i
                    seen_views[row, k] = seen_views[row, k] + 1.0
                    inverse_near = float(0.0)
                    inverse_far = float(1.0e30)
                    total = float(0.0)
                    mean = wp.vec4(0.0, 0.0, 0.0, 0.0)
                    silhouette = float(0.0)
                    for corner in range(4):
                        cu = corner % 2
                        cv = corner // 2
                        pixel = views.pixels[base + cv * views.width + cu]
                        share = wp.where(cu == 1, fu, 1.0 - fu) * wp.where(cv == 1, fv, 1.0 - fv)
                        silhouette += share * pixel[3]
                        if pixel[0] > 0.0:
                            inverse_near = wp.max(inverse_near, pixel[0])
                            inverse_far = wp.min(inverse_far, pixel[0])
                            total += share
                            mean += share * pixel
                    if silhouette < 0.0:
                        # Background: at least as far outside as the silhouette is away in the image.
                        distance = -silhouette * z * views.pixel_size[view]
                        strength = wp.min(1.0, 0.25 - silhouette / SILHOUETTE_RAMP)
                        weighted_distance[row, k] = weighted_distance[row, k] + strength * wp.min(1.0, distance / truncation)
                        weight_sum[row, k] = weight_sum[row, k] + strength
                        free_views[row, k] = free_views[row, k] + 1.0
                    elif total > 0.0:
                        mean = mean / total
                        near = 1.0 / inverse_near
                        if 1.0 / inverse_far - near <= 2.0 * truncation:
                            # 1/depth is linear across the image of a plane: interpolating it is exact there.
                            distance = (1.0 / mean[0] - z) * mean[1]
                            if distance > -truncation:
                                # Fade out behind the surface, where another sheet of a thin part may lie.
                                fade = wp.min(1.0, (distance + truncation) / (truncation - soft_band))
                                strength = mean[2] * fade
                                weighted_distance[row, k] = weighted_distance[row, k] + strength * wp.min(1.0, distance / truncation)
                                weight_sum[row, k] = weight_sum[row, k] + strength
                                if distance > 0.0:
                                    free_views[row, k] = free_views[row, k] + 1.0
                        elif z < near - truncation:
                            # Across a depth edge nothing is interpolated, but what lies before both sides is free.
                            weighted_distance[row, k] = weighted_distance[row, k] + mean[2]
                            weight_sum[row, k] = weight_sum[row, k] + mean[2]
                            free_views[row, k] = free_views[row, k] + 1.0


def fuse_depth(
    depth_maps: Sequence[DepthMap], bounds_center: Float[Tensor, "3"], bounds_radius: float, settings: MeshSettings
) -> DistanceField:
    """Distance field of the box bounds_center ± bounds_radius, padded by the truncation and cropped to what is occupied.

    Raises:
        ValueError: no depth map, or no pixel of any depth map falls into the box.
    """
    if not depth_maps:
        raise ValueError("mesh extraction got no depth maps; expected at least one")
    device = depth_maps[0].depth.device
    voxel = settings.voxel_size or 2.0 * bounds_radius / settings.resolution
    truncation = settings.truncation_voxels * voxel
    half = bounds_radius + truncation + 2 * voxel
    block_count = math.ceil((2 * half / voxel + 1) / BLOCK)
    center = bounds_center.to(device=device, dtype=torch.float32)
    origin = center - 0.5 * voxel * (block_count * BLOCK - 1)
    band = blocks_near_samples(depth_maps, origin, voxel, block_count, settings.truncation_voxels)
    if not band.any():
        raise ValueError(
            f"no depth sample lies within {bounds_radius:g} of {[round(c, 4) for c in center.tolist()]}; check the bounds and the depth maps"
        )

    # The coarse pass: the corners of all blocks, as blocks of a grid that is BLOCK times coarser.
    batches = pack_views(depth_maps)
    coarse_count = math.ceil((block_count + 1) / BLOCK)
    every_block = torch.cartesian_prod(*[torch.arange(coarse_count, device=device)] * 3)
    coarse = integrate_blocks(batches, every_block, origin, voxel * BLOCK, truncation, voxel, settings)
    corners = dense_from_blocks(every_block, coarse, coarse_count)[: block_count + 1, : block_count + 1, : block_count + 1]
    outside = corners > 0
    # Where nobody saw a surface the sign can still change: there the outline alone closes the object.
    mixed = sign_changes(outside)
    active = band | mixed | dilate(mixed & ~band, 1)
    blocks = active.nonzero()
    low, high = blocks.amin(0), blocks.amax(0) + 1
    fine = integrate_blocks(batches, blocks, origin, voxel, truncation, voxel, settings)

    # Off the band the block's first corner has the sign of all its points.
    a, b = low.tolist(), high.tolist()
    block_sign = torch.where(outside[a[0] : b[0], a[1] : b[1], a[2] : b[2]], 1.0, -1.0)
    tiles = block_sign[:, :, :, None, None, None].expand(*block_sign.shape, BLOCK, BLOCK, BLOCK).clone()
    shifted = blocks - low
    tiles[shifted[:, 0], shifted[:, 1], shifted[:, 2]] = fine
    nx, ny, nz = (BLOCK * n for n in block_sign.shape)
    values = tiles.permute(0, 3, 1, 4, 2, 5).reshape(nx, ny, nz)
    for axis in range(3):
        values.select(axis, 0).fill_(1.0)
        values.select(axis, -1).fill_(1.0)
    return DistanceField(values, origin + voxel * BLOCK * low.to(torch.float32), voxel)


@dataclass(frozen=True, eq=False)
class PackedViews:
    """Views of one image size, laid out for the kernel."""

    views: list[DepthMap]
    pixels: Float[Tensor, "view height width 4"] | None
    """As `packed_pixels` gives them; None: too large to keep, made anew for each pass."""


def pack_views(depth_maps: Sequence[DepthMap]) -> list[PackedViews]:
    """Runs of views of one image size whose pixels fit BATCH_BYTES; a single run is packed once and kept for both passes."""
    batches: list[list[DepthMap]] = []
    for view in depth_maps:
        last = batches[-1] if batches else None
        if last is None or last[0].depth.shape != view.depth.shape or (len(last) + 1) * view.depth.numel() * 16 > BATCH_BYTES:
            batches.append([])
        batches[-1].append(view)
    if len(batches) == 1:
        return [PackedViews(batches[0], stack_pixels(batches[0]))]
    return [PackedViews(batch, None) for batch in batches]


def stack_pixels(views: list[DepthMap]) -> Float[Tensor, "view height width 4"]:
    """(view, height, width, 4)"""
    return torch.stack(list(thread_pool().map(packed_pixels, views)))


def has_depth(view: DepthMap) -> Bool[Tensor, "height width"]:
    """(height, width) bool: a finite positive depth in a covered pixel."""
    return torch.isfinite(view.depth) & (view.depth > 0) & (view.coverage >= 0.5)


def camera_rays(camera: Camera, shape: tuple[int, ...], device: torch.device) -> Float[Tensor, "height width 3"]:
    """(height, width, 3) directions through pixel centres in camera space, with z = 1."""
    y = torch.arange(shape[0], device=device, dtype=torch.float32) + 0.5
    x = torch.arange(shape[1], device=device, dtype=torch.float32) + 0.5
    k_inverse = torch.linalg.inv(camera.intrinsics.to(device))
    grid = torch.stack([x.expand(shape[0], -1), y[:, None].expand(-1, shape[1]), torch.ones(shape, device=device)], -1)
    return grid @ k_inverse.T


def blocks_near_samples(
    depth_maps: Sequence[DepthMap], origin: Float[Tensor, "3"], voxel: float, block_count: int, reach_voxels: float
) -> Bool[Tensor, "block block block"]:
    """(block, block, block) bool: blocks within `reach_voxels` of some pixel's surface point; a few further ones too."""
    # Half blocks first: dilating those by the band wastes less than dilating whole blocks.
    half_block = BLOCK // 2
    count = 2 * block_count
    occupied = torch.zeros(count**3, dtype=torch.bool, device=origin.device)
    for view in depth_maps:
        valid = has_depth(view)
        points = camera_rays(view.camera, view.depth.shape, origin.device)[valid] * view.depth[valid][:, None]
        camera_from_world = view.camera.camera_from_world.to(origin.device)
        world = (points - camera_from_world[:3, 3]) @ camera_from_world[:3, :3]
        index = torch.floor((world - origin) / (half_block * voxel)).long()
        index = index[((index >= 0) & (index < count)).all(-1)]
        occupied[(index[:, 0] * count + index[:, 1]) * count + index[:, 2]] = True
    near = dilate(occupied.reshape(count, count, count), math.ceil(reach_voxels / half_block))
    return torch.nn.functional.max_pool3d(near.float()[None, None], 2)[0, 0] > 0


def dilate(mask: Bool[Tensor, "n n n"], steps: int) -> Bool[Tensor, "n n n"]:
    """(n, n, n) bool: true within `steps` cells along each axis of a true cell."""
    return torch.nn.functional.max_pool3d(mask.float()[None, None], 2 * steps + 1, stride=1, padding=steps)[0, 0] > 0


def sign_changes(outside: Bool[Tensor, "n n n"]) -> Bool[Tensor, "n-1 n-1 n-1"]:
    """(n, n, n) bool of (n+1, n+1, n+1) corners: blocks whose corners do not agree."""
    blocks = outside.float()[None, None]
    return (torch.nn.functional.avg_pool3d(blocks, 2, stride=1)[0, 0] % 1.0) != 0


def packed_pixels(view: DepthMap) -> Float[Tensor, "height width 4"]:
    """(height, width, 4): 1/depth (0 for none), distance along the normal per unit of depth, weight, signed silhouette distance [pixels]."""
    valid = has_depth(view)
    device = view.depth.device
    depth = torch.where(valid, view.depth, torch.zeros_like(view.depth))
    rays = camera_rays(view.camera, depth.shape, device)
    if view.normal_world is not None:
        normal = view.normal_world @ view.camera.camera_from_world[:3, :3].to(device).T
        known = valid & (normal.norm(dim=-1) > 0.5)
    else:
        normal, known = normal_from_depth(rays * depth[..., None], valid)
    ray_length = rays.norm(dim=-1)
    cosine = ((normal * rays).sum(-1).abs() / ray_length).clamp(GRAZING_COSINE, 1.0)
    cosine = torch.where(known, cosine, torch.full_like(cosine, 2 * GRAZING_COSINE))

    covered = (view.coverage >= 0.5).cpu().numpy()
    signed = signed_silhouette_distance(covered, view.coverage.cpu().numpy())
    silhouette = torch.from_numpy(signed).to(device)
    weight = cosine * (silhouette / SILHOUETTE_RAMP).clamp(0.1, 1.0)
    inverse = torch.where(valid, 1.0 / depth.clamp(min=1e-12), torch.zeros_like(depth))
    return torch.stack([inverse, cosine * ray_length, torch.where(valid, weight, torch.zeros_like(weight)), silhouette], -1)


def signed_silhouette_distance(
    covered: Bool[ndarray, "height width"], coverage: Float[ndarray, "height width"]
) -> Float[ndarray, "height width"]:
    """Distance to the line coverage = 0.5 [pixels], positive where covered, capped at SILHOUETTE_REACH."""
    signed = np.where(covered, SILHOUETTE_REACH, -SILHOUETTE_REACH).astype(np.float32)
    if covered.all() or not covered.any():
        return signed
    rows, columns = np.flatnonzero(covered.any(1)), np.flatnonzero(covered.any(0))
    pad = int(SILHOUETTE_REACH) + 1
    window = slice(max(0, rows[0] - pad), rows[-1] + pad + 1), slice(max(0, columns[0] - pad), columns[-1] + pad + 1)
    inside = covered[window]
    # A pixel centre next to the line is half a pixel away from it, give or take what its coverage says.
    distance = np.where(inside, distance_transform_edt(inside) - 0.5, 0.5 - distance_transform_edt(~inside))
    near = np.abs(distance) < 0.75
    distance = np.where(near, np.clip(coverage[window] - 0.5, -0.5, 0.5), distance)
    signed[window] = np.clip(distance, -SILHOUETTE_REACH, SILHOUETTE_REACH)
    return signed


def normal_from_depth(
    points: Float[Tensor, "height width 3"], valid: Bool[Tensor, "height width"]
) -> tuple[Float[Tensor, "height width 3"], Bool[Tensor, "height width"]]:
    """Unit normals (height, width, 3) of camera-space points by differences, and where they are known.

    Of the two neighbours on each axis the one nearer in depth is taken, so that edges do not tilt the normal.
    """

    def nearer_step(axis: int) -> tuple[Float[Tensor, "height width 3"], Bool[Tensor, "height width"]]:
        ahead, behind = torch.roll(points, -1, axis) - points, points - torch.roll(points, 1, axis)
        ahead_valid, behind_valid = torch.roll(valid, -1, axis) & valid, torch.roll(valid, 1, axis) & valid
        far = torch.full_like(points[..., 2], torch.inf)
        ahead_jump = torch.where(ahead_valid, ahead[..., 2].abs(), far)
        behind_jump = torch.where(behind_valid, behind[..., 2].abs(), far)
        return torch.where((ahead_jump < behind_jump)[..., None], ahead, behind), ahead_valid | behind_valid

    across, across_known = nearer_step(1)
    down, down_known = nearer_step(0)
    normal = torch.linalg.cross(across, down)
    length = normal.norm(dim=-1, keepdim=True)
    return normal / length.clamp(min=1e-30), across_known & down_known & (length[..., 0] > 0)


def integrate_blocks(
    batches: list[PackedViews],
    blocks: Int[Tensor, "block 3"],
    origin: Float[Tensor, "3"],
    spacing: float,
    truncation: float,
    soft_band: float,
    settings: MeshSettings,
) -> Float[Tensor, "block 8 8 8"]:
    """(block, BLOCK, BLOCK, BLOCK) field at the points of `blocks` (block, 3) of a grid with this spacing."""
    device = origin.device
    offsets = torch.cartesian_prod(torch.arange(BLOCK, device=device), torch.arange(BLOCK, device=device))
    rows = torch.zeros(blocks.shape[0], BLOCK * BLOCK, 3, device=device)
    rows[:, :, :] = (blocks * BLOCK)[:, None].float()
    rows[:, :, :2] += offsets.float()
    rows = (rows.reshape(-1, 3) * spacing + origin).contiguous()
    weighted, weights, free, seen = (torch.zeros(rows.shape[0], BLOCK, device=device) for _ in range(4))
    for batch in batches:
        pixels = stack_pixels(batch.views) if batch.pixels is None else batch.pixels
        packed = ViewPixels()
        packed.count, packed.height, packed.width = pixels.shape[:3]
        projections = torch.stack(
            [view.camera.intrinsics.to(device) @ view.camera.camera_from_world[:3].to(device) for view in batch.views]
        )
        pixel_sizes = torch.stack([1.0 / view.camera.intrinsics[0, 0] for view in batch.views]).to(device)
        packed.pixel_from_world, packed.pixel_size = warp_array(projections.reshape(-1, 4), wp.vec4), warp_array(pixel_sizes)
        packed.pixels = warp_array(pixels.reshape(-1, 4), wp.vec4)
        launch(
            integrate_rows,
            rows.shape[0],
            inputs=[packed, warp_array(rows, wp.vec3), spacing, truncation, soft_band],
            outputs=[warp_array(weighted), warp_array(weights), warp_array(free), warp_array(seen)],
            device=warp_device(rows),
        )
    return combine_votes(weighted, weights, free, seen, settings).reshape(-1, BLOCK, BLOCK, BLOCK)


def combine_votes(
    weighted: Float[Tensor, "row 8"],
    weights: Float[Tensor, "row 8"],
    free: Float[Tensor, "row 8"],
    seen: Float[Tensor, "row 8"],
    settings: MeshSettings,
) -> Float[Tensor, "row 8"]:
    """Field of accumulated votes: outside needs enough views that look through the point; unseen is inside, out of all frames outside."""
    enough = torch.minimum(
        torch.maximum(torch.full_like(seen, settings.minimum_free_views), settings.minimum_free_fraction * seen), (0.5 * seen).ceil()
    )
    field = torch.where(weights > 0, weighted / weights.clamp(min=1e-12), torch.full_like(weighted, -1.0))
    field = torch.where((field > 0) & (free < enough), torch.full_like(field, -1.0), field)
    return torch.where(seen > 0, field, torch.ones_like(field)).clamp(-1.0, 1.0)


def dense_from_blocks(blocks: Int[Tensor, "block 3"], values: Float[Tensor, "block 8 8 8"], count: int) -> Float[Tensor, "n n n"]:
    """(count BLOCK)^3 grid of block values."""
    tiles = torch.zeros(count, count, count, BLOCK, BLOCK, BLOCK, device=values.device)
    tiles[blocks[:, 0], blocks[:, 1], blocks[:, 2]] = values
    return tiles.permute(0, 3, 1, 4, 2, 5).reshape(count * BLOCK, count * BLOCK, count * BLOCK)
