"""What stage 1 sees of a view: maps of the surfels, shaded once a pixel by split sum, linear; differentiable.

In: parameters by name, filter_environment's tables, a camera. Out: StageOneMaps. Maps are divided by coverage before they are shaded.
Sources: docs/sources.md: huang2024 (surfels), yao2025 (deferred reflection).
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from drgs.reconstruct.fit.light.split_sum import shade_split_sum
from drgs.reconstruct.fit.surfels.surfel_features import surfel_features
from drgs.render.visible.rasterize import RasterSettings, face_camera, rasterize
from drgs.scene.camera import Camera, pixel_rays_world


@dataclass(frozen=True, eq=False)
class StageOneMaps:
    """What one view looks like to stage 1."""

    radiance_linear: Float[Tensor, "height width 3"]
    """(height, width, 3); 0 where nothing is covered."""
    coverage: Float[Tensor, "height width"]
    normal_world: Float[Tensor, "height width 3"]
    depth: Float[Tensor, "height width"]
    roughness: Float[Tensor, "height width"]
    residual: Float[Tensor, "covered 3"]
    """(covered pixel, 3) radiance that the material and the unshadowed light do not explain."""


def render_stage_one(
    parameters: dict[str, Tensor],
    tables: Float[Tensor, "texel 3"],
    camera: Camera,
    near: float,
    sh_degree: int,
    light_from_world: Float[Tensor, "3 3"] | None = None,
    open_share: Float[Tensor, "surfel 3"] | None = None,
) -> StageOneMaps:
    """Blend, normalise by coverage, shade once a pixel; differentiable.

    Args:
        open_share: of the open sky's irradiance that arrives at each surfel; None: all of it.
    """
    centers = parameters["centers"]
    tangents, features = surfel_features(parameters, camera.center_world, sh_degree, open_share)
    maps = rasterize(centers, tangents, torch.sigmoid(parameters["opacity_logits"]), features, camera, RasterSettings(near=near))
    # Maps are divided by coverage; a pixel hardly covered keeps a bounded gradient.
    inverse = 1 / maps.coverage.clamp(min=0.02)
    assert maps.depth_sum is not None  # asked for by RasterSettings.depth
    depth = maps.depth_sum * inverse + maps.depth_origin
    pixels = (maps.coverage.detach().flatten() > 0.02).nonzero().squeeze(1)
    # Split as planes, once: back through a slice autograd writes zeros for all that it leaves out.
    values = maps.features.flatten(1).index_select(1, pixels) * inverse.flatten().index_select(0, pixels)
    blended_normal, diffuse, f0, roughness, residual = (plane.T for plane in values.split([3, 3, 3, 1, 3]))
    _, directions = pixel_rays_world(camera)
    wo = -directions.reshape(-1, 3).index_select(0, pixels)
    normal = face_camera(blended_normal, wo)
    radiance = shade_split_sum(diffuse, residual, f0, roughness[:, 0], normal, wo, tables, light_from_world=light_from_world)
    size = (camera.height, camera.width)

    def image(packed: Float[Tensor, "pixel channel"]) -> Float[Tensor, "height width channel"]:
        return packed.new_zeros(camera.height * camera.width, packed.shape[1]).index_copy(0, pixels, packed).view(*size, -1)

    return StageOneMaps(image(radiance), maps.coverage, image(normal), depth, image(roughness)[..., 0], residual)
