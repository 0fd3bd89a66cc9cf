"""What stage 2 sees of a view: maps of materials, normals and the surfels' own radiance, and shading points in them; differentiable.

In: parameters by name, a camera. Out: StageTwoMaps, divided by coverage; ShadingPoints of chosen pixels.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from drgs.maths.frames import rotation_from_quat_wxyz
from drgs.maths.spherical_harmonics import evaluate_sh
from drgs.render.records import ShadingPoints
from drgs.render.visible.rasterize import RasterSettings, face_camera, facing_normals, rasterize
from drgs.scene.camera import Camera, pixel_rays_world


@dataclass(frozen=True, eq=False)
class StageTwoMaps:
    """A view's maps, divided by coverage."""

    splat_radiance: Float[Tensor, "height width 3"]
    coverage: Float[Tensor, "height width"]
    depth: Float[Tensor, "height width"]
    normal_world: Float[Tensor, "height width 3"]
    albedo: Float[Tensor, "height width 3"]
    roughness: Float[Tensor, "height width"]
    metallic: Float[Tensor, "height width"]


def render_stage_two(parameters: dict[str, Tensor], camera: Camera, near: float) -> StageTwoMaps:
    """Blend and normalise; differentiable."""
    rotation = rotation_from_quat_wxyz(parameters["quats"])
    centers = parameters["centers"]
    with torch.no_grad():
        to_surfel = torch.nn.functional.normalize(centers - camera.center_world, dim=-1)
    radiance = (evaluate_sh(parameters["sh"], to_surfel) + 0.5).clamp(min=0)
    features = torch.cat(
        [
            facing_normals(rotation[:, :, 2], centers, camera),
            torch.sigmoid(parameters["albedo_logits"]),
            torch.sigmoid(parameters["roughness_logits"])[:, None],
            torch.sigmoid(parameters["metallic_logits"])[:, None],
            radiance,
        ],
        1,
    )
    tangents = rotation[:, :, :2] * parameters["log_scales"].exp()[:, None, :]
    maps = rasterize(centers, tangents, torch.sigmoid(parameters["opacity_logits"]), features, camera, RasterSettings(near=near))
    inverse = 1 / maps.coverage.clamp(min=0.02)
    assert maps.depth_sum is not None  # asked for by RasterSettings.depth
    normalised = (maps.features * inverse).permute(1, 2, 0)
    return StageTwoMaps(
        splat_radiance=normalised[..., 8:11],
        coverage=maps.coverage,
        depth=maps.depth_sum * inverse + maps.depth_origin,
        normal_world=face_camera(normalised[..., :3], -pixel_rays_world(camera)[1]),
        albedo=normalised[..., 3:6],
        roughness=normalised[..., 6],
        metallic=normalised[..., 7],
    )


def points_at(maps: StageTwoMaps, camera: Camera, pixels: Int[Tensor, "point"]) -> ShadingPoints:
    """Shading points of the pixels (flat indices); gradients reach normal and materials."""
    origin, directions = pixel_rays_world(camera)
    direction = directions.reshape(-1, 3)[pixels]
    distance = maps.depth.reshape(-1)[pixels] / (direction @ camera.camera_from_world[2, :3])
    return ShadingPoints(
        position_world=(origin + direction * distance[:, None]).detach(),
        normal_world=maps.normal_world.reshape(-1, 3)[pixels],
        wo_world=-direction,
        albedo=maps.albedo.reshape(-1, 3)[pixels],
        roughness=maps.roughness.reshape(-1)[pixels],
        metallic=maps.metallic.reshape(-1)[pixels],
        pixel=pixels.int(),
    )
