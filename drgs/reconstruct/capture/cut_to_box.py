"""The capture without what lies outside the build's box: its masks show what is seen in it, and views in which the rest hides it are left out.

Where the capture has masks, their visual hull says how deep a pixel looks: it stays the object's where its ray meets the hull in the box first. Without masks
the surfels that were fitted say so (find_masks). A pixel in which something outside hides what is inside tells nothing of it, and a mask has no word
for that; so a view with many such pixels is not asked at all.

In: views, the box. Out: fewer or the same views, with other masks.
"""

from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Bool
from numpy import ndarray
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from drgs.reconstruct.capture.build_box import BuildBox
from drgs.reconstruct.capture.load_views.checks import CaptureFault
from drgs.reconstruct.capture.visual_hull import VisualHull, visual_hull
from drgs.render.intersect.trace_rays import build_tracer, trace_rays
from drgs.render.intersect.tracer import AbstractTracer
from drgs.scene.camera import pixel_rays_world
from drgs.scene.mesh import TriangleMesh, vertex_normals
from drgs.scene.views import Views

MOST_HIDDEN = 0.03
"""Of what the box holds, as a view would see it: a view in which more is hidden by the rest is left out: its mask would carve that away."""
FEWEST_LEFT = 8
"""Views that must show what the box holds; with fewer, hardly anything is seen from enough sides."""
HALF = 127
"""Of coverage: above, a pixel is the object's."""
WHERE_CORNERS = "The corners are those of the asset's world: the capture's, turned by --up. Without a box all of the object is built; drgs doctor --json tells where it lies (bounds_center)."

Entry = TypeVar("Entry")


@dataclass(frozen=True, eq=False)
class CutMask:
    """What one view sees of the box."""

    coverage: Tensor
    """(height, width) uint8."""
    hidden_share: float
    """Of what it would see of the box's content were nothing else there."""


@torch.no_grad()
def cut_to_box(views: Views, box: BuildBox) -> Views:
    """Views with masks of their own, as of what the box holds of their hull.

    Raises:
        CaptureFault: the box holds nothing, or hardly a view shows what it holds.
        ValueError: the masks have no common shape.
    """
    whole = visual_hull(views)
    if whole is None:
        return views  # initial_points says so
    within = visual_hull(views, box=box)
    if within is None:
        low, high = (torch.from_numpy(corner(whole.vertices_world, axis=0)).tolist() for corner in (np.min, np.max))
        there = " to ".join("(" + ", ".join(f"{value:.4g}" for value in place) + ")" for place in (low, high))
        raise CaptureFault(f"the box {box} holds nothing of the object, expected it about what the masks allow, {there}.", WHERE_CORNERS)
    tracers = _tracer(whole), _tracer(within)
    cut = [_cut_mask(views, index, *tracers, box) for index in range(len(views.cameras))]
    return shown_views(views, cut, box)


def shown_views(views: Views, cut: list[CutMask], box: BuildBox) -> Views:
    """The views with new masks, without those in which the box's content is hidden.

    Raises:
        CaptureFault: hardly one is left, or none shows anything.
    """
    if not any(bool((mask.coverage > HALF).any()) for mask in cut):
        raise CaptureFault(f"the box {box} holds nothing that the pictures show, expected it about the object.", WHERE_CORNERS)
    kept = shown(cut)
    if len(kept) < min(FEWEST_LEFT, len(cut)):
        raise CaptureFault(
            f"in {len(cut) - len(kept)} of {len(cut)} pictures something outside the box {box} hides what it holds, expected at least "
            f"{FEWEST_LEFT} pictures that show it.",
            "Make the box larger, so that it holds what is in front, too; or build all and leave faces out afterwards.",
        )
    return chosen_views(replace(views, coverage=tuple(mask.coverage for mask in cut), has_masks=True, ground=None), kept)


def shown(cut: list[CutMask]) -> list[int]:
    """Of the views that are not left out, their numbers."""
    return [index for index, mask in enumerate(cut) if mask.hidden_share <= MOST_HIDDEN]


def chosen_views(views: Views, kept: list[int]) -> Views:
    """Some of the views, in their order."""

    def of(entries: tuple[Entry, ...]) -> tuple[Entry, ...]:
        return tuple(entries[index] for index in kept)

    return replace(
        views,
        cameras=of(views.cameras),
        images_srgb=of(views.images_srgb),
        coverage=of(views.coverage),
        lenses=of(views.lenses) if views.lenses else (),
        gains=None if views.gains is None else of(views.gains),
        tints=None if views.tints is None else of(views.tints),
        light_from_world=None if views.light_from_world is None else of(views.light_from_world),
    )


def views_of(views: Views, others: Views) -> Views:
    """Of the views, those that the others have too, told by their names."""
    names = {camera.name for camera in others.cameras}
    return chosen_views(views, [index for index, camera in enumerate(views.cameras) if camera.name in names])


def _tracer(hull: VisualHull) -> AbstractTracer:
    vertices, faces = torch.from_numpy(hull.vertices_world), torch.from_numpy(hull.faces).int()
    grey = torch.full((len(vertices),), 0.5)
    return build_tracer(TriangleMesh(vertices, faces, vertex_normals(vertices, faces), grey[:, None].repeat(1, 3), grey, grey))


def _cut_mask(views: Views, index: int, whole: AbstractTracer, within: AbstractTracer, box: BuildBox) -> CutMask:
    camera, coverage = views.cameras[index], views.coverage[index]
    origin, directions = pixel_rays_world(camera)
    pixels = (coverage.flatten() > 0).nonzero().squeeze(1)
    direction = directions.reshape(-1, 3)[pixels].contiguous()
    start = origin.expand_as(direction).contiguous()
    hits = trace_rays(start, direction, whole)
    inside = hits.hit & box.holds(start + hits.distance.nan_to_num(posinf=0.0)[:, None] * direction)
    would_show = trace_rays(start, direction, within).hit
    met, kept = torch.zeros(coverage.numel(), dtype=torch.bool), torch.zeros(coverage.numel(), dtype=torch.bool)
    met[pixels], kept[pixels] = hits.hit, inside
    as_nearest = _as_nearest_met(kept.reshape(coverage.shape).numpy(), met.reshape(coverage.shape).numpy())
    solid = coverage.flatten()[pixels] > HALF
    hidden, all_of_it = int((would_show & hits.hit & ~inside & solid).sum()), int((would_show & solid).sum())
    return CutMask(torch.where(torch.from_numpy(as_nearest), coverage, 0), hidden / max(all_of_it, 1))


def _as_nearest_met(kept: Bool[ndarray, "height width"], met: Bool[ndarray, "height width"]) -> Bool[ndarray, "height width"]:
    """Masks reach a little beyond the hull: what meets nothing is taken as the nearest pixel that does. All is kept where none does, for then nothing is known."""
    if not met.any():
        return np.ones_like(kept)
    row, column = distance_transform_edt(~met, return_distances=False, return_indices=True)
    return kept[row, column]
