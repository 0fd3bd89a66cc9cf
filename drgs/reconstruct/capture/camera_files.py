"""Photographs as telephones and cameras write them: HEIC (the extra `heic`) and RAW (the extra `raw`), opened as any other picture.

RAW is developed by LibRaw, all pictures alike: with the camera's white balance, without brightening any, in sRGB, upright. So what differs between two of
them is what the camera saw. Its JPEG of the same name, where it wrote both, is taken instead. In: a file. Out: a Pillow image.
"""

import io
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from PIL import ExifTags, Image

from drgs.exchange.pictures import read_exif
from drgs.installation import install_command
from drgs.maths.constants import SRGB_GAMMA, SRGB_SLOPE
from drgs.reconstruct.capture.load_views.checks import HEIC_SUFFIXES, IMAGE_SUFFIXES, MOST_PIXELS

RAW_SUFFIXES = (".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2")
KEPT_TAGS = (ExifTags.Base.FocalLengthIn35mmFilm, ExifTags.Base.FocalLength)
"""Of what the camera wrote into a RAW file's preview. Its orientation is spent: LibRaw turns what it develops."""
_PLAIN = tuple({suffix.lower() for suffix in IMAGE_SUFFIXES})


def is_photograph(path: Path) -> bool:
    """Whether its name is that of a picture of any kind that can be read."""
    return path.suffix.lower() in (*_PLAIN, *HEIC_SUFFIXES, *RAW_SUFFIXES)


def is_header_readable(path: Path) -> bool:
    """Whether load_views/checks.image_size tells the size of such a file."""
    return path.suffix.lower() in _PLAIN


def without_developed(paths: list[Path]) -> list[Path]:
    """Of files that cameras wrote, without those RAW files of which there is a finished picture of the same name beside them."""
    finished = {path.with_suffix("") for path in paths if path.suffix.lower() not in RAW_SUFFIXES}
    return [path for path in paths if path.suffix.lower() not in RAW_SUFFIXES or path.with_suffix("") not in finished]


def check_readers(paths: Iterable[Path]) -> None:
    """
    Raises:
        ValueError: some are of a kind whose reader is not installed; says how to install it.
    """
    files = list(paths)
    for kind, suffixes, module, package, extra in (
        ("HEIC", HEIC_SUFFIXES, "pillow_heif", "pillow-heif", "heic"),
        ("RAW", RAW_SUFFIXES, "rawpy", "rawpy", "raw"),
    ):
        found = [path for path in files if path.suffix.lower() in suffixes]
        if found and find_spec(module) is None:
            raise ValueError(
                f"{found[0]}: {len(found)} pictures are {kind}, expected PNG, JPEG or WebP; export them as JPEG in full size, or install "
                f"{package} with: {install_command(extra)}"
            )


@contextmanager
def opened_photograph(path: Path, least_side: int | None = None) -> Iterator[Image.Image]:
    """The picture, decoded when it is first looked into; RAW at once.

    Args:
        least_side: a RAW file's picture may have half its size, if its longer side then still has this many pixels. None: it has all of them.

    Raises:
        OSError, SyntaxError, ValueError, Image.DecompressionBombError: it cannot be read, here or later.
    """
    suffix = path.suffix.lower()
    if suffix in RAW_SUFFIXES:
        yield _developed(path, least_side)
        return
    formats: tuple[str, ...] = ("PNG", "JPEG", "WEBP")
    if suffix in HEIC_SUFFIXES:
        import pillow_heif

        pillow_heif.register_heif_opener()
        formats = ("HEIF",)
    with Image.open(path, formats=formats) as image:
        yield image


def _developed(path: Path, least_side: int | None) -> Image.Image:
    import rawpy

    try:
        with rawpy.imread(str(path)) as raw:
            width, height = raw.sizes.width, raw.sizes.height
            if width * height > MOST_PIXELS:
                raise ValueError(f"{path}: {width}x{height} pixels, expected at most {MOST_PIXELS // 10**6} megapixels.")
            exif = _told_by_camera(raw)
            half = least_side is not None and max(width, height) // 2 >= least_side
            pixels = raw.postprocess(use_camera_wb=True, no_auto_bright=True, output_bps=8, gamma=(SRGB_GAMMA, SRGB_SLOPE), half_size=half)
    except rawpy.LibRawError as error:
        raise ValueError(f"{path}: not a readable RAW file ({error}).") from error
    picture = Image.fromarray(pixels)
    picture.info["exif"] = exif
    return picture


def _told_by_camera(raw: Any) -> bytes:
    """EXIF with KEPT_TAGS, as far as the preview in a RAW file tells them."""
    import rawpy

    own = Image.Exif()
    try:
        preview = raw.extract_thumb()
        if preview.format == rawpy.ThumbFormat.JPEG:
            with Image.open(io.BytesIO(preview.data), formats=("JPEG",)) as small:
                told = read_exif(small, ExifTags.IFD.Exif)
            own.get_ifd(ExifTags.IFD.Exif).update({tag: told[tag] for tag in KEPT_TAGS if tag in told})
        return own.tobytes()
    except (
        rawpy.LibRawError,
        OSError,
        SyntaxError,
        ValueError,
        Image.DecompressionBombError,
    ):  # no preview, or a damaged one: the picture is no worse
        return Image.Exif().tobytes()
