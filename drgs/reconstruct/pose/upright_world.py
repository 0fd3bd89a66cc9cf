"""The similarity that turns COLMAP's world, which has no up, centre or scale, into one that is z up, centred on what the cameras look at, with the
cameras 4 units away on average and the first of them on the side of +x.

Up is, of what the cameras and points allow, the first of
1. the axis of a circle that they go around at constant distance, as on a turntable, however the camera is rolled;
2. the direction that no camera's horizontal axis leans to: people hold cameras level;
3. the mean of the cameras' own up;
and after 2 and 3 the normal of the plane that most points lie on, when there is a clear one and it is nearly level.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64
from numpy import ndarray

CAMERA_DISTANCE = 4.0
"""Mean distance of the cameras from the centre [world units]."""
CIRCLE_FLATNESS, CIRCLE_ROUNDNESS = 0.05, 0.05
"""Camera centres lie on a circle when they leave its plane, and its radius, by less than these shares of the radius (standard deviations)."""
WIDEST_GAP = np.pi
"""On a circle [rad]: cameras that see less than half of it do not tell its axis well."""
LEVEL_SHARE = 0.35
"""Horizontal axes tell up when they spread along it by at most this share of what they spread in the second direction."""
MOST_LEAN = np.radians(35)
"""Between the cameras' mean up and what is taken instead."""
PLANE_TRIALS, PLANE_POINTS = 400, 4000
PLANE_TOLERANCE = 0.01
"""Distance of points from their plane, as a share of the mean camera distance."""
PLANE_SHARE = 0.3
"""A plane is clear when it holds this share of the points."""
PLANE_LEAN = np.radians(15)
"""Of the plane's normal from the up found before."""


@dataclass(frozen=True, eq=False)
class Similarity:
    """x_world = scale * rotation @ x_found + translation."""

    scale: float
    rotation: Float64[ndarray, "3 3"]
    translation: Float64[ndarray, "3"]
    up_from: str
    """circle, level cameras or mean of the cameras; with `, plane of the points` where that refined it."""

    def points(self, points_found: Float64[ndarray, "point 3"]) -> Float64[ndarray, "point 3"]:
        return self.scale * points_found @ self.rotation.T + self.translation

    def world_from_camera(self, found_from_camera: Float64[ndarray, "camera 4 4"]) -> Float64[ndarray, "camera 4 4"]:
        moved = found_from_camera.copy()
        moved[:, :3, :3] = self.rotation @ found_from_camera[:, :3, :3]
        moved[:, :3, 3] = self.points(found_from_camera[:, :3, 3])
        return moved


def upright_world(found_from_camera: Float64[ndarray, "camera 4 4"], points_found: Float64[ndarray, "point 3"], seed: int) -> Similarity:
    """The similarity from COLMAP's world to ours.

    Args:
        found_from_camera: OpenCV axes.
    """
    centers = found_from_camera[:, :3, 3]
    center = looked_at(found_from_camera, points_found)
    distance = float(np.linalg.norm(centers - center, axis=1).mean())
    up, source = _up_of_cameras(found_from_camera)
    if source != "circle":
        normal = _plane_normal(points_found, PLANE_TOLERANCE * distance, up, seed)
        if normal is not None:
            up, source = normal, f"{source}, plane of the points"
    side = centers[0] - center
    side = side - (side @ up) * up
    if np.linalg.norm(side) < 1e-6 * distance:  # the first camera looks straight down
        side = np.eye(3)[np.argmin(np.abs(up))]
        side = side - (side @ up) * up
    side /= np.linalg.norm(side)
    rotation = np.stack([side, np.cross(up, side), up])
    scale = CAMERA_DISTANCE / distance
    return Similarity(scale, rotation, -scale * rotation @ center, source)


def looked_at(found_from_camera: Float64[ndarray, "camera 4 4"], points_found: Float64[ndarray, "point 3"]) -> Float64[ndarray, "3"]:
    """The point nearest to all viewing axes; what the axes leave open, where they are parallel, is decided by the points' median."""
    centers, axes = found_from_camera[:, :3, 3], found_from_camera[:, :3, 2]
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    median = np.median(points_found, axis=0)
    weight = 1e-3 * len(centers)
    return np.linalg.solve(across.sum(0) + weight * np.eye(3), (across @ centers[:, :, None]).sum(0)[:, 0] + weight * median)


def _up_of_cameras(found_from_camera: Float64[ndarray, "camera 4 4"]) -> tuple[Float64[ndarray, "3"], str]:
    """Unit up, and what told it."""
    centers, rights, ups = found_from_camera[:, :3, 3], found_from_camera[:, :3, 0], -found_from_camera[:, :3, 1]
    mean = ups.sum(0)
    mean_length = float(np.linalg.norm(mean))
    mean = mean / mean_length if mean_length > 1e-6 * len(ups) else ups[0]
    _, _, directions = np.linalg.svd(centers - centers.mean(0))
    normal = directions[2]
    if _is_circle(centers, normal):
        return normal if normal @ mean >= 0 else -normal, "circle"
    _, spread, directions = np.linalg.svd(rights)
    level = directions[2] if directions[2] @ mean >= 0 else -directions[2]
    if spread[2] < LEVEL_SHARE * spread[1] and level @ mean > np.cos(MOST_LEAN):
        return level, "level cameras"
    return mean, "mean of the cameras"


def _is_circle(centers: Float64[ndarray, "camera 3"], normal: Float64[ndarray, "3"]) -> bool:
    """Whether cameras go around one axis at a constant distance and height."""
    side = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    side /= np.linalg.norm(side)
    flat = (centers - centers.mean(0)) @ np.stack([side, np.cross(normal, side), normal]).T
    # (x - a)² + (y - b)² = r² is linear in a, b and r² - a² - b².
    design = np.column_stack([2 * flat[:, :2], np.ones(len(flat))])
    (a, b, rest), *_ = np.linalg.lstsq(design, (flat[:, :2] ** 2).sum(1), rcond=None)
    radius = float(np.sqrt(max(rest + a * a + b * b, 0.0)))
    around = flat[:, :2] - (a, b)
    angles = np.sort(np.arctan2(around[:, 1], around[:, 0]))
    gap = float(np.diff(np.append(angles, angles[0] + 2 * np.pi)).max())
    off_plane, off_radius = flat[:, 2].std(), np.linalg.norm(around, axis=1).std()
    return gap < WIDEST_GAP and bool(off_plane < CIRCLE_FLATNESS * radius and off_radius < CIRCLE_ROUNDNESS * radius)


def _plane_normal(
    points_found: Float64[ndarray, "point 3"], tolerance: float, up: Float64[ndarray, "3"], seed: int
) -> Float64[ndarray, "3"] | None:
    """Unit normal, on the side of `up`, of the plane that most points lie on (RANSAC); None without a clear one that is nearly level."""
    if len(points_found) < 3:
        return None
    generator = np.random.default_rng(seed)
    points = points_found[generator.permutation(len(points_found))[:PLANE_POINTS]]
    corners = points[generator.integers(len(points), size=(PLANE_TRIALS, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    normals = normals[lengths > 0] / lengths[lengths > 0, None]
    corners = corners[lengths > 0, 0]
    if len(normals) == 0:
        return None
    on_plane = np.abs(points @ normals.T - (corners * normals).sum(1)) < tolerance
    best = int(on_plane.sum(0).argmax())
    inliers = points[on_plane[:, best]]
    if len(inliers) < PLANE_SHARE * len(points):
        return None
    _, _, directions = np.linalg.svd(inliers - inliers.mean(0), full_matrices=False)
    normal: Float[ndarray, "3"] = directions[2] if directions[2] @ up >= 0 else -directions[2]
    return normal if normal @ up > np.cos(PLANE_LEAN) else None
