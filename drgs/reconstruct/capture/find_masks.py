"""Captures without masks: what is the object? A quick fit tells, and the build then goes on as with masks.

Surfels are fitted in the sphere that all cameras look at, in front of a picture of the surroundings that depends on the direction alone,
while coverage costs a little: whatever keeps its place against the directions as the camera moves becomes surfels, the rest background. Masks are
what the surfels cover. Near surroundings move as the object does and become part of it, but for the ground that it stands on, where that was found
(on_ground): it lies before the surroundings, and surfels on it are none of the object.

In: Views without masks, random points. Out: the same Views with masks. Measured on the bunny before its own surroundings (64 views,
256 pixels, 400 iterations): intersection over union with the true masks 0.94.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from drgs.reconstruct.capture.build_box import BuildBox
from drgs.reconstruct.capture.cut_to_box import CutMask, shown_views
from drgs.reconstruct.capture.initial_points import InitialPoints
from drgs.reconstruct.fit.fit_loop import FitReport
from drgs.reconstruct.fit.surfels.fit_gaussians import FitSettings, fit_gaussians, gaussians_from_state, start_fit
from drgs.reconstruct.geometry.mesh_from_gaussians import chosen_surfels
from drgs.render.visible.rasterize import RasterSettings, rasterize
from drgs.render.visible.rasterize.near_plane import near_plane
from drgs.scene.camera import Camera, scaled_camera
from drgs.scene.gaussians import Gaussians, surfel_tangents
from drgs.scene.views import Views

SIDE = 256
"""Of the pictures that the quick fit looks at [pixels]."""
ITERATIONS = 400
HALF = 0.5
"""Of a pixel: covered by more it is the object's."""
HIDDEN = 0.25
"""A pixel that the box's content would cover by half is hidden where it covers less than this: a quick fit's surfels are soft, and half hide each other."""


def find_masks(
    views: Views,
    points: InitialPoints,
    settings: FitSettings,
    device: torch.device,
    report: Callable[[FitReport], None] | None = None,
    should_stop: Callable[[], bool] | None = None,
    box: BuildBox | None = None,
) -> Views | None:
    """The capture with masks; None when should_stop() said so.

    Args:
        points: random ones in the sphere that all cameras look at, or the capture's own. settings: of stage 1, for its rates and weights.
        box: of the build; views in which something hides what it holds are left out.

    Raises:
        CaptureFault: as masked_by_surfels.
    """
    settings = replace(settings, iterations=ITERATIONS, half_size_share=0.6, densify=replace(settings.densify, budget=12_000))
    small = smaller_views(views, SIDE)
    state = start_fit(points, settings, device, has_masks=False, ground=views.ground)
    fit_gaussians(small, state, settings, points.bounds_radius, report, should_stop)
    return masked_by_surfels(views, gaussians_from_state(state), points.bounds_radius, box) if state.iteration == ITERATIONS else None


def smaller_views(views: Views, side: int) -> Views:
    """The capture with pictures of at most `side` pixels, averaged."""
    cameras = tuple(scaled_camera(camera, min(1.0, side / max(camera.height, camera.width))) for camera in views.cameras)

    def shrunk(picture: torch.Tensor, camera: Camera) -> torch.Tensor:
        size = (camera.height, camera.width)
        return torch.nn.functional.interpolate(picture[None].float(), size, mode="area")[0].round().to(torch.uint8)

    images = [shrunk(image.permute(2, 0, 1), camera) for image, camera in zip(views.images_srgb, cameras, strict=True)]
    masks = [shrunk(mask[None], camera)[0] for mask, camera in zip(views.coverage, cameras, strict=True)]
    return replace(
        views, cameras=cameras, images_srgb=tuple(image.permute(1, 2, 0).contiguous() for image in images), coverage=tuple(masks)
    )


def masked_by_surfels(views: Views, gaussians: Gaussians, radius: float, box: BuildBox | None) -> Views:
    """The capture masked by what surfels cover, or by what of them is in the build's box.

    Raises:
        CaptureFault: the box holds nothing, or hardly a view shows what it holds.
    """
    return (
        with_drawn_masks(views, gaussians, radius) if box is None else shown_views(views, drawn_in_box(views, gaussians, radius, box), box)
    )


def with_drawn_masks(views: Views, gaussians: Gaussians, radius: float) -> Views:
    """The capture masked by what surfels cover above the ground; radius: of the object's bounding sphere [world units]."""
    drawn = _drawn(views, gaussians, radius, _above_ground(views, gaussians).float())
    masks = ((share > HALF) & (may > 0) for share, may in zip(drawn, views.coverage, strict=True))
    return replace(views, coverage=tuple((255 * mask).to(torch.uint8) for mask in masks), has_masks=True, ground=None)


def _above_ground(views: Views, gaussians: Gaussians) -> Bool[Tensor, "surfel"]:
    """Surfels that stand on the ground; all where none is known."""
    return (
        torch.ones_like(gaussians.opacity_logits, dtype=torch.bool) if views.ground is None else views.ground.heights(gaussians.centers) > 0
    )


def drawn_in_box(views: Views, gaussians: Gaussians, radius: float, box: BuildBox) -> list[CutMask]:
    """The same of the surfels in the box alone, where no others are in front of them."""
    held = box.holds(gaussians.centers) & _above_ground(views, gaussians)
    if not held.any():
        return [CutMask(torch.zeros_like(coverage), 0.0) for coverage in views.coverage]
    alone = chosen_surfels(gaussians, held)
    cut = []
    pairs = zip(_drawn(views, gaussians, radius, held.float()), _drawn(views, alone, radius, held[held].float()), strict=True)
    for seen, all_of_it in pairs:
        would_show = all_of_it > HALF
        hidden = int((would_show & (seen < HIDDEN)).sum()) / max(int(would_show.sum()), 1)
        cut.append(CutMask((255 * (seen > HALF)).to(torch.uint8), hidden))
    return cut


def _drawn(views: Views, gaussians: Gaussians, radius: float, chosen: Float[Tensor, "surfel"]) -> Iterator[Float[Tensor, "height width"]]:
    """Of each view, the share of each pixel that chosen surfels (1; others 0) cover, seen past the others."""
    tangents, opacities = surfel_tangents(gaussians), torch.sigmoid(gaussians.opacity_logits)
    settings = RasterSettings(near=near_plane(radius), depth=False)
    for camera in views.cameras:
        yield rasterize(gaussians.centers, tangents, opacities, chosen[:, None], camera.to(chosen.device), settings).features[0].cpu()
