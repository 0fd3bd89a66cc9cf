"""Unpack an uploaded zip, or refuse it with a sentence and leave nothing behind.

Nothing that the archive says of itself is trusted: bytes are counted while they are read. Source of the list: service reference, 13.5.
"""

import shutil
import stat
import tempfile
import zipfile
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import IO

from drgs.exchange.zip_entries import open_entry, open_zip

_CHUNK_BYTES = 1 << 20
_LONGEST_PART = 255
"""Bytes of a file's name that file systems take."""


@dataclass(frozen=True)
class ZipLimits:
    entries: int = 20_000
    total_bytes: int = 8 << 30
    """Unpacked."""
    ratio: float = 200.0
    """Of unpacked to packed size, an entry; those below `ratio_from_bytes` are exempt."""
    ratio_from_bytes: int = 1 << 20
    path_length: int = 400


def unpack_zip(source: IO[bytes], target: Path, limits: ZipLimits | None = None) -> None:
    """Unpack into the new folder `target`, which exists afterwards only if all went well.

    Raises:
        ValueError: a sentence that names the entry and what is wrong with it.
    """
    limits = limits or ZipLimits()
    target.parent.mkdir(parents=True, exist_ok=True)
    draft = Path(tempfile.mkdtemp(prefix=".unpack-", dir=target.parent))
    try:
        with open_zip(source, "What was sent") as archive:
            _unpack(archive, draft, limits)
        draft.rename(target)
    except BaseException:
        shutil.rmtree(draft, ignore_errors=True)
        raise


def _unpack(archive: zipfile.ZipFile, folder: Path, limits: ZipLimits) -> None:
    entries = archive.infolist()
    if len(entries) > limits.entries:
        raise ValueError(f"The zip has {len(entries)} entries; at most {limits.entries} are read.")
    is_folder: dict[str, bool] = {}
    total = 0
    for entry in entries:
        path = safe_path(entry.filename, limits)
        kind = stat.S_IFMT(entry.external_attr >> 16)
        if kind not in (0, stat.S_IFREG, stat.S_IFDIR):
            raise ValueError(f"The zip's entry {entry.filename!r} is a link or a device; only files and folders are read.")
        # Case is folded: on some disks two such names are one file.
        key = str(path).casefold()
        if not entry.is_dir() and is_folder.get(key) is False:
            raise ValueError(f"The zip has two entries of the name {entry.filename!r}.")
        if is_folder.setdefault(key, entry.is_dir()) != entry.is_dir() or not all(
            is_folder.setdefault(str(parent), True) for parent in PurePosixPath(key).parents
        ):
            raise ValueError(f"The zip's entry {entry.filename!r} is both a file and a folder.")
        place = folder / path
        if entry.is_dir():
            place.mkdir(parents=True, exist_ok=True)
        else:
            place.parent.mkdir(parents=True, exist_ok=True)
            total = _copy_entry(archive, entry, place, total, limits)


def _copy_entry(archive: zipfile.ZipFile, entry: zipfile.ZipInfo, place: Path, total: int, limits: ZipLimits) -> int:
    """Returns the bytes unpacked so far in all."""
    size = 0
    with open_entry(archive, entry, f"The zip's entry {entry.filename!r}") as source, place.open("xb") as file:
        while chunk := source.read(_CHUNK_BYTES):
            size += len(chunk)
            if total + size > limits.total_bytes:
                raise ValueError(f"The zip unpacks to more than {limits.total_bytes} bytes.")
            if size > limits.ratio_from_bytes and size > limits.ratio * max(entry.compress_size, 1):
                raise ValueError(f"The zip's entry {entry.filename!r} unpacks to more than {limits.ratio:g} times its size.")
            file.write(chunk)
    return total + size


def safe_path(name: str, limits: ZipLimits) -> PurePosixPath:
    """The entry's path inside the target folder.

    Raises:
        ValueError: absolute, with a drive, a backslash, `..`, a control character, or too long, as a whole or in a part.
    """
    path = PurePosixPath(name)
    bad = (
        not name
        or len(name) > limits.path_length
        or path.is_absolute()
        or "\\" in name
        or ":" in name
        or any(part in ("", ".", "..") for part in name.rstrip("/").split("/"))
        or any(ord(character) < 32 for character in name)
        or any(len(part.encode()) > _LONGEST_PART for part in path.parts)
    )
    if bad:
        raise ValueError(f"The zip's entry {name[:80]!r} does not name a place inside the folder it is unpacked to.")
    return path


def single_folder(folder: Path) -> Path:
    """Where the content is: archives often hold one folder that holds everything."""
    inside = [path for path in folder.iterdir() if path.name not in ("__MACOSX", ".DS_Store")]
    return inside[0] if len(inside) == 1 and inside[0].is_dir() else folder
