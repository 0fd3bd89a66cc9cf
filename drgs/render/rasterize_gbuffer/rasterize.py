"""Differentiable blending of surfels into maps: features, coverage, depth moments, median depth.

In: world centres (N, 3), tangent columns (N, 3, 2), opacities (N,), features (N, C), a camera. Out: un-normalised sums; callers divide
by coverage where Eq. 2 of the paper says so. Gradients reach centres, tangents, opacities and features. Deterministic on the CPU.
Source: Huang et al. 2024 (docs/sources.md: huang2024); traps avoided are listed in project.py.
"""

import math
from dataclasses import dataclass

import torch
import warp as wp
from jaxtyping import Float
from torch import Tensor

from drgs.render.rasterize_gbuffer.project import PARAMETERS, project_surfels, project_surfels_backward, sum_pair_gradients
from drgs.render.rasterize_gbuffer.tile_kernels import padded_channels, pixel_kernels, simd_kernels
from drgs.render.rasterize_gbuffer.tiles import TILE, TileLists, build_tile_lists
from drgs.scene.camera import Camera
from drgs.warp_torch import launch, warp_array, warp_device


@dataclass(frozen=True)
class RasterSettings:
    """How surfels become maps."""

    near: float = 0.01
    """[world units]; nothing nearer is drawn. build_asset scales it with the scene."""
    depth: bool = True
    """Also blend depth moments and the median."""


@dataclass(frozen=True, eq=False)
class RasterMaps:
    """Blended maps; sums are not divided by coverage."""

    features: Float[Tensor, "channel height width"]
    """sum_i w_i f_i."""
    coverage: Float[Tensor, "height width"]
    """sum_i w_i = 1 - transmittance, 0..1."""
    depth_sum: Float[Tensor, "height width"] | None
    """sum_i w_i (z_i - depth_origin) [world units]."""
    depth_square_sum: Float[Tensor, "height width"] | None
    """sum_i w_i (z_i - depth_origin)^2."""
    median_depth: Float[Tensor, "height width"] | None
    """z of the last surfel met with more than half of the light left; 0 where nothing is met."""
    depth_origin: float
    """Distance of the surfels' mean along the viewing axis: keeps the moments' digits."""


def _camera_arguments(camera: Camera) -> tuple[wp.mat44, wp.mat33]:
    return wp.mat44(*camera.camera_from_world.flatten().tolist()), wp.mat33(*camera.intrinsics.flatten().tolist())


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx, centers, tangents, opacities, features, camera: Camera, settings: RasterSettings, depth_origin: float, per_pixel: bool
    ):
        device, count = centers.device, len(centers)
        ctx.feature_channels = features.shape[1]
        warp = warp_device(centers)
        tiles_x, tiles_y = -(-camera.width // TILE), -(-camera.height // TILE)
        stride, plane = tiles_x * TILE, tiles_x * tiles_y * TILE * TILE
        channels = padded_channels(features.shape[1])
        if features.shape[1] != channels:
            features = torch.nn.functional.pad(features, (0, channels - features.shape[1]))
        centers, tangents, opacities, features = (x.detach().contiguous() for x in (centers, tangents, opacities, features))
        camera_from_world, pixel_from_camera = _camera_arguments(camera)

        parameters = torch.empty(count, PARAMETERS, device=device)
        depths = torch.empty(count, dtype=torch.float64, device=device)
        tile_rects = torch.empty(count, 4, dtype=torch.int32, device=device)
        tile_counts = torch.empty(count, dtype=torch.int32, device=device)
        launch(
            project_surfels, count,
            [warp_array(centers, wp.vec3), warp_array(tangents.view(count, 6)), warp_array(opacities), camera_from_world, pixel_from_camera,
             settings.near, camera.width, camera.height],
            [warp_array(parameters), warp_array(depths), warp_array(tile_rects), warp_array(tile_counts)], warp,
        )  # fmt: skip
        lists = build_tile_lists(depths, tile_rects, tile_counts, tiles_x, tiles_y)

        planes = torch.empty(channels + 1 + 3 * settings.depth, plane, device=device)
        median_entry = torch.empty(plane if settings.depth else 0, dtype=torch.int32, device=device)
        per_pixel = per_pixel or device.type != "cpu"
        forward = (pixel_kernels if per_pixel else simd_kernels)(channels, settings.depth)[0]
        launch(
            forward, plane if per_pixel else tiles_x * tiles_y,
            [tiles_x, stride, plane, depth_origin, warp_array(lists.starts), warp_array(lists.list_surfel), warp_array(parameters), warp_array(features)],
            [warp_array(planes), warp_array(median_entry)], warp, slices_per_thread=16,
        )  # fmt: skip
        ctx.save_for_backward(centers, tangents, features, parameters, tile_counts, planes, median_entry, *vars(lists).values())
        ctx.set_materialize_grads(False)
        ctx.camera, ctx.settings, ctx.depth_origin, ctx.per_pixel = camera, settings, depth_origin, per_pixel
        images = planes.view(-1, tiles_y * TILE, stride)[:, : camera.height, : camera.width]
        extra = images[channels + 1 :].unbind(0) if settings.depth else (None, None, None)
        return images[: ctx.feature_channels], images[channels], *extra

    @staticmethod
    def backward(ctx, *image_gradients):
        centers, tangents, features, parameters, tile_counts, planes, median_entry, *rest = ctx.saved_tensors
        lists = TileLists(*rest)
        camera, settings = ctx.camera, ctx.settings
        device, count, channels = centers.device, len(centers), features.shape[1]
        warp = warp_device(centers)
        tiles_x, tiles_y = -(-camera.width // TILE), -(-camera.height // TILE)
        stride, plane = tiles_x * TILE, tiles_x * tiles_y * TILE * TILE
        gradients = torch.zeros(len(planes), plane, device=device)  # padding, and maps that nobody used, stay 0
        images = gradients.view(-1, tiles_y * TILE, stride)[:, : camera.height, : camera.width]
        images[: ctx.feature_channels] = 0.0 if image_gradients[0] is None else image_gradients[0]
        for k, image_gradient in enumerate(image_gradients[1:]):
            if image_gradient is not None:
                images[channels + k] = image_gradient
        # S = sum_i w_i (g . f_i): everything blended with weight w, that is all planes but the median.
        blended = channels + 1 + 2 * settings.depth
        total = (gradients[:blended] * planes[:blended]).sum(0)
        surfel_gradients = torch.zeros(count, 16 + channels, device=device)
        if ctx.per_pixel:
            # Atomic sums: one thread on the CPU (tests only).
            wp.launch(
                pixel_kernels(channels, settings.depth)[1], dim=plane, device=warp,
                inputs=[0, tiles_x, stride, plane, ctx.depth_origin, warp_array(lists.starts), warp_array(lists.list_surfel), warp_array(parameters),
                        warp_array(features), warp_array(gradients), warp_array(total), warp_array(median_entry)],
                outputs=[warp_array(surfel_gradients)],
            )  # fmt: skip
        else:
            pair_gradients = torch.empty(len(lists.list_pair), 16 + channels, device=device)
            launch(
                simd_kernels(channels, settings.depth)[1], tiles_x * tiles_y,
                [tiles_x, stride, plane, ctx.depth_origin, warp_array(lists.starts), warp_array(lists.list_surfel), warp_array(lists.list_pair),
                 warp_array(parameters), warp_array(features), warp_array(gradients), warp_array(total), warp_array(median_entry)],
                [warp_array(pair_gradients)], warp, slices_per_thread=16,
            )  # fmt: skip
            launch(
                sum_pair_gradients,
                count,
                [warp_array(pair_gradients), warp_array(lists.offsets), 16 + channels],
                [warp_array(surfel_gradients)],
                warp,
            )
        center_gradients, tangent_gradients = torch.zeros_like(centers), torch.zeros_like(tangents)
        opacity_gradients = torch.zeros(count, device=device)
        camera_from_world, pixel_from_camera = _camera_arguments(camera)
        launch(
            project_surfels_backward, count,
            [warp_array(centers, wp.vec3), warp_array(tangents.view(count, 6)), warp_array(parameters), warp_array(tile_counts),
             warp_array(surfel_gradients), camera_from_world, pixel_from_camera, settings.near],
            [warp_array(center_gradients, wp.vec3), warp_array(tangent_gradients.view(count, 6)), warp_array(opacity_gradients)], warp,
        )  # fmt: skip
        return (
            center_gradients,
            tangent_gradients,
            opacity_gradients,
            surfel_gradients[:, 16 : 16 + ctx.feature_channels],
            None,
            None,
            None,
            None,
        )


def rasterize(
    centers: Tensor,
    tangents: Tensor,
    opacities: Tensor,
    features: Tensor,
    camera: Camera,
    settings: RasterSettings | None = None,
    per_pixel: bool = False,
) -> RasterMaps:
    """Blend surfels front to back by centre depth.

    Args:
        centers: (N, 3) world. tangents: (N, 3, 2) world columns, need not be orthogonal. opacities: (N,) 0..1. features: (N, C).
        per_pixel: take the plain kernel (CUDA's) instead of the vectorised one; for tests.

    Raises:
        ValueError: more feature channels than the widest compiled variant.
    """
    settings = settings or RasterSettings()
    with torch.no_grad():
        axis, offset = camera.camera_from_world[2, :3], camera.camera_from_world[2, 3]
        depth_origin = float(centers.mean(0) @ axis + offset) if len(centers) else 0.0
        depth_origin = depth_origin if math.isfinite(depth_origin) else 0.0
    maps = _Rasterize.apply(centers, tangents, opacities, features, camera, settings, depth_origin, per_pixel)
    return RasterMaps(*maps, depth_origin)
