"""The way of a film's camera through views, smooth in time.

In: keyframes and a frame rate. Out: OpenGL camera-to-world of each picture. A view is taken apart into the point it looks at, azimuth,
elevation and logarithm of the distance around that point, and field of view; each of them is a monotone cubic of time. So the camera
goes round an object instead of through it, passes every view at its time, never goes beyond the views on either side, and rests at both
ends, unless the path is closed: then it goes on through the first view as through any other. Up is z. web/src/stage/camera/camera_path.ts is its twin for the preview, and a test holds both to the same numbers.
Source: Fritsch & Butland 1984, "A method for constructing local monotone piecewise cubic interpolants", for the slopes.
"""

import numpy as np

from drgs_worker.jobs.requests import CameraKeyframe, CameraPath, path_frames

HALF_TURN = 1e-9
"""Half a turn goes counter-clockwise, even where rounding makes it this much more [turns]."""


def path_views(path: CameraPath, fps: float) -> list[tuple[np.ndarray, float]]:
    """(4, 4) OpenGL camera-to-world and vertical field of view [degrees] of the picture at each 1 / fps seconds."""
    keyframes = [*path.keyframes, path.keyframes[0]] if path.closed else path.keyframes
    times = np.cumsum([0.0, *(keyframe.seconds for keyframe in keyframes[1:])])
    values = np.stack([_coordinates(keyframe) for keyframe in keyframes])
    for k in range(1, len(values)):  # the shorter way round
        values[k, 3] -= 2 * np.pi * np.floor((values[k, 3] - values[k - 1, 3]) / (2 * np.pi) + 0.5 - HALF_TURN)
    slopes = _slopes(times, values, path.closed)
    return [_view(_interpolate(times, values, slopes, k / fps)) for k in range(path_frames(path, fps))]


def _coordinates(keyframe: CameraKeyframe) -> np.ndarray:
    """(7,) target [world units], azimuth and elevation of the eye around it [radians], log distance, field of view [degrees]."""
    x, y, z = offset = np.subtract(keyframe.eye, keyframe.target)
    across = np.hypot(x, y)
    return np.array([*keyframe.target, np.arctan2(y, x), np.arctan2(z, across), np.log(np.linalg.norm(offset)), keyframe.fov_y_degrees])


def _slopes(times: np.ndarray, values: np.ndarray, closed: bool) -> np.ndarray:
    """(keyframe, coordinate) per second: weighted harmonic means of the secants on both sides; 0 where they differ in sign, and at open ends."""
    steps = np.diff(times)[:, None]
    secants = np.diff(values, axis=0) / steps
    if closed:  # behind the last comes the first
        steps, secants = (np.concatenate([array[-1:], array, array[:1]]) for array in (steps, secants))
    before, after = secants[:-1], secants[1:]
    weight_before, weight_after = 2 * steps[1:] + steps[:-1], steps[1:] + 2 * steps[:-1]
    goes_on = before * after > 0
    inverse = weight_before / np.where(goes_on, before, 1) + weight_after / np.where(goes_on, after, 1)
    slopes = np.where(goes_on, (weight_before + weight_after) / np.where(goes_on, inverse, 1), 0)
    return slopes if closed else np.pad(slopes, ((1, 1), (0, 0)))


def _interpolate(times: np.ndarray, values: np.ndarray, slopes: np.ndarray, time: float) -> np.ndarray:
    k = int(np.clip(np.searchsorted(times, time, side="right") - 1, 0, len(times) - 2))
    step = times[k + 1] - times[k]
    u = np.clip((time - times[k]) / step, 0, 1)
    rise = u * u * (3 - 2 * u)
    bends = step * u * (1 - u) * ((1 - u) * slopes[k] - u * slopes[k + 1])
    return values[k] + rise * (values[k + 1] - values[k]) + bends


def _view(coordinates: np.ndarray) -> tuple[np.ndarray, float]:
    *target, azimuth, elevation, log_distance, fov = coordinates.tolist()
    backward = np.array([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)])
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([right, np.cross(backward, right), backward], -1)
    matrix[:3, 3] = target + np.exp(log_distance) * backward
    return matrix, fov
