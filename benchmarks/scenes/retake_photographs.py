"""A capture's photographs as another camera would have taken them: through a lens that bends, in several sizes, with exposures that differ.

In: a scene as the benchmark lays it out (NeRF-synthetic, cameras by camera_angle_x, RGBA pictures). Out: a folder that builds read, with photographs
alone; what is built of it is scored against the scene itself. Nothing is drawn: pixels are resampled in linear, premultiplied light.
"""

import json
import math
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from PIL import Image
from scipy.ndimage import map_coordinates

from benchmarks.scenes.bench_scene import Array, read_rgba
from drgs.maths.color_numpy import linear_from_srgb, srgb_from_linear

Way = Literal["lens", "sizes", "exposures"]
WAYS: tuple[Way, ...] = get_args(Way)
K1, K2 = -0.2, 0.05
"""Of the lens: OpenCV's radial coefficients."""
SIZES = (1.0, 0.75, 0.5)
"""Of the photographs in turn, of the scene's."""
MOST_STOPS = 1.0
"""By which exposures differ from the scene's, either way, evenly by chance."""
INVERSIONS = 30
"""Steps of a fixed point that falls by more than half in each."""


def retake_photographs(scene: Path, out: Path, way: Way) -> None:
    """Write the folder `out`, which is not there yet.

    Raises:
        ValueError: the scene's cameras are not given by one camera_angle_x.
    """
    document = json.loads((scene / "transforms_train.json").read_text())
    if "camera_angle_x" not in document or "fl_x" in document:
        raise ValueError(f"{scene}: transforms_train.json has no camera_angle_x alone; expected a scene of the benchmark")
    (out / "train").mkdir(parents=True)
    stops = np.random.default_rng(0).uniform(-MOST_STOPS, MOST_STOPS, len(document["frames"]))
    frames: list[dict[str, Any]] = []
    for number, frame in enumerate(document["frames"]):
        name = Path(frame["file_path"]).name
        light = premultiplied(read_rgba(scene / f"{frame['file_path']}.png"))
        more: dict[str, Any] = {}
        if way == "lens":
            light, more = through_lens(light, document["camera_angle_x"])
        elif way == "sizes":
            light = shrunk(light, SIZES[number % len(SIZES)])
        else:
            light = light * np.append(np.full(3, 2 ** stops[number]), 1.0)
        Image.fromarray(bytes_of(light)).save(out / "train" / f"{name}.png")
        frames.append(frame | {"file_path": f"./train/{name}"} | more)
    kept = {key: value for key, value in document.items() if key not in ("w", "h")}
    (out / "transforms_train.json").write_text(json.dumps(kept | {"frames": frames}))


def through_lens(light: Array, angle_x: float) -> tuple[Array, dict[str, float]]:
    """(height, width, 4) of a pinhole as the bending lens would have shown it, and what a camera file says of that lens."""
    height, width = light.shape[:2]
    focal = 0.5 * width / math.tan(0.5 * angle_x)
    x, y = np.meshgrid((np.arange(width) + 0.5 - width / 2) / focal, (np.arange(height) + 0.5 - height / 2) / focal)
    straight_x, straight_y = x, y
    for _ in range(INVERSIONS):
        square = straight_x**2 + straight_y**2
        bend = 1 + K1 * square + K2 * square**2
        straight_x, straight_y = x / bend, y / bend
    places = [straight_y * focal + height / 2 - 0.5, straight_x * focal + width / 2 - 0.5]
    shown = [map_coordinates(light[..., channel], places, order=3, mode="constant") for channel in range(4)]
    # Splines overshoot at outlines.
    facts = {"fl_x": focal, "fl_y": focal, "cx": width / 2, "cy": height / 2, "w": width, "h": height, "k1": K1, "k2": K2}
    return np.stack(shown, -1).clip(min=0), facts


def shrunk(light: Array, factor: float) -> Array:
    """(rows, columns, 4) at `factor` times the size, by the means of what a pixel covers."""
    size = (round(light.shape[1] * factor), round(light.shape[0] * factor))
    channels = [Image.fromarray(light[..., channel].astype(np.float32)).resize(size, Image.Resampling.BOX) for channel in range(4)]
    return np.stack([np.asarray(channel, np.float64) for channel in channels], -1)


def premultiplied(rgba: Array) -> Array:
    """Linear light times alpha, and alpha, of straight sRGB."""
    return np.concatenate([linear_from_srgb(rgba[..., :3]) * rgba[..., 3:], rgba[..., 3:]], -1)


def bytes_of(light: Array) -> np.ndarray:
    """8-bit straight sRGB and alpha of what `premultiplied` gave; what is brighter than a sensor clips."""
    alpha = light[..., 3:].clip(0, 1)
    colour = srgb_from_linear((light[..., :3] / np.maximum(light[..., 3:], 1e-6)).clip(0, 1))
    return (255 * np.concatenate([colour, alpha], -1) + 0.5).astype(np.uint8)
