"""Textures of an imported mesh, looked up at its vertices.

In: Pillow's pictures, which are decoded here, and texture coordinates. Out: values at the vertices. A few kilobytes may claim any number of pixels,
so all pictures of a file together are bounded before they are decoded, and a picture is looked through in bands: it is in memory once, as Pillow
keeps it (4 bytes a pixel). What the values mean is the caller's business.
"""

from typing import Any

import numpy as np
from jaxtyping import Float, Int, UInt8
from numpy import ndarray
from PIL import Image

from drgs.exchange.pictures import as_eight_bits

MAX_TEXTURE_PIXELS = 1 << 27
"""Of all textures of a file that are looked up: two of 8192x8192."""
_ROWS_AT_ONCE = 256


class Textures:
    """Final. Those of one file."""

    def __init__(self, name: str) -> None:
        """
        Args:
            name: of the file, for sentences.
        """
        self._name = name
        self._sizes: dict[int, tuple[int, Any]] = {}
        """id of each picture -> its pixels, and the picture, so that no other gets its id."""

    def sample(self, image: Image.Image | None, uv: Float[ndarray, "vertex 2"]) -> Float[ndarray, "vertex 3"]:
        """Bilinear values in 0..1, repeating; uv has its origin at the lower left, as trimesh turns it.

        Args:
            image: None where trimesh did not find a picture that it can open.

        Raises:
            ValueError: no picture, a damaged one, too many pixels, or coordinates that are not finite.
        """
        if image is None:
            raise ValueError(
                f"{self._name}: names a texture that cannot be read; expected PNG, JPEG or WebP of at most {MAX_TEXTURE_PIXELS} pixels"
            )
        width, height = image.size
        self._charge(image)
        x, y = uv[:, 0] * width - 0.5, (1 - uv[:, 1]) * height - 0.5
        if not (np.isfinite(x).all() and np.isfinite(y).all()):
            raise ValueError(f"{self._name}: holds texture coordinates that are not finite")
        x0, y0 = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
        fx, fy = (x - x0)[:, None], (y - y0)[:, None]
        columns = np.stack([x0, x0 + 1, x0, x0 + 1]) % width
        rows = np.stack([y0, y0, y0 + 1, y0 + 1]) % height
        try:
            corners = _texels(image, columns.reshape(-1), rows.reshape(-1)).reshape(4, -1, 3).astype(np.float32) / 255
        except MemoryError:
            raise
        except Exception as error:  # Pillow lets whatever a damaged picture provokes escape
            raise ValueError(f"{self._name}: holds a damaged texture ({error})") from error
        low, high = (corners[k] * (1 - fx) + corners[k + 1] * fx for k in (0, 2))
        return low * (1 - fy) + high * fy

    def _charge(self, image: Image.Image) -> None:
        self._sizes[id(image)] = image.size[0] * image.size[1], image
        pixels = sum(size for size, _ in self._sizes.values())
        if pixels > MAX_TEXTURE_PIXELS:
            width, height = image.size
            raise ValueError(
                f"{self._name}: has a texture of {width}x{height} pixels, with which its textures have {pixels}; "
                f"the limit is {MAX_TEXTURE_PIXELS}: make them smaller"
            )


def _texels(image: Image.Image, columns: Int[ndarray, "place"], rows: Int[ndarray, "place"]) -> UInt8[ndarray, "place 3"]:
    """The colours of these pixels."""
    width, height = image.size
    found = np.empty((len(rows), 3), np.uint8)
    for top in range(0, height, _ROWS_AT_ONCE):
        inside = np.flatnonzero((rows >= top) & (rows < top + _ROWS_AT_ONCE))
        if len(inside):
            band = as_eight_bits(image.crop((0, top, width, min(top + _ROWS_AT_ONCE, height)))).convert("RGB")
            found[inside] = np.asarray(band)[rows[inside] - top, columns[inside]]
    return found
