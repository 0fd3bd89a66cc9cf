"""A picture of a capture at a small size, with its mask, to be looked at: not for fits, which want linear light and lenses undone.

In: files. Out: 8-bit colour and mask. JPEGs are decoded at the size that is wanted, so that a few hundred pictures take seconds, and one picture
is held at a time.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from numpy import ndarray
from PIL import Image

from drgs.exchange.pictures import as_eight_bits, orientation_of, upright
from drgs.reconstruct.capture.camera_files import opened_photograph
from drgs.reconstruct.capture.load_views.checks import CaptureFault, check_least_side, damaged
from drgs.reconstruct.capture.load_views.read_pictures import mask_channel, mask_of_depth

OPAQUE = 128
FIRST_TURNED = 5
"""Of EXIF's eight orientations: from this on width and height change places."""


@dataclass(frozen=True)
class PictureFile:
    """Where a picture and its mask lie."""

    name: str
    image: Path
    mask: Path | None = None
    mask_is_depth: bool = False
    """As of a Photograph."""
    turned_by_exif: bool = False
    """Whether EXIF's orientation counts: plain photographs are turned upright, posed ones are as their cameras say."""


@dataclass(frozen=True, eq=False)
class SmallPicture:
    """What there is to look at."""

    color_srgb: UInt8[ndarray, "height width 3"]
    mask: UInt8[ndarray, "height width"] | None
    """255: object; None: neither alpha nor a file tells."""


def small_picture(file: PictureFile, side: int) -> SmallPicture:
    """The picture, its longer side at most `side` pixels.

    Raises:
        ValueError: it, or its mask, cannot be read, or they do not fit each other.
    """
    try:
        # A mask is as large as the whole picture.
        with opened_photograph(file.image, side if file.mask is None else None) as image:
            orientation = orientation_of(image) if file.turned_by_exif else 1
            width, height = reversed(image.size) if orientation >= FIRST_TURNED else image.size
            image.draft(None, (side, side))  # a JPEG is not decoded any larger
            picture = as_eight_bits(image if orientation == 1 else upright(image))
            has_alpha = "A" in picture.getbands() or "transparency" in picture.info
            check_least_side((width, height), file.image)
            scale = min(1.0, side / max(width, height))
            size = (max(1, round(width * scale)), max(1, round(height * scale)))
            pixels = np.asarray(picture.convert("RGBA" if has_alpha else "RGB").resize(size, Image.Resampling.BOX))
    except CaptureFault:
        raise
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise damaged(file.image, f"the image cannot be decoded ({error}).") from error
    alpha = pixels[..., 3] if has_alpha and (pixels[..., 3] < OPAQUE).any() else None
    if file.mask is None:
        return SmallPicture(pixels[..., :3], alpha)
    mask = mask_of_depth(file.mask) if file.mask_is_depth else mask_channel(file.mask)
    if mask.shape != (height, width):
        raise ValueError(f"{file.mask}: the mask is {mask.shape[1]}x{mask.shape[0]}, but its image {file.image.name} is {width}x{height}.")
    small = np.asarray(Image.fromarray(mask).resize(size, Image.Resampling.BOX))
    return SmallPicture(pixels[..., :3], small if alpha is None else np.minimum(alpha, small))
