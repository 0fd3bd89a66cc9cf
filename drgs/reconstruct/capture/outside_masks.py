"""How far places lie outside of what masks allow: the visual hull as a distance, of masks that are believed.

In: views with masks. Out: distances of points. What depth maps fuse to is cut by it: they fill a gap that is as narrow as their truncation, which few
views see through.
Source: Laurentini 1994 (docs/sources.md: laurentini1994).
"""

import torch
import warp as wp
from jaxtyping import Float
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from drgs.maths.constants import UNBOUNDED
from drgs.reconstruct.capture.mask_stack import MaskStack, between, corner_of, seen_at
from drgs.reconstruct.capture.visual_hull import HULL, VisualHullSettings, believed_views, with_small_masks
from drgs.scene.views import Views
from drgs.warp_torch import launch, thread_pool, warp_array, warp_device

wp.set_module_options({"enable_backward": False})

SLACK = 1.0
"""[pixels] outside its outline that a mask still allows: outlines are rough by as much."""
TOGETHER = 64
"""Points that are asked about one view after the other, so that what they see of it stays in the cache."""
REACH = 16.0
"""[pixels] at which distances in the pictures end."""


@wp.kernel
def farthest_outside(
    first: int,
    points: wp.array[wp.vec3],
    pixel_from_world: wp.array[wp.vec4],
    sizes: wp.array[wp.vec2i],
    distances: wp.array3d[float],
    focal: wp.array[float],
    together: int,
    # outputs
    outside: wp.array[float],
):
    """One thread so many points `together`, which lie beside each other, as their pixels do: the largest distance [world units] of all views that see
    each, and what is there already."""
    start = together * (first + wp.tid())
    end = wp.min(start + together, points.shape[0])
    for view in range(distances.shape[0]):
        for i in range(start, end):
            place = seen_at(pixel_from_world, sizes, view, points[i])
            if place[2] > 0.0:
                column = corner_of(place[0], sizes[view][0])
                row = corner_of(place[1], sizes[view][1])
                u = between(place[0], column)
                v = between(place[1], row)
                top = distances[view, row, column] * (1.0 - u) + distances[view, row, column + 1] * u
                bottom = distances[view, row + 1, column] * (1.0 - u) + distances[view, row + 1, column + 1] * u
                outside[i] = wp.max(outside[i], (top * (1.0 - v) + bottom * v) * place[2] / focal[view])


class OutsideMasks:
    """Masks as signed distances, for many queries."""

    def __init__(self, views: Views, settings: VisualHullSettings = HULL) -> None:
        small = with_small_masks(views, settings.mask_side)
        believed = believed_views(views, settings)
        self._masks = MaskStack.of(small).chosen(believed)
        distances = torch.zeros(self._masks.masks.shape)
        list(thread_pool().map(lambda view: _write_distances(self._masks, distances, view), range(len(believed))))
        self._distances = distances

    def __call__(self, points: Float[Tensor, "point 3"]) -> Float[Tensor, "point"]:
        """Distances [world units], positive where a mask leaves the point out by more than SLACK; views that do not see it say nothing."""
        points = points.float().cpu().contiguous()
        outside = torch.full((len(points),), -UNBOUNDED)
        inputs = [*self._masks.inputs(points)[:3], warp_array(self._distances), warp_array(self._masks.focal), TOGETHER]
        launch(farthest_outside, -(-len(points) // TOGETHER), inputs=inputs, outputs=[warp_array(outside)], device=warp_device(points))
        return outside


def _write_distances(masks: MaskStack, distances: Float[Tensor, "view height width"], view: int) -> None:
    width, height = masks.sizes[view].tolist()
    inside = masks.masks[view, :height, :width].numpy() > 127
    # A pixel's middle next to the outline is half a pixel away from it.
    signed = distance_transform_edt(~inside) - distance_transform_edt(inside)
    signed = signed - 0.5 * (signed > 0) + 0.5 * (signed < 0)
    distances[view, :height, :width] = torch.from_numpy(signed.clip(-REACH, REACH)).float() - SLACK
