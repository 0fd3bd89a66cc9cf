"""The photographs of a capture as one file beside an asset's others: photographs.zip, small WebP pictures 0000.webp, 0001.webp ...

In and out: 8-bit pictures in the order of the asset's cameras, with alpha where the capture has masks. What a server hands to browsers passes
`check_photographs` first, since anybody may have made it. Nothing here imports torch: the API process reads single pictures.
"""

import io
import zipfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from drgs.exchange.zip_entries import open_entry, open_zip

PHOTOGRAPHS = "photographs.zip"
LONGEST_SIDE = 800
"""Of a kept picture [pixels]; it is for comparing by eye."""
QUALITY = 88
MAX_PICTURE_BYTES = 4 << 20
_FIRST_DATE = (1980, 1, 1, 0, 0, 0)
"""The same pictures give the same file."""


def entry_name(number: int) -> str:
    """Of the picture of one camera, counted from 0."""
    return f"{number:04d}.webp"


def encode_photographs(pictures: Sequence[np.ndarray]) -> bytes:
    """
    Args:
        pictures: (height, width, 3 or 4) uint8, sRGB with straight alpha; larger ones than LONGEST_SIDE are made smaller.
    """
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for number, pixels in enumerate(pictures):
            picture = Image.fromarray(np.ascontiguousarray(pixels))
            factor = LONGEST_SIDE / max(picture.size)
            if factor < 1:
                width, height = (max(1, round(side * factor)) for side in picture.size)
                picture = picture.resize((width, height), Image.Resampling.LANCZOS)
            file = io.BytesIO()
            picture.save(file, "WEBP", quality=QUALITY, method=2)
            info = zipfile.ZipInfo(entry_name(number), _FIRST_DATE)
            info.external_attr = 0o100644 << 16
            archive.writestr(info, file.getvalue(), zipfile.ZIP_STORED)
    return stream.getvalue()


def check_photographs(data: bytes, count: int, what: str) -> None:
    """
    Args:
        count: of the asset's cameras. what: begins the sentences, such as a path.

    Raises:
        ValueError: it holds anything else than `count` small WebP pictures.
    """
    with open_zip(io.BytesIO(data), what) as archive:
        names = [entry.filename for entry in archive.infolist()]
        if names != [entry_name(number) for number in range(count)]:
            raise ValueError(f"{what} holds {len(names)} files; expected {count} pictures, one a camera, from {entry_name(0)} on")
        for name in names:
            _check_picture(_read(archive, name, what), f"{what}: {name}")


def _check_picture(data: bytes, what: str) -> None:
    try:
        with Image.open(io.BytesIO(data), formats=("WEBP",)) as picture:
            if max(picture.size) > LONGEST_SIDE:
                raise ValueError(f"it has {picture.width} x {picture.height} pixels; expected at most {LONGEST_SIDE} a side")
            picture.load()
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise ValueError(f"{what} is no WebP picture that can be read ({error})") from error


def read_photograph(path: Path, number: int) -> bytes | None:
    """One picture as a WebP file; None where the file or the picture is not there.

    Raises:
        ValueError: the file is damaged.
    """
    if not path.is_file():
        return None
    with open_zip(path, str(path)) as archive:
        return _read(archive, entry_name(number), str(path)) if entry_name(number) in archive.namelist() else None


def _read(archive: zipfile.ZipFile, name: str, what: str) -> bytes:
    entry = archive.getinfo(name)
    if entry.compress_type != zipfile.ZIP_STORED or entry.file_size > MAX_PICTURE_BYTES:
        raise ValueError(f"{what}: {name} is packed or too large; expected a picture of at most {MAX_PICTURE_BYTES} bytes, stored as it is")
    with open_entry(archive, entry, f"{what}: {name}") as stream:
        return stream.read(MAX_PICTURE_BYTES)
