"""The G-buffer of posed surfels: material, normal and depth maps divided by coverage (Eq. 2 of the paper)."""

import torch
from torch import Tensor

from drgs.render.image_tiles import TILE, window_of_tiles
from drgs.render.rasterize_gbuffer.rasterize import RasterSettings, rasterize
from drgs.render.records import GBuffer
from drgs.scene.camera import Camera, pixel_rays_world
from drgs.scene.posed_scene import PosedSurfels

MIN_COVERAGE = 1.0 / 255.0
"""Pixels below carry no surface; the division by coverage is guarded here."""


SEEN_FROM_BEHIND = 0.3
"""Cosine between a surfel's normal and the viewing ray above which the surfel is taken to show its back."""
NEAR_SHARE = 0.01
"""Distance of the near plane in half sides of the surfels' box; builds fit with about the same."""
LEAST_FACING = 0.02
"""Blended normals face the camera at least by this cosine."""


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


def near_plane(centers: Tensor) -> float:
    """Distance before which nothing is drawn [world units]: a share of what the surfels span, so that pictures know no unit."""
    if len(centers) == 0:
        return 0.0
    low, high = centers.detach().aminmax(dim=0)
    return NEAR_SHARE * 0.5 * float((high - low).max())


def rasterize_gbuffer(surfels: PosedSurfels, camera: Camera, settings: RasterSettings | None = None) -> GBuffer:
    """What the camera sees of the surfels.

    Depth is the expected one; the shaded point lies on the pixel's ray at that depth. Where nothing is met: depth inf, the rest 0.

    Args:
        settings: None: the near plane follows the surfels' span.
    """
    settings = settings or RasterSettings(near=near_plane(surfels.centers))
    materials = surfels.materials
    crosses = torch.linalg.cross(surfels.tangents[:, :, 0], surfels.tangents[:, :, 1])
    normals = facing_normals(torch.nn.functional.normalize(crosses, dim=-1, eps=1e-20), surfels.centers, camera)
    features = torch.cat([normals, materials.albedo, materials.roughness[:, None], materials.metallic[:, None]], -1)
    maps = rasterize(surfels.centers, surfels.tangents, surfels.opacities, features, camera, settings)
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
    position = origin + directions * (torch.where(covered, depth, torch.zeros_like(depth)) / along_axis)[..., None]
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
