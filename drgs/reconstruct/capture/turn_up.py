"""Turn a capture's world so that a direction of it points up (z): COLMAP's own worlds have no up, and other programs have another axis.

In: a capture and the direction. Out: the same capture in the turned world. The world's origin and scale stay.
"""

import math
from dataclasses import replace

import numpy as np
from jaxtyping import Float, Float64
from numpy import ndarray

from drgs.reconstruct.capture.load_views.capture import Capture

Direction = tuple[float, float, float]
UP: Direction = (0.0, 0.0, 1.0)
"""Of a world that is upright already."""
SHORTEST = 1e-6
"""Of a direction that says something."""


def turn_up(capture: Capture, up: Direction) -> Capture:
    """The capture in the world whose points are rotation_to_up(up) @ x; the very same where that is upright already.

    Raises:
        ValueError: `up` is no direction.
    """
    rotation = rotation_to_up(up)
    if np.array_equal(rotation, np.eye(3)):
        return capture
    capture_from_upright = np.eye(4)
    capture_from_upright[:3, :3] = rotation.T
    photographs = tuple(
        replace(photograph, camera_from_world=photograph.camera_from_world @ capture_from_upright) for photograph in capture.photographs
    )
    points = None if capture.points_world is None else (capture.points_world @ rotation.T).astype(np.float32)
    return replace(capture, photographs=photographs, points_world=points)


def rotation_to_up(up: Direction) -> Float64[ndarray, "3 3"]:
    """The smallest rotation that takes a direction to z; half a turn goes around x.

    Raises:
        ValueError: it is no direction.
    """
    length = math.hypot(*up)
    if not (math.isfinite(length) and length > SHORTEST):
        raise ValueError(f"up: {tuple(up)} is no direction, expected three finite numbers that are not all 0.")
    return _rotation_to_z(np.array(up) / length)


def up_of_cameras(capture_from_camera: Float[ndarray, "camera 4 4"]) -> Float64[ndarray, "3"]:
    """The mean of the cameras' own up, of unit length; z where they have none in common.

    Args:
        capture_from_camera: OpenGL axes.
    """
    mean = np.asarray(capture_from_camera, np.float64)[:, :3, 1].mean(0)
    length = float(np.linalg.norm(mean))
    return mean / length if length > SHORTEST else np.array(UP)


def _rotation_to_z(up: Float64[ndarray, "3"]) -> Float64[ndarray, "3 3"]:
    """Rodrigues' formula for the axis up × z: R = I + [v]× + [v]×² / (1 + c), c = up · z."""
    x, y, z = up
    if x == 0 and y == 0:
        return np.eye(3) if z > 0 else np.diag([1.0, -1.0, -1.0])
    if z <= -1 + SHORTEST:  # the formula divides by nearly nothing
        over = np.diag([1.0, -1.0, -1.0])
        return _rotation_to_z(over @ up) @ over
    across = np.array([[0.0, 0.0, -x], [0.0, 0.0, -y], [x, y, 0.0]])
    return np.eye(3) + across + across @ across / (1 + z)
