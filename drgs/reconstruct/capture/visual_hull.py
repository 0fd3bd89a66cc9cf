"""The visual hull: the largest shape that fits inside every silhouette, carved from masks.

In: cameras and coverage. Out: a closed surface and the sphere that bounds it. Knows nothing of colours or Gaussians.
The field at a point is the smallest coverage over the views that see the point, but for views that carve away what the others need
(wrong_masks.py). What hardly any view sees is not the object: where it fills their pictures, they would say that it reaches up to
them. The surface is the field's level set, found coarse to fine.
Source: Laurentini 1994, "The visual hull concept"; marching cubes by scikit-image.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
import warp as wp
from jaxtyping import Float, Int, Shaped
from numpy import ndarray
from scipy import ndimage
from skimage.measure import marching_cubes
from torch import Tensor

from drgs.reconstruct.capture.build_box import BuildBox
from drgs.reconstruct.capture.mask_stack import MaskStack, between, corner_of, seen_at
from drgs.reconstruct.capture.wrong_masks import MOST_CARVERS, find_carved, wrong_masks
from drgs.scene.views import Views
from drgs.warp_torch import launch, warp_array, warp_device

FEWEST_SEEN = 3
"""Views that must see a place of the object."""
BETWEEN = 1
"""[pixels] farther that lookups see, which are bilinear."""
FEWEST_FOR_DOUBT = 12
"""Of fewer views none is left out: where one carves, too few others say that it should not."""


@dataclass(frozen=True)
class VisualHullSettings:
    coarse_cells: int = 64
    """Cells along the longest axis of the box in which the object is looked for."""
    fine_cells: int = 192
    """Cells along the longest axis of the box that holds the object; fewer where masks are small."""
    cell_pixels: float = 0.5
    """No cell is smaller than this share of a pixel of the masks: those say no more."""
    wrong_mask_share: float = 0.03
    """Share of the views whose masks may be wrong, at least one and at most MOST_CARVERS."""
    wrong_mask_cells: int = 128
    """Cells along the longest axis in which it is looked for wrong masks."""
    wrong_mask_side: int = 256
    """As mask_side, there."""
    mask_side: int = 512
    """Larger masks are averaged down to at most this [pixels]: finer ones outdo the grid."""
    seen_share: float = 0.5
    """Of the views that see the best seen place of the object, how many must see all others."""
    level: float = 0.4
    """Coverage that counts as object; below one half so that details as wide as a cell survive."""
    smallest_part: float = 0.002
    """Parts smaller than this share of the largest are dropped."""


HULL = VisualHullSettings()
"""Where nobody says otherwise."""


@dataclass(frozen=True, eq=False)
class VisualHull:
    """A closed surface around the object."""

    vertices_world: Float[ndarray, "vertex 3"]
    faces: Int[ndarray, "face 3"]
    """Counter-clockwise seen from outside."""
    cell: float
    """Edge of a voxel [world units]."""


@wp.kernel
def smallest_coverage(
    first: int,
    points: wp.array[wp.vec3],
    pixel_from_world: wp.array[wp.vec4],
    sizes: wp.array[wp.vec2i],
    masks: wp.array3d[wp.uint8],
    fewest_seen: int,
    # outputs
    field: wp.array[float],
):
    """One thread a point: the smallest coverage, looked up bilinearly, over the views that see the point; 0 where too few do."""
    i = first + wp.tid()
    smallest = float(1.0)  # Warp: a variable that a loop changes must not be a constant
    seen = int(0)
    for view in range(masks.shape[0]):
        place = seen_at(pixel_from_world, sizes, view, points[i])
        # A view that does not see the point says nothing about it.
        if place[2] > 0.0:
            seen += 1
            column = corner_of(place[0], sizes[view][0])
            row = corner_of(place[1], sizes[view][1])
            u = between(place[0], column)
            v = between(place[1], row)
            top = float(masks[view, row, column]) * (1.0 - u) + float(masks[view, row, column + 1]) * u
            bottom = float(masks[view, row + 1, column]) * (1.0 - u) + float(masks[view, row + 1, column + 1]) * u
            smallest = wp.min(smallest, (top * (1.0 - v) + bottom * v) / 255.0)
            if smallest <= 0.0:
                break
    field[i] = wp.where(seen >= fewest_seen, smallest, 0.0)


def visual_hull(views: Views, settings: VisualHullSettings = HULL, box: BuildBox | None = None) -> VisualHull | None:
    """Carve the hull; None where the masks have no common shape.

    Args:
        box: cuts it flat, and cells are the smaller; None where it holds nothing of the hull.
    """
    masks = MaskStack.of(with_small_masks(views, settings.mask_side))
    found = _object_box(views, settings)
    if found is None:
        return None
    carver = _Carver(masks.chosen(_believed(found, settings)), found.fewest_seen)
    lower, upper = found.lower, found.upper
    if box is None:
        return _fine_surface(carver, lower, upper, settings)
    lower, upper = np.maximum(lower, box.low), np.minimum(upper, box.high)
    hull = _fine_surface(carver, lower, upper, settings) if (lower < upper).all() else None
    # Cells are whole, so the grid ends up to one of them behind the box.
    return hull and replace(hull, vertices_world=hull.vertices_world.clip(box.low, box.high).astype(np.float32))


def believed_views(views: Views, settings: VisualHullSettings = HULL) -> list[int]:
    """Numbers of the views whose masks carve the hull: those that carve away what the others need are left out."""
    found = _object_box(views, settings)
    return list(range(len(views.cameras))) if found is None else _believed(found, settings)


@dataclass(frozen=True, eq=False)
class _ObjectBox:
    """Where the object may be, by coarse masks."""

    masks: MaskStack
    lower: Float[ndarray, "3"]
    upper: Float[ndarray, "3"]
    fewest_seen: int
    """Views that must see a place of it."""


def _object_box(views: Views, settings: VisualHullSettings) -> _ObjectBox | None:
    """As many masks may be wrong as ever; None where the masks have no common shape."""
    masks, first = MaskStack.of(with_small_masks(views, settings.wrong_mask_side)), _first_box(views)
    if first is None:
        return None
    lower, upper = first
    for _ in range(4):  # possibly the first guess cuts the object: grow it until nothing touches its sides
        cell = float((upper - lower).max()) / settings.coarse_cells
        shape = _grid_shape(lower, upper, cell)
        carved = find_carved(masks, _grid_points(lower, cell, shape), cell, settings.level)
        occupied = (carved.carvers <= _most_wrong(masks, settings)) & (carved.seen >= FEWEST_SEEN)
        if not bool(occupied.any()):
            return None
        fewest_seen = max(FEWEST_SEEN, math.ceil(settings.seen_share * int(carved.seen[occupied].max())))
        occupied = (occupied & (carved.seen >= fewest_seen)).reshape(shape)
        sides = [occupied[0], occupied[-1], occupied[:, 0], occupied[:, -1], occupied[:, :, 0], occupied[:, :, -1]]
        if not any(bool(side.any()) for side in sides):
            break
        center, half = (lower + upper) / 2, (upper - lower) / 2
        lower, upper = center - 1.5 * half, center + 1.5 * half
    indices = torch.nonzero(occupied)
    lower = lower + (indices.min(0).values.double().numpy() - 1.0) * cell
    upper = lower + (indices.max(0).values - indices.min(0).values + 3).double().numpy() * cell
    return _ObjectBox(masks, lower, upper, fewest_seen)


def _most_wrong(masks: MaskStack, settings: VisualHullSettings) -> int:
    """Masks that may be left out."""
    count = len(masks.masks)
    return min(MOST_CARVERS, math.ceil(settings.wrong_mask_share * count)) if count >= FEWEST_FOR_DOUBT else 0


def _believed(found: _ObjectBox, settings: VisualHullSettings) -> list[int]:
    cell = float((found.upper - found.lower).max()) / settings.wrong_mask_cells
    points = _grid_points(found.lower, cell, _grid_shape(found.lower, found.upper, cell))
    wrong = wrong_masks(found.masks, points, cell, settings.level, found.fewest_seen, _most_wrong(found.masks, settings))
    return [view for view in range(len(found.masks.masks)) if view not in wrong]


def axes_meeting_point(centers: Float[ndarray, "view 3"], directions: Float[ndarray, "view 3"]) -> Float[ndarray, "3"]:
    """The point with the least sum of squared distances to the lines; pulled weakly in front of parallel axes."""
    projectors = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    matrix = projectors.sum(0)
    right = (projectors @ centers[:, :, None]).sum(0)[:, 0]
    spread = np.linalg.norm(centers - centers.mean(0), axis=1).mean()
    fallback = (centers + directions * spread).mean(0)
    weight = 1e-4 * len(centers)
    return np.linalg.solve(matrix + weight * np.eye(3), right + weight * fallback)


def camera_geometry(views: Views) -> tuple[Float[ndarray, "view 4 4"], Float[ndarray, "view 3 3"], Float[ndarray, "view 3"]]:
    """Float64 (view, 4, 4) camera_from_world, (view, 3, 3) intrinsics, (view, 3) centres."""
    camera_from_world = torch.stack([camera.camera_from_world for camera in views.cameras]).double().cpu().numpy()
    intrinsics = torch.stack([camera.intrinsics for camera in views.cameras]).double().cpu().numpy()
    centers = -np.einsum("vji,vj->vi", camera_from_world[:, :3, :3], camera_from_world[:, :3, 3])
    return camera_from_world, intrinsics, centers


def with_small_masks(views: Views, side: int) -> Views:
    """Masks averaged over squares of whole pixels, cameras to match; the pictures are left alone, nothing here reads them."""
    cameras, masks = [], []
    for camera, mask in zip(views.cameras, views.coverage, strict=True):
        factor = math.ceil(max(mask.shape) / side)
        if factor > 1:
            mask = torch.nn.functional.avg_pool2d(mask.float()[None], factor, ceil_mode=True)[0].round().to(torch.uint8)
            shrink = torch.diag(torch.tensor([1 / factor, 1 / factor, 1.0]))
            camera = replace(camera, intrinsics=shrink @ camera.intrinsics, width=mask.shape[1], height=mask.shape[0])
        cameras.append(camera)
        masks.append(mask)
    return replace(views, cameras=tuple(cameras), coverage=tuple(masks))


def _first_box(views: Views) -> tuple[Float[ndarray, "3"], Float[ndarray, "3"]] | None:
    """Cube around the point where rays through the mask centroids meet, as large as the masks' cones are there."""
    camera_from_world, intrinsics, centers = camera_geometry(views)
    kept, directions, corner_rays = [], [], []
    for index, mask in enumerate(coverage.numpy() for coverage in views.coverage):
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
    """Masks that are believed, for many queries."""

    def __init__(self, masks: MaskStack, fewest_seen: int) -> None:
        # Neighbours in the file are neighbours in space; views far apart empty a point sooner.
        order = np.argsort((np.arange(len(masks.masks)) * 0.6180339887) % 1.0)
        self.masks, self.fewest_seen = masks.chosen(order.tolist()), fewest_seen

    def upper_field(self, points: Float[Tensor, "point 3"], cell: float) -> Float[Tensor, "point"]:
        """At least the field (n,) anywhere in a cell around each point (n, 3)."""
        return self._smallest(points, self._widened(points, cell, ndimage.maximum_filter))

    def lower_field(self, points: Float[Tensor, "point 3"], cell: float) -> Float[Tensor, "point"]:
        """At most the field (n,) anywhere in a cell around each point (n, 3)."""
        return self._smallest(points, self._widened(points, cell, ndimage.minimum_filter))

    def field(self, points: Float[Tensor, "point 3"]) -> Float[Tensor, "point"]:
        """The field (n,) at `points` (n, 3)."""
        return self._smallest(points, self.masks)

    def pixel_side(self, point: Float[ndarray, "3"]) -> float:
        """Of the finest pixel of all views, at that place in the world [world units]."""
        depths = self.masks.pixel_from_world[:, 2].double().numpy() @ np.append(point, 1.0)
        sides = [depth / focal for depth, focal in zip(depths, self.masks.focal.tolist(), strict=True) if depth > 0]
        return min(sides, default=0.0)

    def _widened(self, points: Float[Tensor, "point 3"], cell: float, widen: Callable[[ndarray, int], ndarray]) -> MaskStack:
        return self.masks.widened(widen, [reach + BETWEEN for reach in self.masks.reach(points.mean(0), cell)])

    def _smallest(self, points: Float[Tensor, "point 3"], masks: MaskStack) -> Float[Tensor, "point"]:
        points = points.float().contiguous()
        field = torch.zeros(len(points))
        inputs = [*masks.inputs(points), self.fewest_seen]
        launch(smallest_coverage, len(points), inputs=inputs, outputs=[warp_array(field)], device=warp_device(points))
        return field


def _grid_shape(lower: Float[ndarray, "3"], upper: Float[ndarray, "3"], cell: float) -> tuple[int, int, int]:
    x, y, z = (max(2, int(count)) for count in np.ceil((upper - lower) / cell - 1e-6))
    return x, y, z


def _grid_points(lower: Float[ndarray, "3"], cell: float, shape: tuple[int, int, int]) -> Float[Tensor, "point 3"]:
    """(x·y·z, 3) cell centres."""
    axes = [torch.from_numpy(lower[axis] + (np.arange(shape[axis]) + 0.5) * cell).float() for axis in range(3)]
    return torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)


def _refined(grid: Shaped[Tensor, "x y z"]) -> Shaped[Tensor, "2*x 2*y 2*z"]:
    """Each cell becomes 2x2x2."""
    return grid.repeat_interleave(2, 0).repeat_interleave(2, 1).repeat_interleave(2, 2).contiguous()


def _fine_surface(
    carver: _Carver, lower: Float[ndarray, "3"], upper: Float[ndarray, "3"], settings: VisualHullSettings
) -> VisualHull | None:
    """Level set on the fine grid. Cells that the coarse grid proves empty or full are not looked at again."""
    cell = max(float((upper - lower).max()) / settings.fine_cells, settings.cell_pixels * carver.pixel_side((lower + upper) / 2))
    coarse_cell = 2 * cell
    coarse_shape = _grid_shape(lower, upper, coarse_cell)
    coarse_points = _grid_points(lower, coarse_cell, coarse_shape)
    maybe = carver.upper_field(coarse_points, coarse_cell) > settings.level
    sure = torch.zeros_like(maybe)
    sure[maybe] = carver.lower_field(coarse_points[maybe], coarse_cell) > settings.level
    field = _refined(sure.float().reshape(coarse_shape))
    undecided = _refined((maybe & ~sure).reshape(coarse_shape))
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
