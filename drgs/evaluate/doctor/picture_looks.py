"""What can be seen of each picture of a capture by itself: whether it is sharp, well exposed, textured, and the same as another.

In: files. Out: a record of each picture. Pictures are read one at a time, or a few, at LOOKED_SIDE.
"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, UInt8
from numpy import ndarray
from PIL import Image

from drgs.reconstruct.capture.laplacian_variance import laplacian_variance
from drgs.reconstruct.capture.load_views.capture import Capture
from drgs.reconstruct.capture.small_picture import PictureFile, SmallPicture, small_picture

LOOKED_SIDE = 800
"""[pixels]: about what builds fit to."""
DECODE_THREADS = 2
THUMBNAIL_SIDE = 48
"""Pictures are compared at this size [pixels]."""
CLIPPED_SHADE, BLACK_SHADE = 254, 8
"""Of 255: at the first a channel has no more to say, below the second hardly anything of the object is seen."""
CELL = 8
"""Pixels of a cell that may hold something to recognise."""
LEAST_SLOPE = 4.0
"""Root mean square of brightness's slope [shades a pixel] that a cell needs in each direction: noise of usual photographs has 1 to 2."""


@dataclass(frozen=True, eq=False)
class PictureLook:
    """What one picture looks like."""

    name: str
    sharpness: float
    """Variance of the Laplacian on the object [squared shades]."""
    fineness: float
    """That, over the same at a quarter of the size: contrast and what is shown change it little, blur takes it away."""
    clipped_share: float
    """Of the object's pixels: with a channel that is over-exposed."""
    black_share: float
    """Of the object's pixels: with hardly any light."""
    textured_cells: int
    """Of the object: with slopes in two directions, as features have them (Shi, Tomasi 1994, docs/sources.md: shi1994)."""
    thumbnail: UInt8[ndarray, "side side 3"]
    """Of what is on the mask, the rest black."""
    mask_share: float | None
    """Of the picture; None: no mask."""


def files_of_capture(capture: Capture) -> list[PictureFile]:
    """Of a posed capture."""
    return [PictureFile(photo.name, photo.image, photo.mask, photo.mask_is_depth) for photo in capture.photographs]


def picture_looks(files: Sequence[PictureFile]) -> list[PictureLook | str]:
    """One a picture, in their order, or why it cannot be read."""

    def looked_at(file: PictureFile) -> PictureLook | str:
        try:
            return _picture_look(file.name, small_picture(file, LOOKED_SIDE))
        except ValueError as error:
            return str(error)

    with ThreadPoolExecutor(DECODE_THREADS) as pool:
        return list(pool.map(looked_at, files))


def _picture_look(name: str, picture: SmallPicture) -> PictureLook:
    color, mask = picture.color_srgb, picture.mask
    inside = np.ones(color.shape[:2], bool) if mask is None else mask > 200
    luma = np.asarray(Image.fromarray(color).convert("L"), dtype=np.float32)
    sharp = laplacian_variance(luma, _within(inside))
    coarse = laplacian_variance(_halved(_halved(luma)), _within(_halved(_halved(inside)) == 1))
    brightest = np.maximum(np.maximum(color[..., 0], color[..., 1]), color[..., 2])[inside]
    count = max(1, len(brightest))
    return PictureLook(
        name,
        sharp,
        sharp / coarse if coarse > 0 else 1.0,
        int((brightest >= CLIPPED_SHADE).sum()) / count,
        int((brightest <= BLACK_SHADE).sum()) / count,
        _textured_cells(luma, inside),
        _thumbnail(picture),
        None if mask is None else float(inside.mean()),
    )


def _thumbnail(picture: SmallPicture) -> UInt8[ndarray, "side side 3"]:
    size = (THUMBNAIL_SIDE, THUMBNAIL_SIDE)
    color = np.asarray(Image.fromarray(picture.color_srgb).resize(size, Image.Resampling.BOX))
    if picture.mask is None:
        return color
    mask = np.asarray(Image.fromarray(picture.mask).resize(size, Image.Resampling.BOX))
    return (color * (mask[..., None] / np.float32(255))).astype(np.uint8)


def _within(inside: Bool[ndarray, "height width"]) -> Bool[ndarray, "height width"]:
    """Without the pixels at the outline, whose step against the background says nothing of the object."""
    kept = inside.copy()
    for axis in (0, 1):
        for shift in (-1, 1):
            kept &= np.roll(inside, shift, axis)
    return kept


def _halved(values: ndarray) -> Float32[ndarray, "rows columns"]:
    """Averaged over squares of two by two."""
    height, width = (side // 2 * 2 for side in values.shape)
    rows = values[:height:2, :width].astype(np.float32) + values[1:height:2, :width]
    return (rows[:, ::2] + rows[:, 1::2]) / 4


def _textured_cells(luma: Float32[ndarray, "height width"], inside: Bool[ndarray, "height width"]) -> int:
    """Cells inside whose weaker direction of slope is steep enough: the smaller eigenvalue of the mean slopes' products."""
    rows, columns = (side // CELL for side in luma.shape)
    down, across = np.gradient(luma)

    def mean_of_cells(values: ndarray) -> Float32[ndarray, "rows columns"]:
        in_columns = values[: rows * CELL, : columns * CELL].reshape(rows, CELL, -1).mean(1, dtype=np.float32)
        return in_columns.reshape(rows, columns, CELL).mean(2)

    xx, yy, xy = mean_of_cells(across * across), mean_of_cells(down * down), mean_of_cells(across * down)
    smaller = (xx + yy) / 2 - np.sqrt(((xx - yy) / 2) ** 2 + xy * xy)
    return int(((smaller > LEAST_SLOPE**2) & (mean_of_cells(inside) == 1)).sum())
