"""Pictures of more than 8 bits a channel, made 8-bit, and what cameras wrote into them. In and out: Pillow images.

Pillow's own `convert` cuts 16-bit grey off at 255, so that all but the darkest shades become white: whoever reads pictures of strangers calls
`as_eight_bits` before it. Colour of 16 bits needs nothing, since Pillow keeps the high byte of each channel as it reads.
"""

import io
import math

import numpy as np
from jaxtyping import UInt8
from numpy import ndarray
from PIL import ExifTags, Image

_MOST = 65535
"""Of a 16-bit channel."""


_TURNS = {
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_270,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_90,
}
"""What makes a picture of an EXIF orientation upright."""


def read_exif(image: Image.Image, folder: int | None = None) -> dict[int, object]:
    """EXIF's values by tag, of one of its folders; none where they are damaged, for then the picture is no worse than one without."""
    try:
        found = image.getexif()
        return dict(found if folder is None else found.get_ifd(folder))
    except Exception:  # Pillow lets whatever a damaged block provokes escape
        return {}


def exif_number(values: dict[int, object], tag: int) -> float | None:
    """A value above nothing; None where there is none, or no number."""
    try:
        number = float(values[tag])  # type: ignore[arg-type]
    except (KeyError, TypeError, ValueError, ZeroDivisionError, OverflowError):
        return None
    return number if math.isfinite(number) and number > 0 else None


def orientation_of(image: Image.Image) -> int:
    """EXIF's, from 1 (upright) to 8; 1 where there is none of these."""
    found = read_exif(image).get(ExifTags.Base.Orientation)
    return found if isinstance(found, int) and found in _TURNS else 1


def upright(image: Image.Image) -> Image.Image:
    """The picture turned as EXIF's orientation says."""
    turn = _TURNS.get(orientation_of(image))
    return image if turn is None else image.transpose(turn)


def encode_png(texels: UInt8[ndarray, "height width channel"]) -> bytes:
    """A PNG file of sRGB colours, with straight alpha where there are four channels."""
    stream = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(texels)).save(stream, "PNG", compress_level=4)
    return stream.getvalue()


def as_eight_bits(image: Image.Image) -> Image.Image:
    """The picture itself, or one of mode L (LA where one shade of it is transparent) in place of 16-bit grey.

    Raises:
        ValueError: whole numbers beyond 16 bits.
        OSError, SyntaxError: the picture is damaged.
    """
    if not image.mode.startswith("I"):
        return image
    values = np.asarray(image).astype(np.int64)
    if values.min() < 0 or values.max() > _MOST:
        raise ValueError(f"its values span {values.min()} to {values.max()}, expected 0 to {_MOST}")
    grey = Image.fromarray(((values + 128) // 257).astype(np.uint8))
    transparent = image.info.get("transparency")
    if isinstance(transparent, int):
        grey.putalpha(Image.fromarray(np.where(values == transparent, 0, 255).astype(np.uint8)))
    return grey
