"""The G-buffer of posed surfels: material, normal and depth maps divided by coverage (Eq. 2 of the paper)."""

import torch
from torch import Tensor

from drgs.render.rasterize_gbuffer.rasterize import RasterSettings, rasterize
from drgs.render.records import GBuffer
from drgs.scene.camera import Camera, pixel_rays_world
from drgs.scene.posed_scene import PosedSurfels

MIN_COVERAGE = 1.0 / 255.0
"""Pixels below carry no surface; the division by coverage is guarded here."""


def surfel_normals(surfels_tangents: Tensor, centers: Tensor, camera: Camera) -> Tensor:
    """(surfel, 3) unit normals of tangent columns (surfel, 3, 2), turned towards the camera."""
    normals = torch.nn.functional.normalize(torch.linalg.cross(surfels_tangents[:, :, 0], surfels_tangents[:, :, 1]), dim=-1, eps=1e-20)
    away = (normals * (centers - camera.center_world)).sum(-1, keepdim=True) > 0
    return torch.where(away, -normals, normals)


def rasterize_gbuffer(surfels: PosedSurfels, camera: Camera, settings: RasterSettings | None = None) -> GBuffer:
    """What the camera sees of the surfels.

    Depth is the expected one; the shaded point lies on the pixel's ray at that depth. Where nothing is met: depth inf, the rest 0.
    """
    materials = surfels.materials
    normals = surfel_normals(surfels.tangents, surfels.centers, camera)
    features = torch.cat([normals, materials.albedo, materials.roughness[:, None], materials.metallic[:, None]], -1)
    maps = rasterize(surfels.centers, surfels.tangents, surfels.opacities, features, camera, settings)
    covered = maps.coverage >= MIN_COVERAGE
    inverse = torch.where(covered, 1 / maps.coverage.clamp(min=MIN_COVERAGE), torch.zeros_like(maps.coverage))
    normalised = (maps.features * inverse).permute(1, 2, 0)
    depth = torch.where(covered, maps.depth_sum * inverse + maps.depth_origin, torch.full_like(inverse, torch.inf))
    origin, directions = pixel_rays_world(camera)
    along_axis = directions @ camera.camera_from_world[2, :3]
    position = origin + directions * (torch.where(covered, depth, torch.zeros_like(depth)) / along_axis)[..., None]
    return GBuffer(
        coverage=maps.coverage,
        depth=depth,
        position_world=position,
        normal_world=torch.nn.functional.normalize(normalised[..., :3], dim=-1),
        wo_world=-directions,
        albedo=normalised[..., 3:6].clamp(0, 1),
        roughness=normalised[..., 6].clamp(0, 1),
        metallic=normalised[..., 7].clamp(0, 1),
    )
