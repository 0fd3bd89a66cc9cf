"""A photographer's studio as an environment, computed: key, fill and rim light in a dark room with a floor and a backdrop.

Out: a lat-long table of linear Rec.709 radiance. Sides are those of a camera at the start view of a new viewer (worker/drgs_worker/jobs/start_view.py).
"""

from dataclasses import dataclass

import numpy as np

from drgs.scene.lat_long import direction_of_degrees, texel_directions, texel_means

CAMERA_AZIMUTH_DEGREES = -54.0
"""Where that camera stands."""
_SAMPLES = 2
"""A side of a texel: the antialiasing of the boxes' edges."""


@dataclass(frozen=True)
class SoftBox:
    """A lit rectangle, upright and facing the object."""

    to_the_right_degrees: float
    """Round the object from the camera, as seen from it; left is negative."""
    elevation_degrees: float
    half_width: float
    """Tangent of half the angle that it fills."""
    half_height: float
    radiance: tuple[float, float, float]

    @property
    def direction(self) -> np.ndarray:
        """(3,) unit vector from the object to its middle."""
        return direction_of_degrees(CAMERA_AZIMUTH_DEGREES + self.to_the_right_degrees, self.elevation_degrees)


KEY = SoftBox(-50.0, 42.0, 0.42, 0.42, (9.6, 9.3, 8.9))
"""The main light, warm, from the left and above."""
FILL = SoftBox(55.0, 12.0, 0.75, 0.60, (0.72, 0.77, 0.85))
"""Large, dim and cool, from the right: it opens the key's shadows."""
RIM = SoftBox(150.0, 38.0, 0.18, 0.65, (9.0, 9.2, 9.6))
"""A strip behind the object, on the fill's side: it draws the outline."""


def paint_three_point_lights(height: int = 256) -> np.ndarray:
    """(height, 2 height, 3) float32 radiance."""
    fine = texel_directions(height, _SAMPLES).astype(np.float32)
    light = _room(texel_directions(height))
    for box in (KEY, FILL, RIM):
        light = light + texel_means(_lit(box, fine)[..., None], _SAMPLES) * np.array(box.radiance)
    return light.astype(np.float32)


def _room(direction: np.ndarray) -> np.ndarray:
    """(..., 3) of walls, backdrop and floor."""
    up = direction[..., 2:]
    behind = (direction @ direction_of_degrees(CAMERA_AZIMUTH_DEGREES + 180, 8.0))[..., None]
    walls = 0.035 + 0.02 * up.clip(0, 1)
    backdrop = 0.16 * _rise(behind, 0.35, 1.0)
    # The backdrop runs out into the floor without an edge, as paper does.
    floor = 0.055 + 0.05 * _rise(behind, -0.2, 1.0)
    room = walls + backdrop + (floor - walls - backdrop) * _rise(-up, 0.0, 0.45)
    return room * np.array([1.0, 0.985, 0.97])


def _lit(box: SoftBox, direction: np.ndarray) -> np.ndarray:
    """(...) 0..1: how bright a soft box looks, dimmer towards its edges."""
    axis = box.direction
    right = np.cross([0.0, 0.0, 1.0], axis)
    right /= np.linalg.norm(right)
    along, across, upward = np.moveaxis(direction @ np.stack([axis, right, np.cross(axis, right)], -1).astype(direction.dtype), -1, 0)
    safe = np.maximum(along, 1e-3)
    x, y = np.abs(across) / safe / box.half_width, np.abs(upward) / safe / box.half_height
    inside = (1 - _rise(x, 0.94, 1.0)) * (1 - _rise(y, 0.94, 1.0)) * (1 - 0.25 * (x * x + y * y).clip(0, 2))
    return np.where(along > 0, inside, 0)


def _rise(x: np.ndarray, start: float, end: float) -> np.ndarray:
    """0 before `start`, 1 after `end`, smooth in between."""
    t = ((x - start) / (end - start)).clip(0, 1)
    return t * t * (3 - 2 * t)
