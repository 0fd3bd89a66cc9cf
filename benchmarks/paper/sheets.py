"""Pictures side by side, each with its name above: what the figures are made of.

In: pictures on white in 0..1. Out: one JPEG, or one picture of a film.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

Array = NDArray[np.float64]
TITLE = 14
"""Height of a name [pixels]."""
GAP = 2
QUALITY = 82
MARGIN = 6
"""Around the object [pixels]."""


Rows = list[list[tuple[str, Array]]]
"""(name, picture (height, width, 3)); pictures of a row have one height."""


def sheet(rows: Rows, path: Path) -> None:
    """Write it whole."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f"{path.name}.part")
    _page(rows).save(part, "JPEG", quality=QUALITY)
    part.replace(path)


def film_picture(rows: Rows) -> Array:
    """(height, width, 3), 0..1."""
    return np.asarray(_page(rows), np.float64) / 255


def _page(rows: Rows) -> Image.Image:
    widths = [sum(picture.shape[1] + GAP for _, picture in row) for row in rows]
    heights = [row[0][1].shape[0] + TITLE + GAP for row in rows]
    page = Image.new("RGB", (max(widths), sum(heights)), "white")
    pen, top = ImageDraw.Draw(page), 0
    for row, height in zip(rows, heights, strict=True):
        left = 0
        for name, picture in row:
            pen.text((left + 2, top + 1), name, fill="black")
            page.paste(Image.fromarray((picture.clip(0, 1) * 255).round().astype(np.uint8)), (left, top + TITLE))
            left += picture.shape[1] + GAP
        top += height
    return page


def object_window(alphas: list[Array]) -> tuple[slice, slice]:
    """Rows and columns that hold what any of (height, width) shows, with a margin; all of them where nothing is shown."""
    shown = np.any(np.stack(alphas) > 0.02, axis=0)
    if not shown.any():
        return slice(None), slice(None)
    edges = [np.flatnonzero(shown.any(axis)) for axis in (1, 0)]
    return tuple(slice(max(int(found[0]) - MARGIN, 0), int(found[-1]) + MARGIN + 1) for found in edges)  # type: ignore[return-value]


def halved(picture: Array) -> Array:
    """Mean of each 2 x 2 pixels of (height, width, channel); an odd last row or column is left out."""
    height, width = picture.shape[0] // 2 * 2, picture.shape[1] // 2 * 2
    cut = picture[:height, :width]
    return 0.25 * (cut[::2, ::2] + cut[1::2, ::2] + cut[::2, 1::2] + cut[1::2, 1::2])
