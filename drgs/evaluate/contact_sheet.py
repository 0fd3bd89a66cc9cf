"""A contact sheet of a capture: each picture small, with what its mask says and what the doctor complains about, to be taken in at a glance.

In: a folder and the doctor's report on it. Out: a PNG or JPEG of at most MOST_BYTES. What is outside the mask is dimmed and the mask's outline drawn;
plain photographs without masks get the outline that their plain backdrop would give. Pictures are read one at a time.
"""

import io
import math
import os
import textwrap
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8
from numpy import ndarray
from PIL import Image, ImageDraw, ImageFont
from scipy.ndimage import binary_dilation

from drgs.evaluate.doctor.photographs import file_of
from drgs.evaluate.doctor.picture_looks import files_of_capture
from drgs.reconstruct.capture.load_views import has_cameras, read_capture
from drgs.reconstruct.capture.load_views.checks import is_folder, pictures_in
from drgs.reconstruct.capture.small_picture import PictureFile, SmallPicture, small_picture
from drgs.reconstruct.pose.list_photos import list_photos
from drgs.reconstruct.pose.posed_dataset import film_of
from drgs.reconstruct.pose.prepare_photos import BACKDROP_SHARE
from drgs.scene.views import Views

SHEET_FORMATS = {".png": "PNG", ".jpg": "JPEG", ".jpeg": "JPEG"}
MOST_BYTES = 3_000_000
MOST_TILES = 240
"""Of more pictures, those with marks and evenly chosen others are shown."""
WIDTH = 2100
"""Of a full sheet [pixels]."""
NARROWEST, WIDEST = 112, 400
"""Of a tile [pixels]: the first holds a name of twenty letters."""
COLUMNS_A_ROW = 1.5
GAP = 4
BACKGROUND, INK, QUIET_INK = (24, 24, 26), (235, 235, 235), (160, 160, 165)
GOOD, GUESSED, BAD = (80, 220, 120), (250, 200, 60), (240, 70, 60)
"""Of outlines given, outlines guessed by a plain backdrop, and marks."""
DIMMED = 0.3
"""Brightness of what is outside the mask."""
QUALITIES = (88, 75, 60, 45, 30)
"""Of JPEG, the first that is small enough."""
SHRINK = 0.85
LEVEL_INK = {"error": BAD, "warning": GUESSED, "info": QUIET_INK}


@dataclass(frozen=True)
class Tile:
    """A picture's place on the sheet."""

    file: PictureFile
    marks: tuple[str, ...]


@dataclass(frozen=True)
class Grid:
    """How tiles lie."""

    columns: int
    rows: int
    side: int
    """Of a picture [pixels]."""
    letter: int
    """Height of labels [pixels]."""

    @property
    def tile_height(self) -> int:
        return self.side + self.letter + 3 * GAP


@dataclass(frozen=True)
class SheetLayout:
    """Where the tiles of a sheet lie, so that a page can show them in rows of its own. All lengths are shares of the sheet's width or height."""

    count: int
    """Of tiles."""
    columns: int
    left: float
    """Of the first tile."""
    top: float
    across: float
    """From one tile to the next in its row."""
    down: float
    """From one row to the next; a tile with its label is as high."""
    width: float
    """Of a tile."""
    aspect: float
    """A tile's width over its height [of its pixels]."""


def contact_sheet(folder: Path, report: dict[str, Any], out: Path, masked: Views | None = None) -> SheetLayout:
    """Write the sheet, and say how its tiles lie.

    Args:
        report: the doctor's, on this folder. out: its suffix says whether it becomes a PNG or a JPEG.
        masked: the capture as it is to be drawn, where its masks do not lie in the folder.

    Raises:
        ValueError: another suffix, or a folder without pictures.
    """
    kind = SHEET_FORMATS.get(out.suffix.lower())
    if kind is None:
        raise ValueError(f"{out}: a sheet is a {' or '.join(SHEET_FORMATS)} file, expected one of these suffixes.")
    files = _files_of(Path(folder))
    if not files:
        raise ValueError(
            f"{folder}: no pictures for a sheet; of a film, find poses first (drgs pose) and ask for the sheet of what that writes."
        )
    tiles = _chosen([Tile(file, tuple(report["marks"].get(file.name, ()))) for file in files])
    grid = grid_for(len(tiles))
    drawn = Image.new("RGB", (grid.columns * (grid.side + GAP) + GAP, grid.rows * grid.tile_height), BACKGROUND)
    drawer = _TileDrawer(report.get("source") == "photographs", {} if masked is None else _small_pictures(masked, grid.side))
    for number, tile in enumerate(tiles):
        row, column = divmod(number, grid.columns)
        drawer.draw(drawn, tile, (GAP + column * (grid.side + GAP), row * grid.tile_height), grid)
    head = _head(report, drawer.what_masks_are(), len(files), len(tiles), drawn.width)
    sheet = Image.new("RGB", (drawn.width, head.height + drawn.height), BACKGROUND)
    sheet.paste(head, (0, 0))
    sheet.paste(drawn, (0, head.height))
    draft = out.with_name(f".{out.name}.part")
    draft.write_bytes(_encoded(sheet, kind))
    os.replace(draft, out)
    return _layout(grid, len(tiles), sheet.size, head.height)


def _layout(grid: Grid, count: int, size: tuple[int, int], head: int) -> SheetLayout:
    width, height = size
    return SheetLayout(
        count=count,
        columns=grid.columns,
        left=GAP / width,
        top=head / height,
        across=(grid.side + GAP) / width,
        down=grid.tile_height / height,
        width=grid.side / width,
        aspect=grid.side / grid.tile_height,
    )


def grid_for(count: int) -> Grid:
    """Columns and tiles for so many pictures: wider than high, tiles as large as the sheet's width allows."""
    columns = max(3, math.ceil(math.sqrt(COLUMNS_A_ROW * count)))
    side = min(WIDEST, max(NARROWEST, WIDTH // columns - GAP))
    return Grid(columns, math.ceil(count / columns), side, letter=max(11, min(20, side // 12)))


def _files_of(folder: Path) -> list[PictureFile]:
    """The capture's pictures; of a folder that cannot be read as one, all that lie there."""
    try:
        if film_of(folder) is not None:
            return []
        if has_cameras(folder):
            return files_of_capture(read_capture(folder))
        return [file_of(photo) for photo in list_photos(folder)]
    except (ValueError, OSError):
        if not is_folder(folder):
            raise
        found = [path for path in pictures_in(folder) if path.relative_to(folder).parts[0] != "masks"]
        return [PictureFile(path.stem, path) for path in found]


def _small_pictures(views: Views, side: int) -> dict[str, SmallPicture]:
    """By name, of at most `side` pixels."""
    found = {}
    for camera, image, mask in zip(views.cameras, views.images_srgb, views.coverage, strict=True):
        scale = min(1.0, side / max(camera.width, camera.height))
        size = (max(1, round(scale * camera.width)), max(1, round(scale * camera.height)))
        color, small = (np.asarray(Image.fromarray(whole.numpy()).resize(size, Image.Resampling.BOX)) for whole in (image, mask))
        found[camera.name] = SmallPicture(color, small)
    return found


def _chosen(tiles: list[Tile]) -> list[Tile]:
    """At most MOST_TILES, in their order."""
    if len(tiles) <= MOST_TILES:
        return tiles
    marked = [number for number, tile in enumerate(tiles) if tile.marks][: MOST_TILES // 2]
    others = sorted(set(range(len(tiles))) - set(marked))
    left = MOST_TILES - len(marked)
    return [tiles[number] for number in sorted([*marked, *(others[k * len(others) // left] for k in range(left))])]


class _TileDrawer:
    """Draws tiles one after the other and counts what masks they have. Final."""

    def __init__(self, guesses: bool, known: Mapping[str, SmallPicture]) -> None:
        self._known = known
        self._guesses = guesses
        """Whether a plain backdrop is looked for where there is no mask, as a build of photographs without poses does."""
        self._shown = self._given = self._guessed = 0

    def draw(self, sheet: Image.Image, tile: Tile, corner: tuple[int, int], grid: Grid) -> None:
        draw = ImageDraw.Draw(sheet)
        x, y = corner
        marks = list(tile.marks)
        try:
            picture = self._known.get(tile.file.name) or small_picture(tile.file, grid.side)
        except ValueError:
            marks = marks or ["cannot be read"]
            draw.line([(x, y), (x + grid.side, y + grid.side)], BAD, 2)
            draw.line([(x, y + grid.side), (x + grid.side, y)], BAD, 2)
        else:
            thumbnail = self._with_outline(picture, tile.file)
            sheet.paste(thumbnail, (x + (grid.side - thumbnail.width) // 2, y + (grid.side - thumbnail.height) // 2))
        font = _font(grid.letter)
        if marks:
            text = _fitting(", ".join(dict.fromkeys(marks)), font, grid.side - 2 * GAP)
            draw.rectangle([x, y, x + grid.side - 1, y + grid.side - 1], outline=BAD, width=3)
            draw.rectangle([x, y + grid.side - grid.letter - 2 * GAP, x + grid.side - 1, y + grid.side - 1], fill=BAD)
            draw.text((x + GAP, y + grid.side - grid.letter - 3 * GAP // 2), text, (255, 255, 255), font)
        draw.text((x + 1, y + grid.side + 1), _fitting(tile.file.name, font, grid.side - 2), BAD if marks else QUIET_INK, font)

    def what_masks_are(self) -> str:
        """A sentence for the sheet's head, after all tiles are drawn."""
        if self._given:
            return f"Green: the outlines of the masks ({self._given} of {self._shown} pictures); what is outside is dimmed."
        if not self._guesses:
            return "No masks: the build looks for the object itself, which is not shown here."
        if self._guessed >= BACKDROP_SHARE * self._shown:
            return f"No masks: a build cuts the object out of the plain backdrop, about as outlined in yellow ({self._guessed} of {self._shown} pictures)."
        return (
            f"No masks, and a plain backdrop in {self._guessed} of {self._shown} pictures only: a build poses whole pictures and looks for the object "
            "afterwards."
        )

    def _with_outline(self, picture: SmallPicture, file: PictureFile) -> Image.Image:
        mask, ink = picture.mask, GOOD
        self._shown += 1
        if mask is not None:
            self._given += 1
        elif self._guesses:
            from drgs.reconstruct.pose.backdrop_masks import backdrop_mask  # here: a sheet of masks that are given needs none of it

            # Asked at the thumbnail's own size, where the search asks a larger picture: the outline is about the same.
            mask, ink = backdrop_mask(picture.color_srgb), GUESSED
            self._guessed += mask is not None
        return Image.fromarray(picture.color_srgb if mask is None else _outlined(picture.color_srgb, mask, ink))


def _outlined(
    color_srgb: UInt8[ndarray, "height width 3"], mask: UInt8[ndarray, "height width"], ink: tuple[int, int, int]
) -> UInt8[ndarray, "height width 3"]:
    """What is outside dimmed, and a line just outside the mask."""
    share = mask[..., None] / np.float32(255)
    shown = (color_srgb * (DIMMED + (1 - DIMMED) * share)).astype(np.uint8)
    inside = mask > 127
    shown[binary_dilation(inside, iterations=1 if max(mask.shape) < 2 * NARROWEST else 2) & ~inside] = ink
    return shown


def _head(report: dict[str, Any], about_masks: str, count: int, shown: int, width: int) -> Image.Image:
    """What the doctor says, above the pictures."""
    title, font = _font(22), _font(16)
    letters = max(20, round(width / font.getlength("n") * 1.1))
    of_all = f" {shown} of {count} are shown." if shown < count else ""
    lines = [
        ((report["summary"] or f"{count} pictures; there is nothing to build from yet.") + of_all, INK, title),
        (about_masks, QUIET_INK, font),
    ]
    lines += [(f"{finding['level']}: {finding['sentence']}", LEVEL_INK[finding["level"]], font) for finding in report["findings"]]
    wrapped = [(part, ink, used) for text, ink, used in lines for part in _wrapped(text, letters if used is font else round(0.7 * letters))]
    image = Image.new("RGB", (width, sum(round(1.4 * used.size) for *_, used in wrapped) + 3 * GAP), BACKGROUND)
    draw, y = ImageDraw.Draw(image), GAP
    for text, ink, used in wrapped:
        draw.text((2 * GAP, y), text, ink, used)
        y += round(1.4 * used.size)
    return image


def _wrapped(text: str, letters: int) -> Iterator[str]:
    yield from textwrap.wrap(text, letters) or [""]


def _font(size: int) -> Any:
    return ImageFont.load_default(size)


def _fitting(text: str, font: Any, width: int) -> str:
    """The text, or its beginning and its end."""
    if font.getlength(text) <= width:
        return text
    for kept in range(len(text) - 1, 1, -1):
        shorter = f"{text[: kept - kept // 3]}…{text[len(text) - kept // 3 :]}"
        if font.getlength(shorter) <= width:
            return shorter
    return text[:1]


def _encoded(sheet: Image.Image, kind: str) -> bytes:
    """The file, of at most MOST_BYTES: fewer colours or a lower quality first, then fewer pixels."""
    while True:
        for setting in QUALITIES if kind == "JPEG" else (None, 256):
            stream = io.BytesIO()
            if kind == "JPEG":
                sheet.save(stream, kind, quality=setting, optimize=True)
            else:
                (sheet if setting is None else sheet.quantize(setting, dither=Image.Dither.NONE)).save(stream, kind, optimize=True)
            if stream.tell() <= MOST_BYTES:
                return stream.getvalue()
        sheet = sheet.resize((round(SHRINK * sheet.width), round(SHRINK * sheet.height)), Image.Resampling.LANCZOS)
