"""Decode the pictures and masks of a capture, undistorted and optionally smaller.

Shrinking averages areas of linear, premultiplied light: colour of the background must not bleed into the object's edge.
"""

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import repeat
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from numpy import ndarray
from PIL import ExifTags, Image
from torch import Tensor

from drgs.exchange.pictures import as_eight_bits, exif_number, read_exif
from drgs.reconstruct.capture.exposure_gains import gains_of_files
from drgs.reconstruct.capture.load_views.capture import Capture, Photograph, Pinhole, camera_of, resize_pinhole
from drgs.reconstruct.capture.load_views.checks import damaged
from drgs.reconstruct.capture.load_views.linear_light import premultiplied, straight
from drgs.reconstruct.capture.load_views.undistort import undistort
from drgs.scene.camera import Camera
from drgs.scene.views import Views

DECODE_THREADS = 2
NERO_DEPTH_OF_ONE = 15.0
"""Depth [world units] of the value 65535 in NeRO's depth pictures."""
NERO_BACKGROUND_DEPTH = 14.5


@dataclass(frozen=True)
class Window:
    """A part of an undistorted photograph, and how large it becomes."""

    rows: slice
    columns: slice
    """[pixels of the photograph]"""
    width: int
    height: int
    """[pixels]"""

    def of_pinhole(self, pinhole: Pinhole) -> Pinhole:
        """What the photograph's camera is to who looks through the window."""
        height, width = self.rows.stop - self.rows.start, self.columns.stop - self.columns.start
        cut = Pinhole(pinhole.fx, pinhole.fy, pinhole.cx - self.columns.start, pinhole.cy - self.rows.start, width, height)
        return resize_pinhole(cut, self.width, self.height)


def read_pictures(capture: Capture, max_side: int | None, sharpen: bool = False, windows: Sequence[Window] | None = None) -> Views:
    """Views of a checked capture, the longer side of each at most `max_side` pixels.

    Args:
        sharpen: masks are moved as sharpen_masks does it, before the photographs are undistorted or shrunk.
        windows: of each photograph, what becomes its view, whatever max_side; None: all of it.
    """

    if sharpen:  # imported here: reading cameras alone asks for nothing that looks at pictures
        from drgs.reconstruct.capture.sharpen_masks import LEAST_OFF, MaskLook, outlines_off

    def read(photograph: Photograph, window: Window, look: Any) -> tuple[Camera, Tensor, Tensor, bool, float | None, Any]:
        """Camera, colour, coverage, whether there is a mask, the exposure where the file tells, and how far its outlines are off (MaskLook): those of `look` are moved."""
        pinhole = photograph.pinhole
        color, alpha, has_mask, exposure = _decode(photograph)
        if look is not None:
            color, alpha = look.moved(color, alpha)
        elif sharpen and has_mask:
            look = MaskLook.at(color, alpha)
        if photograph.lens is not None:
            color, alpha = undistort(color, alpha, photograph.lens, pinhole)
        color, alpha = color[window.rows, window.columns], alpha[window.rows, window.columns]
        if (window.height, window.width) != alpha.shape:
            color, alpha = shrink(color, alpha, window.width, window.height)
        camera = camera_of(photograph.camera_from_world, window.of_pinhole(pinhole), photograph.name)
        return camera, torch.from_numpy(color.copy()), torch.from_numpy(alpha.copy()), has_mask, exposure, look

    windows = windows or [_whole(photograph.pinhole, max_side) for photograph in capture.photographs]
    with ThreadPoolExecutor(DECODE_THREADS) as pool:
        found = list(pool.map(read, capture.photographs, windows, repeat(None)))
        off = outlines_off([look for *_, look in found]) if sharpen else 0.0
        moved = sharpen and off >= LEAST_OFF
        if moved:
            found = list(pool.map(read, capture.photographs, windows, [look for *_, look in found]))
    cameras, images, coverage, has_masks, exposures, _ = zip(*found, strict=True)
    if any(has_masks) and not all(has_masks):
        lacking = [photograph.image for photograph, has_mask in zip(capture.photographs, has_masks, strict=True) if not has_mask]
        raise ValueError(f"{lacking[0]}: neither alpha nor a mask ({len(lacking)} of {len(cameras)} images), but the others have one.")
    return Views(
        cameras=cameras,
        images_srgb=images,
        coverage=coverage,
        points_world=None if capture.points_world is None else torch.from_numpy(capture.points_world),
        point_colors_srgb=None if capture.point_colors_srgb is None else torch.from_numpy(capture.point_colors_srgb),
        # An alpha channel that is opaque everywhere says nothing.
        has_masks=all(has_masks) and any(bool((mask < 128).any()) for mask in coverage),
        source=capture.source,
        lenses=tuple(photograph.lens for photograph in capture.photographs),
        gains=gains_of_files(exposures),
        masks_moved=off if moved else 0.0,
    )


def _whole(pinhole: Pinhole, max_side: int | None) -> Window:
    scale = min(1.0, max_side / max(pinhole.width, pinhole.height)) if max_side else 1.0
    width, height = max(1, round(pinhole.width * scale)), max(1, round(pinhole.height * scale))
    return Window(slice(0, pinhole.height), slice(0, pinhole.width), width, height)


@contextmanager
def _opened(path: Path) -> Iterator[Image.Image]:
    try:
        with Image.open(path, formats=("PNG", "JPEG", "WEBP")) as image:
            yield image
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise damaged(path, f"the image cannot be decoded ({error}).") from error


def _decode(photograph: Photograph) -> tuple[UInt8[ndarray, "height width 3"], UInt8[ndarray, "height width"], bool, float | None]:
    """Colour (h, w, 3), alpha (h, w), whether alpha came from the file or a mask rather than from nothing, and the exposure if it is told."""
    with _opened(photograph.image) as image:
        exposure = _exposure(image)
        picture = as_eight_bits(image)
        has_alpha = "A" in picture.getbands() or "transparency" in picture.info
        pixels = np.asarray(picture.convert("RGBA" if has_alpha else "RGB"))
    color = pixels[..., :3]
    alpha = pixels[..., 3] if has_alpha else np.full(pixels.shape[:2], 255, np.uint8)
    if photograph.mask is None:
        return color, alpha, has_alpha, exposure
    mask = mask_of_depth(photograph.mask) if photograph.mask_is_depth else mask_channel(photograph.mask)
    if mask.shape != alpha.shape:
        raise ValueError(
            f"{photograph.mask}: the mask is {mask.shape[1]}x{mask.shape[0]}, but its image {photograph.image.name} is {alpha.shape[1]}x{alpha.shape[0]}."
        )
    return color, np.minimum(alpha, mask), True, exposure


def _exposure(image: Image.Image) -> float | None:
    """Time [s] times sensitivity [ISO] over the f-number's square, by EXIF; None where one is missing or no positive number."""
    told = read_exif(image, ExifTags.IFD.Exif)
    tags = (ExifTags.Base.ExposureTime, ExifTags.Base.ISOSpeedRatings, ExifTags.Base.FNumber)
    seconds, sensitivity, f_number = (exif_number(told, tag) for tag in tags)
    if seconds is None or sensitivity is None or f_number is None:
        return None
    exposure = seconds * sensitivity / f_number / f_number
    return exposure if np.isfinite(exposure) and exposure > 0 else None


def mask_of_depth(path: Path) -> UInt8[ndarray, "height width"]:
    """(h, w) 0 or 255 of a NeRO depth picture."""
    with _opened(path) as image:
        mode, values = image.mode, np.asarray(image)
    if not mode.startswith("I"):
        raise ValueError(f"{path}: a depth picture of mode {mode}, expected 16-bit grey.")
    depth = values.astype(np.float32) / 65535 * NERO_DEPTH_OF_ONE
    return np.where(depth < NERO_BACKGROUND_DEPTH, 255, 0).astype(np.uint8)


def mask_channel(path: Path) -> UInt8[ndarray, "height width"]:
    """(h, w) 0..255. A mask's alpha channel is used when its colour says nothing (cut-outs saved as masks)."""
    with _opened(path) as image:
        picture = as_eight_bits(image)
        rgba = np.asarray(picture.convert("RGBA"))
        return rgba[..., 3] if (rgba[..., 3] < 255).any() else np.asarray(picture.convert("L"))


def shrink(
    color_srgb: UInt8[ndarray, "rows columns 3"], alpha: UInt8[ndarray, "rows columns"], width: int, height: int
) -> tuple[UInt8[ndarray, "{height} {width} 3"], UInt8[ndarray, "{height} {width}"]]:
    """Area-averaged colour (height, width, 3) and alpha (height, width), 8 bit, from straight 8-bit sRGB."""
    alpha_share = alpha.astype(np.float32) / 255

    def average(channel: Float[ndarray, "rows columns"]) -> Float[ndarray, "height width"]:
        return np.asarray(Image.fromarray(channel).resize((width, height), Image.Resampling.BOX))

    alpha_small = average(alpha_share)
    light = np.stack([average(premultiplied(color_srgb[..., channel], alpha_share)) for channel in range(3)], -1)
    return straight(light, alpha_small), np.round(alpha_small * 255).astype(np.uint8)
