"""Where to look from: the camera of thumbnails and of new viewers, and turntables."""

from collections.abc import Sequence

import numpy as np

FOV_Y_DEGREES = 40.0
FILL = 0.92
"""Distance as a share of that at which the bounding box's sphere fits the picture; objects rarely fill their box."""


def start_view(minimum: Sequence[float], maximum: Sequence[float]) -> np.ndarray:
    """(4, 4) OpenGL camera-to-world, from the front right (+x -y) and a little above, with the whole box in sight [world units]."""
    backward = np.array([0.55, -0.75, 0.45])
    backward /= np.linalg.norm(backward)
    right = np.cross([0.0, 0.0, 1.0], backward)
    return _view_of_box(minimum, maximum, right / np.linalg.norm(right), backward)


def turntable_view(minimum: Sequence[float], maximum: Sequence[float], azimuth_degrees: float, elevation_degrees: float) -> np.ndarray:
    """(4, 4) OpenGL camera-to-world on a circle round the box; azimuth 0 looks from -y and grows counter-clockwise, seen from above."""
    azimuth, elevation = np.radians(azimuth_degrees - 90), np.radians(elevation_degrees)
    backward = np.array([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)])
    return _view_of_box(minimum, maximum, np.array([-np.sin(azimuth), np.cos(azimuth), 0.0]), backward)


def _view_of_box(minimum: Sequence[float], maximum: Sequence[float], right: np.ndarray, backward: np.ndarray) -> np.ndarray:
    """Along unit vectors of the camera, so far away that the box is in sight."""
    center = np.add(minimum, maximum) / 2
    radius = max(float(np.linalg.norm(np.subtract(maximum, minimum))) / 2, 1e-6)
    world_from_camera = np.eye(4)
    world_from_camera[:3, :3] = np.stack([right, np.cross(backward, right), backward], -1)
    world_from_camera[:3, 3] = center + backward * radius / np.sin(np.radians(FOV_Y_DEGREES / 2)) * FILL
    return world_from_camera
