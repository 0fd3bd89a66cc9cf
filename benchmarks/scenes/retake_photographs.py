"""A capture's photographs as another camera would have taken them, and others have cut them out and placed them: through a lens that bends, in several
sizes, with exposures or white balances that differ; with grain and artefacts of JPEG, masks that are a pixel or two off (beside whole photographs, or cut
out by them), and cameras a fraction of a pixel off.

In: a scene as the benchmark lays it out (NeRF-synthetic, cameras by camera_angle_x, RGBA pictures). Out: a folder that builds read, with photographs
alone; what is built of it is scored against the scene itself. Nothing is drawn: pixels are resampled in linear, premultiplied light.
"""

import io
import json
import math
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from PIL import Image
from scipy.ndimage import distance_transform_edt, gaussian_filter, map_coordinates
from scipy.spatial.transform import Rotation

from benchmarks.scenes.bench_scene import Array, read_rgba
from drgs.maths.color_numpy import linear_from_srgb, srgb_from_linear

Way = Literal["lens", "sizes", "exposures", "white", "grain", "masks", "cutouts", "poses"]
WAYS: tuple[Way, ...] = get_args(Way)
K1, K2 = -0.2, 0.05
"""Of the lens: OpenCV's radial coefficients."""
SIZES = (1.0, 0.75, 0.5)
"""Of the photographs in turn, of the scene's."""
MOST_STOPS = 1.0
"""By which exposures differ from the scene's, either way, evenly by chance."""
TINT = 0.06
"""Of red and of blue, by a white balance that is found anew for each photograph: standard deviation of the logarithm over green."""
GRAIN, JPEG_QUALITY = 0.01, 88
"""Of the sensor, standard deviation of linear light that is white at 1, times its square root; and of the file."""
MASK_WIDE, MASK_OFF, MASK_WAVES = 0.7, 1.0, 12.0
"""By how many pixels masks are too wide in the mean, how much that differs along an outline, and over how many pixels."""
TURNED_OFF, MOVED_OFF = 0.02, 2e-4
"""Of cameras, standard deviations: degrees about each axis, and of their distance from the middle, along each. A quarter and a seventh of a pixel of 400."""
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
    random = np.random.default_rng(0)
    stops = random.uniform(-MOST_STOPS, MOST_STOPS, len(document["frames"]))
    frames: list[dict[str, Any]] = []
    for number, frame in enumerate(document["frames"]):
        name = Path(frame["file_path"]).name
        light = premultiplied(read_rgba(scene / f"{frame['file_path']}.png"))
        more: dict[str, Any] = {}
        if way == "lens":
            light, more = through_lens(light, document["camera_angle_x"])
        elif way == "sizes":
            light = shrunk(light, SIZES[number % len(SIZES)])
        elif way == "exposures":
            light = light * np.append(np.full(3, 2 ** stops[number]), 1.0)
        elif way == "white":
            red, blue = np.exp(random.normal(scale=TINT, size=2))
            light = light * np.array([red, 1.0, blue, 1.0])
        elif way == "grain":
            light = grainy(light, random)
        elif way in ("masks", "cutouts"):
            light = cut_out_roughly(light, random)
        else:
            more = {"transform_matrix": placed_roughly(np.array(frame["transform_matrix"]), random).tolist()}
        picture = bytes_of(light)
        if way == "cutouts":
            picture[picture[..., 3] == 0] = 0
        Image.fromarray(picture).save(out / "train" / f"{name}.png")
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


def grainy(light: Array, random: np.random.Generator) -> Array:
    """The same as a small sensor and a JPEG file leave it; alpha stays."""
    noise = random.normal(size=light[..., :3].shape) * GRAIN * np.sqrt(light[..., :3].clip(0))
    seen = bytes_of(np.concatenate([(light[..., :3] + noise).clip(0), np.ones_like(light[..., 3:])], -1))
    file = io.BytesIO()
    Image.fromarray(seen[..., :3]).save(file, "JPEG", quality=JPEG_QUALITY)
    kept = linear_from_srgb(np.asarray(Image.open(file), np.float64) / 255)
    return np.concatenate([kept * (light[..., 3:] > 0), light[..., 3:]], -1)


def cut_out_roughly(light: Array, random: np.random.Generator) -> Array:
    """Before a plain room, with a mask that is MASK_WIDE too wide and MASK_OFF off, so that the room is seen along outlines. Its alpha is near 0 or 1."""
    alpha = light[..., 3:]
    room = np.array([0.3, 0.26, 0.22]) * (0.6 + 0.8 * np.linspace(1, 0, len(light))[:, None, None])
    inside = alpha[..., 0] > 0.5
    distance = distance_transform_edt(inside) - distance_transform_edt(~inside)
    wave = gaussian_filter(random.normal(size=inside.shape), MASK_WAVES / 2)
    # What is beyond stays to be seen: its alpha is not zero, but becomes so in eight bits.
    mask = np.where(distance + MASK_WIDE + MASK_OFF * wave / wave.std() > 0, 1, 1e-4)[..., None]
    return np.concatenate([(light[..., :3] + (1 - alpha) * room) * mask, mask], -1)


def placed_roughly(world_from_camera: Array, random: np.random.Generator) -> Array:
    """(4, 4), turned and moved a little."""
    off = np.eye(4)
    off[:3, :3] = Rotation.from_euler("xyz", random.normal(scale=TURNED_OFF, size=3), degrees=True).as_matrix()
    off[:3, 3] = random.normal(scale=MOVED_OFF, size=3) * np.linalg.norm(world_from_camera[:3, 3])
    return world_from_camera @ off


def premultiplied(rgba: Array) -> Array:
    """Linear light times alpha, and alpha, of straight sRGB."""
    return np.concatenate([linear_from_srgb(rgba[..., :3]) * rgba[..., 3:], rgba[..., 3:]], -1)


def bytes_of(light: Array) -> np.ndarray:
    """8-bit straight sRGB and alpha of what `premultiplied` gave; what is brighter than a sensor clips."""
    alpha = light[..., 3:].clip(0, 1)
    colour = srgb_from_linear((light[..., :3] / np.maximum(light[..., 3:], 1e-6)).clip(0, 1))
    return (255 * np.concatenate([colour, alpha], -1) + 0.5).astype(np.uint8)
