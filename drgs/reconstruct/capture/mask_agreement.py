"""How far each mask is what all masks together imply: its agreement with the silhouette of their visual hull.

The hull lies inside every silhouette, but for those that are left out. So where poses and masks belong together, hull and mask fill the same pixels; a
mask of something else holds what the hull cannot explain, and an object that moved leaves a hull that is too small for all masks
(Laurentini 1994, docs/sources.md: laurentini1994). In: views, the hull's vertices. Out: 0..1 of each view.
"""

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy import ndarray
from torch import Tensor

from drgs.reconstruct.capture.initial_points import project_points
from drgs.scene.views import Views

EXAMINED_VERTICES = 20_000
CELLS = 100
"""Across a picture: so wide that vertices leave no holes."""


def mask_agreement(views: Views, hull_vertices: Float[Tensor, "vertex 3"]) -> Float[ndarray, "view"]:
    """Of each view: the share of what its mask and the hull's silhouette fill that is no farther than a cell from both; 0 where neither fills one."""
    vertices = hull_vertices.numpy()[:: 1 + len(hull_vertices) // EXAMINED_VERTICES]
    agreement = []
    for camera, coverage in zip(views.cameras, views.coverage, strict=True):
        stride = max(1, coverage.shape[-1] // CELLS)
        mask = torch.nn.functional.max_pool2d((coverage > 127).float()[None], stride, stride, ceil_mode=True) > 0
        column, row, seen, _ = project_points(camera, vertices)
        drawn = torch.zeros_like(mask)
        drawn[0, row[seen] // stride, column[seen] // stride] = True
        # Vertices are a surface: in views from close by they leave cells inside the outline empty.
        hull = ~_grown(~_grown(drawn))
        apart = (mask & ~_grown(hull)) | (hull & ~_grown(mask))
        either = int((mask | hull).sum())
        agreement.append(1 - int(apart.sum()) / either if either else 0.0)
    return np.array(agreement)


def _grown(cells: Bool[Tensor, "1 row column"]) -> Bool[Tensor, "1 row column"]:
    """By one cell on all sides."""
    return torch.nn.functional.max_pool2d(cells.float(), 3, 1, 1) > 0
