"""The plane that an object stands on: a table, a floor, of which the capture's sparse points tell.

In: sparse points and camera centres. Out: the plane that most points near the object lie on, when all cameras are above it and hardly a point is below it.
Where that is not so there is none: the object then floats, is held, or stands on something that shows no features.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64
from numpy import ndarray


@dataclass(frozen=True)
class GroundSettings:
    near: float = 2.5
    """Points farther from what the cameras look at than so many times the sphere that all of them see are not asked."""
    trials: int = 2000
    cell: float = 0.1
    """Of points nearer together than this share of that sphere, one counts."""
    asked: int = 4000
    """Points that each trial counts, and"""
    tolerance: float = 0.01
    """how far they may be off, as a share of the mean camera distance."""
    fewest: int = 40
    """Such points, and their"""
    share: float = 0.1
    """share of all near ones, that a plane must hold."""
    most_below: float = 0.15
    """Points below it, as a share of those on it: mirror images and mistakes, but no part of an object."""
    least_height: float = 0.05
    """Of the lowest cameras (of nineteen in twenty) above it, as a share of the mean camera distance."""


@dataclass(frozen=True, eq=False)
class GroundPlane:
    """normal · x = offset."""

    normal_world: Float64[ndarray, "3"]
    """Unit, on the side of the cameras."""
    offset: float
    """[world units], this and the next."""
    tolerance: float
    """How far from it points that lie on it may be."""
    points_world: Float64[ndarray, "point 3"]
    """Those that do."""

    def heights(self, points_world: Float[ndarray, "*n 3"]) -> Float[ndarray, "*n"]:
        """Above the plane [world units]."""
        return points_world @ self.normal_world - self.offset


def ground_plane(
    points_world: Float[ndarray, "point 3"],
    centers_world: Float[ndarray, "camera 3"],
    looked_at: Float[ndarray, "3"],
    radius: float,
    seed: int,
    settings: GroundSettings = GroundSettings(),
) -> GroundPlane | None:
    """The plane below the object; None where the points tell of none.

    Args:
        looked_at, radius: of the sphere that all cameras see.
    """
    random = np.random.default_rng(seed)
    near = points_world[np.linalg.norm(points_world - looked_at, axis=1) < settings.near * radius].astype(np.float64)
    if len(near) < settings.fewest:
        return None
    distance = float(np.linalg.norm(centers_world - looked_at, axis=1).mean())
    tolerance = settings.tolerance * distance
    # One point a cell: planes are told by their area, not by how much pattern a small thing on them has.
    cells = np.floor(near / (settings.cell * radius)).astype(np.int64)
    near = near[np.sort(np.unique(cells, axis=0, return_index=True)[1])]
    asked = near[random.permutation(len(near))[: settings.asked]]
    corners = asked[random.integers(len(asked), size=(settings.trials, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    normals, corners = normals[lengths > 0] / lengths[lengths > 0, None], corners[lengths > 0, 0]
    offsets = (normals * corners).sum(1)
    # The side on which most cameras are is above.
    sides = np.sign(np.median(centers_world @ normals.T - offsets, axis=0))
    normals, offsets = normals * sides[:, None], offsets * sides
    counts = (np.abs(asked @ normals.T - offsets) < tolerance).sum(0)
    for trial in np.argsort(-counts, kind="stable"):
        if counts[trial] < max(settings.share * len(asked), settings.fewest * len(asked) / len(near)):
            return None
        plane = _refined(near, normals[trial], float(offsets[trial]), tolerance)
        if _is_below(plane, near, centers_world, distance, settings):
            return plane
    return None


def _refined(near: Float64[ndarray, "point 3"], normal: Float64[ndarray, "3"], offset: float, tolerance: float) -> GroundPlane:
    on_it = near[np.abs(near @ normal - offset) < tolerance]
    for _ in range(3):
        middle = on_it.mean(0)
        _, _, directions = np.linalg.svd(on_it - middle, full_matrices=False)
        fitted = directions[2] if directions[2] @ normal > 0 else -directions[2]
        held = near[np.abs(near @ fitted - fitted @ middle) < tolerance]
        if len(held) < 3:
            break
        normal, offset, on_it = fitted, float(fitted @ middle), held
    return GroundPlane(normal, offset, tolerance, on_it)


def _is_below(
    plane: GroundPlane,
    near: Float64[ndarray, "point 3"],
    centers_world: Float[ndarray, "camera 3"],
    distance: float,
    settings: GroundSettings,
) -> bool:
    below = int((plane.heights(near) < -3 * plane.tolerance).sum())
    lowest = float(np.quantile(plane.heights(centers_world), 0.05))
    return below <= settings.most_below * len(plane.points_world) and lowest > settings.least_height * distance
