"""What stage 1 sees of a view: maps of the surfels, shaded once a pixel by split sum, linear; differentiable.

In: parameters by name, filter_environment's tables, a camera. Out: StageOneMaps. Maps are divided by coverage before they are shaded.
Sources: docs/sources.md: huang2024 (surfels), yao2025 (deferred reflection).
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from drgs.reconstruct.fit.light.split_sum import shade_split_sum
from drgs.reconstruct.fit.surfels.covered_pixels import LEAST_COVERAGE, covered_pixels
from drgs.reconstruct.fit.surfels.surfel_features import surfel_features
from drgs.render.visible.rasterize import RasterSettings, rasterize
from drgs.scene.camera import Camera


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
    assert maps.depth_sum is not None  # asked for by RasterSettings.depth
    depth = maps.depth_sum / maps.coverage.clamp(min=LEAST_COVERAGE) + maps.depth_origin
    pixels = (maps.coverage.detach().flatten() > LEAST_COVERAGE).nonzero().squeeze(1)
    seen = covered_pixels(maps.features, maps.coverage, pixels, camera)
    radiance = shade_split_sum(
        seen.diffuse_albedo, seen.residual, seen.f0, seen.roughness, seen.normal, seen.wo, tables, light_from_world=light_from_world
    )
    size = (camera.height, camera.width)

    def image(packed: Float[Tensor, "pixel channel"]) -> Float[Tensor, "height width channel"]:
        return packed.new_zeros(camera.height * camera.width, packed.shape[1]).index_copy(0, pixels, packed).view(*size, -1)

    return StageOneMaps(image(radiance), maps.coverage, image(seen.normal), depth, image(seen.roughness[:, None])[..., 0], seen.residual)
