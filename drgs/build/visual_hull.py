"""The visual hull: the largest shape that fits inside every silhouette, carved from masks.

In: cameras and coverage. Out: a closed surface and the sphere that bounds it. Knows nothing of colours or Gaussians.
The field at a point is the (k+1)-th smallest coverage over the views that see the point, so up to k wrong masks are outvoted;
k is a few percent of the views. The surface is the field's level set, found coarse to fine.
Source: Laurentini 1994, "The visual hull concept"; marching cubes by scikit-image.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy import ndarray
from scipy import ndimage
from skimage.measure import marching_cubes
from torch import Tensor

from drgs.scene.views import Views

_Lookup = Callable[[int, Tensor, Tensor, Tensor], Tensor]
"""View, pixel x, pixel y, depth (each (n,)) → (channels, n)."""


@dataclass(frozen=True)
class VisualHullSettings:
    coarse_cells: int = 64
    """Cells along the longest axis of the box in which the object is looked for."""
    fine_cells: int = 144
    """Cells along the longest axis of the box that holds the object."""
    wrong_mask_share: float = 0.03
    """Share of the views whose masks may be wrong."""
    level: float = 0.4
    """Coverage that counts as object; below one half so that details as wide as a cell survive."""
    smallest_part: float = 0.002
    """Parts smaller than this share of the largest are dropped."""


@dataclass(frozen=True, eq=False)
class VisualHull:
    """A closed surface around the object."""

    vertices_world: Float[ndarray, "vertex 3"]
    faces: Int[ndarray, "face 3"]
    """Counter-clockwise seen from outside."""
    cell: float
    """Edge of a voxel [world units]."""


def visual_hull(views: Views, settings: VisualHullSettings = VisualHullSettings()) -> VisualHull | None:
    """Carve the hull; None where the masks have no common shape."""
    carver = _Carver(views, settings)
    box = _first_box(views)
    if box is None:
        return None
    for _ in range(4):  # possibly the first guess cuts the object: grow it until nothing touches its sides
        lower, upper = box
        cell = float((upper - lower).max()) / settings.coarse_cells
        shape = _grid_shape(lower, upper, cell)
        maybe, _ = carver.bounds_of_field(_grid_points(lower, cell, shape), cell)
        occupied = (maybe > settings.level).reshape(shape)
        if not occupied.any():
            return None
        sides = [occupied[0], occupied[-1], occupied[:, 0], occupied[:, -1], occupied[:, :, 0], occupied[:, :, -1]]
        if not any(bool(side.any()) for side in sides):
            break
        center, half = (lower + upper) / 2, (upper - lower) / 2
        box = center - 1.5 * half, center + 1.5 * half
    indices = torch.nonzero(occupied)
    lower = lower + (indices.min(0).values.double().numpy() - 1.0) * cell
    upper = lower + (indices.max(0).values - indices.min(0).values + 3).double().numpy() * cell
    return _fine_surface(carver, lower, upper, settings)


def axes_meeting_point(centers: Float[ndarray, "view 3"], directions: Float[ndarray, "view 3"]) -> Float[ndarray, "3"]:
    """The point with the least sum of squared distances to the lines; pulled weakly in front of parallel axes."""
    projectors = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    matrix = projectors.sum(0)
    right = (projectors @ centers[:, :, None]).sum(0)[:, 0]
    spread = np.linalg.norm(centers - centers.mean(0), axis=1).mean() + 1e-9
    fallback = (centers + directions * spread).mean(0)
    weight = 1e-4 * len(centers)
    return np.linalg.solve(matrix + weight * np.eye(3), right + weight * fallback)


def camera_geometry(views: Views) -> tuple[ndarray, ndarray, ndarray]:
    """Float64 (view, 4, 4) camera_from_world, (view, 3, 3) intrinsics, (view, 3) centres."""
    camera_from_world = torch.stack([camera.camera_from_world for camera in views.cameras]).double().cpu().numpy()
    intrinsics = torch.stack([camera.intrinsics for camera in views.cameras]).double().cpu().numpy()
    centers = -np.einsum("vji,vj->vi", camera_from_world[:, :3, :3], camera_from_world[:, :3, 3])
    return camera_from_world, intrinsics, centers


def _first_box(views: Views) -> tuple[ndarray, ndarray] | None:
    """Cube around the point where rays through the mask centroids meet, as large as the masks' cones are there."""
    camera_from_world, intrinsics, centers = camera_geometry(views)
    coverage = views.coverage.cpu().numpy()
    kept, directions, corner_rays = [], [], []
    for index, mask in enumerate(coverage):
        ys, xs = np.nonzero(mask[::2, ::2] > 127)
        if len(xs) == 0:
            continue
        x0, x1, y0, y1 = 2 * xs.min(), 2 * xs.max() + 2, 2 * ys.min(), 2 * ys.max() + 2
        pixels = np.array([[2 * xs.mean() + 1, 2 * ys.mean() + 1, 1], [x0, y0, 1], [x1, y0, 1], [x0, y1, 1], [x1, y1, 1]])
        rays = pixels @ np.linalg.inv(intrinsics[index]).T @ camera_from_world[index, :3, :3]
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        kept.append(index)
        directions.append(rays[0])
        corner_rays.append(rays[1:])
    if len(kept) < 3:
        return None
    center = axes_meeting_point(centers[kept], np.array(directions))
    to_center = center - centers[kept]
    distance = np.linalg.norm(to_center, axis=1)
    cosines = np.einsum("vki,vi->vk", np.array(corner_rays), to_center / distance[:, None]).min(1)
    radius = float(np.percentile(distance * np.sqrt(1 - np.clip(cosines, 0, 1) ** 2), 90))
    # Never around a camera: what is that near cannot be the object.
    radius = min(1.1 * radius, 0.95 * float(distance.min()))
    return center - radius, center + radius


class _Carver:
    """Masks and projections, prepared once for many queries."""

    def __init__(self, views: Views, settings: VisualHullSettings) -> None:
        self.masks = views.coverage.cpu().numpy()
        self.projections = [(c.intrinsics.double() @ c.camera_from_world.double()[:3]).float().cpu() for c in views.cameras]
        self.focal = float(np.median([float(camera.intrinsics[0, 0]) for camera in views.cameras]))
        count = len(views.cameras)
        self.outvoted = math.ceil(settings.wrong_mask_share * count) if count >= 12 else 0
        self.fewest_seen = max(3, count // 4)
        # Neighbours in the file are neighbours in space; views far apart empty the grid sooner.
        self.order = np.argsort((np.arange(count) * 0.6180339887) % 1.0).tolist()

    def bounds_of_field(self, points: Tensor, cell: float) -> tuple[Tensor, Tensor]:
        """Upper and lower bounds (n,) of the field within each cell around `points` (n, 3)."""

        def lookup(view: int, x: Tensor, y: Tensor, depth: Tensor) -> Tensor:
            # Half the cell's diagonal as seen from there, in steps that keep the number of filter sizes small.
            pixels = max(1, math.ceil(0.87 * cell * self.focal / float(depth.median().clamp(min=cell))))
            size = 2 * min(pixels, min(self.masks[view].shape) // 2) + 1
            pair = np.stack([ndimage.maximum_filter(self.masks[view], size), ndimage.minimum_filter(self.masks[view], size)])
            return _nearest_pixels(torch.from_numpy(pair).float() / 255, x, y)

        upper, lower = self._outvote(points, 2, lookup)
        return upper, lower

    def field(self, points: Tensor) -> Tensor:
        """The field (n,) at `points` (n, 3), coverage looked up bilinearly."""

        def lookup(view: int, x: Tensor, y: Tensor, depth: Tensor) -> Tensor:
            mask = torch.from_numpy(self.masks[view])[None, None].float() / 255
            height, width = mask.shape[-2:]
            grid = torch.stack([x * (2 / width) - 1, y * (2 / height) - 1], -1)[None, None]
            return torch.nn.functional.grid_sample(mask, grid, align_corners=False, padding_mode="border")[0, 0]

        return self._outvote(points, 1, lookup)[0]

    def _outvote(self, points: Tensor, channels: int, lookup: _Lookup) -> Tensor:
        """(channels, n): the (outvoted+1)-th smallest of what the views that see a point say there."""
        result = torch.zeros(channels, len(points))
        alive = torch.arange(len(points))
        smallest = torch.full((self.outvoted + 1, channels, len(points)), 2.0)
        seen = torch.zeros(len(points))
        height, width = self.masks.shape[-2:]
        for step, view in enumerate(self.order):
            projection = self.projections[view]
            projected = points @ projection[:, :3].T + projection[:, 3]
            depth = projected[:, 2]
            x, y = projected[:, 0] / depth.clamp(min=1e-6), projected[:, 1] / depth.clamp(min=1e-6)
            inside = (depth > 1e-6) & (x >= 0) & (x < width) & (y >= 0) & (y < height)
            # A view that does not see the point says nothing about it.
            value = torch.where(inside, lookup(view, x, y, depth), 2.0)
            seen += inside
            for rank in range(self.outvoted + 1):
                smallest[rank], value = torch.minimum(smallest[rank], value), torch.maximum(smallest[rank], value)
            if step % 4 == 3:  # what has been emptied stays empty: do not look at it again
                kept = smallest[-1, 0] > 0
                if not kept.any():
                    return result
                points, alive, seen, smallest = points[kept], alive[kept], seen[kept], smallest[:, :, kept]
        result[:, alive] = torch.where(seen >= self.fewest_seen, smallest[-1].clamp(max=1.0), 0.0)
        return result


def _nearest_pixels(image: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """(channels, n) values of image (channels, h, w), clamped at its sides."""
    height, width = image.shape[-2:]
    return image.reshape(len(image), -1)[:, y.clamp(0, height - 1).long() * width + x.clamp(0, width - 1).long()]


def _grid_shape(lower: ndarray, upper: ndarray, cell: float) -> tuple[int, int, int]:
    x, y, z = (max(2, int(count)) for count in np.ceil((upper - lower) / cell - 1e-6))
    return x, y, z


def _grid_points(lower: ndarray, cell: float, shape: tuple[int, int, int]) -> Tensor:
    """(x·y·z, 3) cell centres."""
    axes = [torch.from_numpy(lower[axis] + (np.arange(shape[axis]) + 0.5) * cell).float() for axis in range(3)]
    return torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)


def _fine_surface(carver: _Carver, lower: ndarray, upper: ndarray, settings: VisualHullSettings) -> VisualHull | None:
    """Level set on the fine grid. Cells that the coarse grid proves empty or full are not looked at again."""
    cell = float((upper - lower).max()) / settings.fine_cells
    coarse_cell = 2 * cell
    coarse_shape = _grid_shape(lower, upper, coarse_cell)
    maybe, sure = carver.bounds_of_field(_grid_points(lower, coarse_cell, coarse_shape), coarse_cell)
    field_coarse = torch.where(sure > settings.level, 1.0, 0.0).reshape(coarse_shape)
    field = field_coarse.repeat_interleave(2, 0).repeat_interleave(2, 1).repeat_interleave(2, 2).contiguous()
    undecided = ((maybe > settings.level) & (sure <= settings.level)).reshape(coarse_shape)
    undecided = undecided.repeat_interleave(2, 0).repeat_interleave(2, 1).repeat_interleave(2, 2)
    indices = torch.nonzero(undecided)
    points = torch.from_numpy(lower).float() + (indices.float() + 0.5) * cell
    field[undecided] = carver.field(points)

    volume = field.numpy()
    parts, part_count = ndimage.label(volume > settings.level)
    if part_count == 0:
        return None
    sizes = np.bincount(parts.reshape(-1), minlength=part_count + 1)
    small = sizes < settings.smallest_part * sizes[1:].max()
    small[0] = False
    volume = np.where(small[parts], 0.0, volume)
    # A mask's edge is a step one pixel wide: a little blur makes its level set, and so the normals, smooth.
    volume = ndimage.gaussian_filter(np.pad(volume, 2).astype(np.float32), 0.7)
    if not volume.min() < settings.level < volume.max():
        return None
    vertices, faces, _, _ = marching_cubes(volume, settings.level)
    corners = vertices[faces]
    if np.einsum("fi,fi->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) < 0:  # signed volume: faces wind inwards
        faces = faces[:, ::-1]
    vertices_world = lower + (vertices - 2 + 0.5) * cell
    return VisualHull(vertices_world.astype(np.float32), np.ascontiguousarray(faces, dtype=np.int64), cell)
