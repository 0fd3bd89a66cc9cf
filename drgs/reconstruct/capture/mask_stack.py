"""All masks of a capture as kernels take them: one array, with the projections that lead into it.

In: views. Out: masks of one size, those of several sizes side by side; widened by what a cell of space covers.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
import warp as wp
from jaxtyping import Float, Int32, UInt8
from numpy import ndarray
from torch import Tensor

from drgs.scene.views import Views
from drgs.warp_torch import warp_array

HALF_DIAGONAL = 0.87 * 1.15
"""Of a cell, and a little more where it lies nearer than the others."""
HALF_SIDE = 0.6
"""Of a cell, and a little more."""


@wp.func
def seen_at(pixel_from_world: wp.array[wp.vec4], sizes: wp.array[wp.vec2i], view: int, world: wp.vec3) -> wp.vec3:
    """Where a view sees a point: column and row [pixels], depth along its axis; depth 0 where it does not."""
    point = wp.vec4(world[0], world[1], world[2], 1.0)
    depth = wp.dot(pixel_from_world[3 * view + 2], point)
    place = wp.vec3(0.0, 0.0, 0.0)
    if depth > 0.0:
        x = wp.dot(pixel_from_world[3 * view], point) / depth
        y = wp.dot(pixel_from_world[3 * view + 1], point) / depth
        if x >= 0.0 and y >= 0.0 and x < float(sizes[view][0]) and y < float(sizes[view][1]):
            place = wp.vec3(x, y, depth)
    return place


@wp.func
def corner_of(x: float, count: int) -> int:
    """The first of the two pixels of a row, or a column, between whose middles x lies."""
    return wp.min(int(wp.clamp(x - 0.5, 0.0, float(count - 1))), count - 2)


@wp.func
def between(x: float, corner: int) -> float:
    """How far x lies from the middle of that pixel to the next one's, 0..1."""
    return wp.clamp(x - 0.5 - float(corner), 0.0, 1.0)


@dataclass(frozen=True, eq=False)
class MaskStack:
    """Masks and projections of all views."""

    masks: UInt8[Tensor, "view height width"]
    """255: object; as large as the largest, 0 where a smaller one ends."""
    sizes: Int32[Tensor, "view 2"]
    """Width and height of each [pixels]."""
    pixel_from_world: Float[Tensor, "view 3 4"]
    focal: Float[Tensor, "view"]
    """[pixels]"""

    @classmethod
    def of(cls, views: Views) -> "MaskStack":
        heights, widths = ([mask.shape[axis] for mask in views.coverage] for axis in (0, 1))
        stacked = torch.zeros(len(heights), max(heights), max(widths), dtype=torch.uint8)
        for place, mask in zip(stacked, views.coverage, strict=True):
            place[: mask.shape[0], : mask.shape[1]] = mask
        projections = [(c.intrinsics.double() @ c.camera_from_world.double()[:3]).float().cpu() for c in views.cameras]
        focal = torch.stack([camera.intrinsics[0, 0].cpu() for camera in views.cameras]).float()
        return cls(stacked, torch.tensor([widths, heights], dtype=torch.int32).T.contiguous(), torch.stack(projections), focal)

    def chosen(self, views: list[int]) -> "MaskStack":
        """Those of some views."""
        return MaskStack(*(values[views].contiguous() for values in vars(self).values()))

    def reach(self, middle: Float[Tensor, "3"], cell: float, half: float = HALF_DIAGONAL) -> list[int]:
        """[pixels] of each view that so many cells around `middle` cover."""
        depths = self.pixel_from_world[:, 2] @ torch.cat([middle, torch.ones(1)])
        within = (int(side) // 2 for side in self.sizes.amin(1))
        wide = (half * cell * focal / max(float(depth), 2 * cell) for depth, focal in zip(depths, self.focal.tolist(), strict=True))
        return [min(math.ceil(pixels), most) for pixels, most in zip(wide, within, strict=True)]

    def widened(self, widen: Callable[[ndarray, int], ndarray], reaches: list[int]) -> "MaskStack":
        """In which each pixel stands for so many around it in each view."""
        masks = torch.zeros_like(self.masks)
        views = zip(masks, self.masks, self.sizes.tolist(), reaches, strict=True)
        for wide, mask, (width, height), reach in views:
            wide[:height, :width] = torch.from_numpy(np.ascontiguousarray(widen(mask[:height, :width].numpy(), 2 * reach + 1)))
        return replace(self, masks=masks)

    def inputs(self, points: Float[Tensor, "point 3"]) -> list[object]:
        """As kernels take them: points, projections, sizes, masks."""
        return [
            warp_array(points, wp.vec3),
            warp_array(self.pixel_from_world.reshape(-1, 4), wp.vec4),
            warp_array(self.sizes, wp.vec2i),
            warp_array(self.masks),
        ]
