"""Points from which Gaussians grow: the capture's sparse points, else the surface of the visual hull, else random.

In: Views. Out: points in world space with colours, normals where a surface is known, and the object's bounding sphere.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy.spatial import cKDTree
from torch import Tensor

from drgs.reconstruct.capture.build_box import BuildBox
from drgs.reconstruct.capture.visual_hull import HULL, VisualHull, VisualHullSettings, axes_meeting_point, camera_geometry, visual_hull
from drgs.scene.camera import Camera
from drgs.scene.views import Views

COLOR_VIEWS = 24
"""Views that vote on a point's colour."""
FEWEST_SPARSE_POINTS = 100
"""A capture with fewer sparse points on the object counts as having none."""
SMALLEST_MASK_AGREEMENT = 0.9
"""Share of the views that see a sparse point in which it must lie on the mask."""


@dataclass(frozen=True, eq=False)
class InitialPoints:
    """Where fit_gaussians starts."""

    points_world: Float[Tensor, "point 3"]
    normals_world: Float[Tensor, "point 3"] | None
    """Unit, outward; None where no surface is known."""
    colors_srgb: Float[Tensor, "point 3"]
    """0..1, median over the views that see the point; 0.5 where none does."""
    bounds_center: Float[Tensor, "3"]
    bounds_radius: float
    """Sphere around the object [world units]."""
    origin: str
    """sparse, hull, sparse+hull or random."""
    hull_vertices: Float[Tensor, "vertex 3"] | None
    hull_faces: Int[Tensor, "face 3"] | None


def initial_points(
    views: Views,
    count: int,
    seed: int,
    surface: VisualHull | None = None,
    box: BuildBox | None = None,
    hull_settings: VisualHullSettings = HULL,
) -> InitialPoints:
    """`count` points (fewer when the capture's own sparse points are all there is).

    Args:
        surface: a better one than the hull, on which points are to lie.
        box: of the build. Without masks the bounds are its own, and sparse points outside stay, for the pictures show what is there.

    Raises:
        ValueError: the masks have no common shape.
    """
    random = np.random.default_rng(seed)
    hull = visual_hull(views, hull_settings, box) if views.has_masks else None
    sparse = _sparse_points_on_object(views, box)
    surface = hull if surface is None else surface
    if sparse is not None and len(sparse[0]) >= FEWEST_SPARSE_POINTS:
        return _from_sparse(views, sparse, hull, surface, count, random, box)
    if hull is not None and surface is not None:
        points, normals = _sample_surface(surface, count, random)
        points = points if box is None else points.clip(box.low, box.high)
        colors = _median_colors(views, points, normals, surface)
        center, radius = _bounding_sphere(hull.vertices_world)
        return _record(points, normals, colors, center, radius, "hull", hull)
    if views.has_masks:
        raise ValueError(
            "the masks of this capture have no common shape: check that the poses belong to the images and that white means object."
        )
    center, radius = _sphere_without_masks(views, box)
    offsets = random.uniform(-1, 1, (count, 3))
    points = center + radius * offsets
    return _record(points, None, _median_colors(views, points, None, None), center, radius, "random", None)


def _record(
    points: Float[ndarray, "point 3"],
    normals: Float[ndarray, "point 3"] | None,
    colors: Float[ndarray, "point 3"],
    center: Float[ndarray, "3"],
    radius: float,
    origin: str,
    hull: VisualHull | None,
) -> InitialPoints:
    return InitialPoints(
        points_world=torch.from_numpy(np.ascontiguousarray(points, dtype=np.float32)),
        normals_world=None if normals is None else torch.from_numpy(np.ascontiguousarray(normals, dtype=np.float32)),
        colors_srgb=torch.from_numpy(np.ascontiguousarray(colors, dtype=np.float32)),
        bounds_center=torch.from_numpy(np.asarray(center, dtype=np.float32)),
        bounds_radius=float(radius),
        origin=origin,
        hull_vertices=None if hull is None else torch.from_numpy(hull.vertices_world),
        hull_faces=None if hull is None else torch.from_numpy(hull.faces),
    )


def _from_sparse(
    views: Views,
    sparse: tuple[ndarray, ndarray],
    hull: VisualHull | None,
    surface: VisualHull | None,
    count: int,
    random: np.random.Generator,
    box: BuildBox | None,
) -> InitialPoints:
    """The capture's points, filled up to `count` from the surface where there is one."""
    points, colors = sparse
    if len(points) > count:
        kept = random.choice(len(points), count, replace=False)
        points, colors = points[kept], colors[kept]
    if hull is None or surface is None:
        # Without masks the points are of the whole room; the object is where all cameras look.
        return _record(points, None, colors, *_sphere_without_masks(views, box), "sparse", None)
    center, radius = _bounding_sphere(hull.vertices_world)
    normals = _vertex_normals(surface)[cKDTree(surface.vertices_world).query(points)[1]]
    if len(points) == count:
        return _record(points, normals, colors, center, radius, "sparse", hull)
    more_points, more_normals = _sample_surface(surface, count - len(points), random)
    more_points = more_points if box is None else more_points.clip(box.low, box.high)
    more_colors = _median_colors(views, more_points, more_normals, surface)
    points, normals, colors = (np.concatenate(pair) for pair in ((points, more_points), (normals, more_normals), (colors, more_colors)))
    return _record(points, normals, colors, center, radius, "sparse+hull", hull)


def _sparse_points_on_object(views: Views, box: BuildBox | None) -> tuple[Float[ndarray, "point 3"], Float[ndarray, "point 3"]] | None:
    """The capture's points (n, 3) and colours (n, 3) without strays, where there are masks in the box; None when it has none."""
    if views.points_world is None or views.point_colors_srgb is None or len(views.points_world) == 0:
        return None
    points, colors = views.points_world.cpu().numpy(), views.point_colors_srgb.cpu().numpy()
    finite = np.isfinite(points).all(1)
    points, colors = points[finite], colors[finite]
    if views.has_masks and box is not None:
        held = box.holds(torch.from_numpy(points)).numpy()
        points, colors = points[held], colors[held]
    if views.has_masks and len(points):
        seen, on_mask = np.zeros(len(points)), np.zeros(len(points))
        for camera, coverage in zip(views.cameras, views.coverage, strict=True):
            column, row, inside, _ = project_points(camera, points)
            seen += inside
            on_mask += inside & (coverage.numpy()[row, column] > 127)
        kept = (seen >= 2) & (on_mask >= SMALLEST_MASK_AGREEMENT * seen)
        points, colors = points[kept], colors[kept]
    if len(points) > 16:
        spacing = cKDTree(points).query(points, k=9)[0][:, 1:].mean(1)
        kept = spacing < 5 * np.median(spacing) + 1e-12
        points, colors = points[kept], colors[kept]
    return points, colors


def project_points(
    camera: Camera, points: Float[ndarray, "point 3"]
) -> tuple[Int[ndarray, "point"], Int[ndarray, "point"], Bool[ndarray, "point"], Float[ndarray, "point"]]:
    """Pixel column and row (clamped), whether the point is in the picture, and its depth."""
    world_to_pixel = (camera.intrinsics.double() @ camera.camera_from_world.double()[:3]).cpu().numpy().astype(np.float32)
    projected = points.astype(np.float32) @ world_to_pixel[:, :3].T + world_to_pixel[:, 3]
    depth = projected[:, 2]
    ahead = depth > 0
    safe = np.where(ahead, depth, 1)
    x, y = projected[:, 0] / safe, projected[:, 1] / safe
    inside = ahead & (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)
    column = np.clip(x, 0, camera.width - 1).astype(np.int64)
    row = np.clip(y, 0, camera.height - 1).astype(np.int64)
    return column, row, inside, depth


def _bounding_sphere(points: Float[ndarray, "point 3"]) -> tuple[Float[ndarray, "3"], float]:
    """Centre of the bounding box and the distance of the farthest point from it."""
    center = (points.min(0) + points.max(0)) / 2
    return center, float(np.linalg.norm(points - center, axis=1).max())


def _sphere_without_masks(views: Views, box: BuildBox | None) -> tuple[Float[ndarray, "3"], float]:
    """Around the build's box, else what all cameras see."""
    return seen_by_all(views) if box is None else (np.array(box.center), box.radius)


def seen_by_all(views: Views) -> tuple[Float[ndarray, "3"], float]:
    """Sphere around the point where the optical axes meet, small enough to fit in every picture."""
    camera_from_world, intrinsics, centers = camera_geometry(views)
    axes = camera_from_world[:, 2, :3]
    center = axes_meeting_point(centers, axes)
    distance = np.einsum("vi,vi->v", center - centers, axes)
    half_angle = [
        min(np.arctan(c.width / 2 / k[0, 0]), np.arctan(c.height / 2 / k[1, 1])) for c, k in zip(views.cameras, intrinsics, strict=True)
    ]
    in_front = np.maximum(distance, 1e-3 * np.linalg.norm(center - centers, axis=1))  # even of cameras that look the other way
    radius = float(np.median(in_front * np.sin(half_angle)))
    return center, radius


def _vertex_normals(hull: VisualHull) -> Float[ndarray, "vertex 3"]:
    normals = np.zeros_like(hull.vertices_world)
    corners = hull.vertices_world[hull.faces]
    area_normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    for corner in range(3):
        np.add.at(normals, hull.faces[:, corner], area_normals)
    return _unit(normals)


def _unit(vectors: Float[ndarray, "n 3"]) -> Float[ndarray, "n 3"]:
    """Of length 1, but for those that are zero; the lengths of `vectors` are in world units, so no small one is special."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), np.finfo(vectors.dtype).tiny)


def _sample_surface(
    hull: VisualHull, count: int, random: np.random.Generator
) -> tuple[Float[ndarray, "point 3"], Float[ndarray, "point 3"]]:
    """Points (count, 3) spread evenly by area, and smooth outward normals (count, 3)."""
    corners = hull.vertices_world[hull.faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    # Stratified: the k-th point falls in the k-th equal share of the area.
    shares = (np.arange(count) + random.uniform(size=count)) / count * area.sum()
    face = np.minimum(np.searchsorted(np.cumsum(area), shares), len(area) - 1)
    root, second = np.sqrt(random.uniform(size=count)), random.uniform(size=count)
    weights = np.stack([1 - root, root * (1 - second), root * second], -1)[:, :, None]
    points = (corners[face] * weights).sum(1)
    normals = (_vertex_normals(hull)[hull.faces[face]] * weights).sum(1)
    return points, _unit(normals)


def _median_colors(
    views: Views, points: Float[ndarray, "point 3"], normals: Float[ndarray, "point 3"] | None, hull: VisualHull | None
) -> Float[ndarray, "point 3"]:
    """(n, 3) median colour over views in which the point faces the camera, lies on the mask and is not hidden by the hull."""
    chosen = np.unique(np.linspace(0, len(views.cameras) - 1, min(COLOR_VIEWS, len(views.cameras))).round().astype(int))
    votes = torch.full((len(chosen), len(points), 3), float("nan"))
    for vote, index in zip(votes, chosen, strict=True):
        camera = views.cameras[index]
        column, row, visible, depth = project_points(camera, points)
        visible &= views.coverage[index].numpy()[row, column] > 200
        if normals is not None:
            to_camera = camera.center_world.cpu().numpy() - points
            visible &= (normals * to_camera).sum(1) > 0.15 * np.linalg.norm(to_camera, axis=1)
        if hull is not None:
            visible &= depth < _nearest_depth(camera, hull)[row, column] + 3 * hull.cell
        color = views.images_srgb[index].numpy()[row[visible], column[visible]]
        vote[torch.from_numpy(visible)] = torch.from_numpy(color.astype(np.float32) / 255)
    return torch.nan_to_num(torch.nanmedian(votes, dim=0).values, nan=0.5).numpy()


def _nearest_depth(camera: Camera, hull: VisualHull) -> Float[ndarray, "height width"]:
    """(height, width) depth of the hull's nearest vertex around each pixel, +inf where there is none."""
    column, row, inside, depth = project_points(camera, hull.vertices_world)
    # Cells of pixels as wide as two voxels, so that vertices leave no holes.
    stride = max(1, int(np.ceil(2 * hull.cell * float(camera.intrinsics[0, 0]) / max(float(np.median(depth)), hull.cell))))
    rows, columns = -(-camera.height // stride), -(-camera.width // stride)
    nearest = np.full(rows * columns, np.inf, np.float32)
    np.minimum.at(nearest, (row[inside] // stride) * columns + column[inside] // stride, depth[inside])
    full = nearest.reshape(rows, columns).repeat(stride, 0).repeat(stride, 1)
    return full[: camera.height, : camera.width]
