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
