"""Differentiable blending of surfels into maps: features, coverage, mean and median depth.

In: world centres (N, 3), tangent columns (N, 3, 2), opacities (N,), features (N, C), a camera. Out: un-normalised sums; callers divide
by coverage where Eq. 2 of the paper says so. Gradients reach centres, tangents, opacities and features. Deterministic on the CPU.
Source: Huang et al. 2024 (docs/sources.md: huang2024); traps avoided are listed in project.py.
"""

import math
from dataclasses import dataclass
from typing import Any

import torch
import warp as wp
from jaxtyping import Float
from torch import Tensor

from drgs.render.visible.rasterize.project import (
    PARAMETERS,
    ProjectedSurfels,
    RasterView,
    project_surfels,
    project_surfels_backward,
    sum_pair_gradients,
)
from drgs.render.visible.rasterize.tile_kernels import (
    TileTable,
    padded_channels,
    pixel_backward_kernel,
    pixel_kernel,
    tile_backward_kernel,
    tile_kernel,
)
from drgs.render.visible.rasterize.tiles import TILE, TileLists, build_tile_lists
from drgs.scene.camera import Camera
from drgs.warp_torch import launch, warp_array, warp_device

FILTER_SIGMA = 0.3
"""[pixels] of the low-pass. Near outlines surfels stand edge-on and are drawn at least so wide, and the fit pulls the surface inwards until that
matches the masks: narrower than published, the surface lies half as far inside (docs/decisions/0003-fitting.md)."""
PUBLISHED_FILTER_SIGMA = 0.5**0.5
"""[pixels] of Huang et al. 2024; what benchmarks/render/rasterize.py measures with."""


@dataclass(frozen=True)
class RasterSettings:
    """How surfels become maps."""

    near: float = 0.01
    """[world units]; nothing nearer is drawn. near_plane.py scales it with the scene."""
    filter_sigma: float = FILTER_SIGMA
    """[pixels] of the Gaussian low-pass that no surfel is drawn narrower than."""
    depth: bool = True
    """Also blend the mean depth."""
    median: bool = False
    """Besides the mean depth, find the median one."""

    @property
    def depth_planes(self) -> int:
        """How many maps of depth there are."""
        return int(self.depth) + int(self.depth and self.median)


@dataclass(frozen=True, eq=False)
class RasterMaps:
    """Blended maps; sums are not divided by coverage."""

    features: Float[Tensor, "channel height width"]
    """sum_i w_i f_i."""
    coverage: Float[Tensor, "height width"]
    """sum_i w_i = 1 - transmittance, 0..1."""
    depth_sum: Float[Tensor, "height width"] | None
    """sum_i w_i (z_i - depth_origin) [world units]."""
    median_depth: Float[Tensor, "height width"] | None
    """z of the last surfel met with more than half of the light left; 0 where nothing is met."""
    depth_origin: float
    """Distance of the surfels' mean along the viewing axis: keeps the moments' digits."""


def _raster_view(camera: Camera, settings: RasterSettings) -> Any:
    view = RasterView()
    view.camera_from_world = wp.mat44(*camera.camera_from_world.flatten().tolist())
    view.pixel_from_camera = wp.mat33(*camera.intrinsics.flatten().tolist())
    view.near, view.filter_precision = settings.near, settings.filter_sigma**-2
    view.width, view.height = camera.width, camera.height
    return view


def _padded_size(camera: Camera) -> tuple[int, int]:
    """Tiles across and down."""
    return -(-camera.width // TILE), -(-camera.height // TILE)


def _tile_table(size: tuple[int, int], first_row: int, depth_origin: float, lists: TileLists, parameters: Tensor, features: Tensor) -> Any:
    """
    Args:
        size: tiles across and down. first_row: of tiles of the image.
    """
    tiles_x, tiles_y = size
    table = TileTable()
    table.first_row = first_row
    table.tiles_x, table.stride, table.plane = tiles_x, tiles_x * TILE, tiles_x * tiles_y * TILE * TILE
    table.depth_origin = depth_origin
    table.starts, table.list_surfel, table.list_pair = (warp_array(x) for x in (lists.starts, lists.list_surfel, lists.list_pair))
    table.parameters, table.features = warp_array(parameters), warp_array(features)
    return table


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx, centers, tangents, opacities, features, camera: Camera, settings: RasterSettings, depth_origin: float, per_pixel: bool,
        band: slice | None,
    ):  # fmt: skip
        device, count = centers.device, len(centers)
        ctx.feature_channels = features.shape[1]
        warp = warp_device(centers)
        rows = slice(0, camera.height) if band is None else band
        tiles_x, tiles_y = _padded_size(camera)[0], -(-(rows.stop - rows.start) // TILE)
        plane = tiles_x * tiles_y * TILE * TILE
        channels = padded_channels(features.shape[1])
        if features.shape[1] != channels:
            features = torch.nn.functional.pad(features, (0, channels - features.shape[1]))
        centers, tangents, opacities, features = (x.detach().contiguous() for x in (centers, tangents, opacities, features))

        parameters = torch.empty(count, PARAMETERS, device=device)
        depths = torch.empty(count, dtype=torch.float64, device=device)
        tile_rects = torch.empty(count, 4, dtype=torch.int32, device=device)
        tile_counts = torch.empty(count, dtype=torch.int32, device=device)
        projected = ProjectedSurfels()
        projected.parameters, projected.depths = warp_array(parameters), warp_array(depths)
        projected.tile_rects, projected.tile_counts = warp_array(tile_rects), warp_array(tile_counts)
        surfels = [warp_array(centers, wp.vec3), warp_array(tangents.view(count, 6)), warp_array(opacities)]
        launch(project_surfels, count, [_raster_view(camera, settings), *surfels], [projected], warp)
        first_row = rows.start // TILE
        lists = build_tile_lists(depths, tile_rects, tile_counts, tiles_x, tiles_y, None if band is None else first_row)

        planes = torch.empty(channels + 1 + settings.depth_planes, plane, device=device)
        median_entry = torch.empty(plane if settings.depth_planes > 1 else 0, dtype=torch.int32, device=device)
        per_pixel = per_pixel or device.type != "cpu"
        launch(
            (pixel_kernel if per_pixel else tile_kernel)(channels, settings.depth_planes),
            plane if per_pixel else tiles_x * tiles_y,
            [_tile_table((tiles_x, tiles_y), first_row, depth_origin, lists, parameters, features)],
            [warp_array(planes), warp_array(median_entry)],
            warp,
            slices_per_thread=16,
        )
        ctx.save_for_backward(centers, tangents, features, parameters, tile_counts, planes, median_entry, *vars(lists).values())
        ctx.set_materialize_grads(False)
        ctx.camera, ctx.settings, ctx.depth_origin, ctx.per_pixel = camera, settings, depth_origin, per_pixel
        images = planes.view(-1, tiles_y * TILE, tiles_x * TILE)[:, : rows.stop - rows.start, : camera.width]
        extra = [*images[channels + 1 :].unbind(0), None, None][:2]
        return images[: ctx.feature_channels], images[channels], *extra

    @staticmethod
    def backward(ctx, *image_gradients):
        centers, tangents, features, parameters, tile_counts, planes, median_entry, *rest = ctx.saved_tensors
        lists = TileLists(*rest)
        camera, settings = ctx.camera, ctx.settings
        device, count, channels = centers.device, len(centers), features.shape[1]
        warp = warp_device(centers)
        tiles_x, tiles_y = _padded_size(camera)
        plane = tiles_x * tiles_y * TILE * TILE
        # Padding, and maps that nobody used, stay 0; where all is written it need not be 0 before.
        is_whole = plane == camera.height * camera.width and channels == ctx.feature_channels
        gradients = (torch.empty if is_whole else torch.zeros)(len(planes), plane, device=device)
        images = gradients.view(-1, tiles_y * TILE, tiles_x * TILE)[:, : camera.height, : camera.width]
        images[: ctx.feature_channels] = 0.0 if image_gradients[0] is None else image_gradients[0]
        for k, image_gradient in enumerate(image_gradients[1 : 1 + len(planes) - channels]):
            images[channels + k] = 0.0 if image_gradient is None else image_gradient
        surfel_gradients = torch.empty(count, 16 + channels, device=device)
        table = _tile_table((tiles_x, tiles_y), 0, ctx.depth_origin, lists, parameters, features)
        inputs = [table, warp_array(planes), warp_array(gradients), warp_array(median_entry)]
        if ctx.per_pixel:
            # Atomic sums: one thread on the CPU (tests only).
            surfel_gradients.zero_()
            kernel = pixel_backward_kernel(channels, settings.depth_planes)
            wp.launch(kernel, dim=plane, inputs=[0, *inputs], outputs=[warp_array(surfel_gradients)], device=warp)
        else:
            pair_gradients = torch.empty(len(lists.list_pair), 16 + channels, device=device)
            kernel = tile_backward_kernel(channels, settings.depth_planes)
            launch(kernel, tiles_x * tiles_y, inputs, [warp_array(pair_gradients)], warp, slices_per_thread=16)
            launch(
                sum_pair_gradients,
                count,
                [warp_array(pair_gradients), warp_array(lists.offsets), 16 + channels],
                [warp_array(surfel_gradients)],
                warp,
            )
        center_gradients, tangent_gradients = torch.zeros_like(centers), torch.zeros_like(tangents)
        opacity_gradients = torch.zeros(count, device=device)
        launch(
            project_surfels_backward, count,
            [_raster_view(camera, settings), warp_array(centers, wp.vec3), warp_array(tangents.view(count, 6)), warp_array(parameters),
             warp_array(tile_counts), warp_array(surfel_gradients)],
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
    band: slice | None = None,
) -> RasterMaps:
    """Blend surfels front to back by centre depth.

    Args:
        centers: (N, 3) world. tangents: (N, 3, 2) world columns, need not be orthogonal. opacities: (N,) 0..1. features: (N, C).
        per_pixel: take the plain kernel (CUDA's) instead of the vectorised one; for tests.
        band: rows of the image, from a tile's edge to a tile's edge, that the maps are to hold; None: all. Gradients flow through whole images only.

    Raises:
        ValueError: more feature channels than the widest compiled variant.
    """
    settings = settings or RasterSettings()
    with torch.no_grad():
        axis, offset = (part.to(centers) for part in (camera.camera_from_world[2, :3], camera.camera_from_world[2, 3]))
        depth_origin = float(centers.mean(0) @ axis + offset) if len(centers) else 0.0
        depth_origin = depth_origin if math.isfinite(depth_origin) else 0.0
    maps = _Rasterize.apply(centers, tangents, opacities, features, camera, settings, depth_origin, per_pixel, band)
    feature_sums, coverage, depth_sum, median_depth = maps
    return RasterMaps(feature_sums, coverage, depth_sum, median_depth, depth_origin)
