"""Unpack an uploaded zip, or refuse it with a sentence and leave nothing behind.

Nothing that the archive says of itself is trusted: bytes are counted while they are read. Source of the list: service reference, 13.5.
"""

import shutil
import stat
import tempfile
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import IO

_CHUNK_BYTES = 1 << 20


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
        try:
            with zipfile.ZipFile(source) as archive:
                _unpack(archive, draft, limits)
        except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError, UnicodeDecodeError) as error:
            raise ValueError(f"The zip is damaged or of a kind that is not read here ({error}).") from error
        draft.rename(target)
    except BaseException:
        shutil.rmtree(draft, ignore_errors=True)
        raise


def _unpack(archive: zipfile.ZipFile, folder: Path, limits: ZipLimits) -> None:
    entries = archive.infolist()
    if len(entries) > limits.entries:
        raise ValueError(f"The zip has {len(entries)} entries; at most {limits.entries} are read.")
    names: set[str] = set()
    total = 0
    for entry in entries:
        path = safe_path(entry.filename, limits)
        kind = stat.S_IFMT(entry.external_attr >> 16)
        if kind not in (0, stat.S_IFREG, stat.S_IFDIR):
            raise ValueError(f"The zip's entry {entry.filename!r} is a link or a device; only files and folders are read.")
        if entry.flag_bits & 0x1:
            raise ValueError(f"The zip's entry {entry.filename!r} is encrypted; pack it without a password.")
        # Case is folded: on some disks two such names are one file.
        key = str(path).casefold()
        if key in names and not entry.is_dir():
            raise ValueError(f"The zip has two entries of the name {entry.filename!r}.")
        names.add(key)
        place = folder / path
        if entry.is_dir():
            place.mkdir(parents=True, exist_ok=True)
            continue
        try:
            place.parent.mkdir(parents=True, exist_ok=True)
            total = _copy_entry(archive, entry, place, total, limits)
        except (FileExistsError, NotADirectoryError, IsADirectoryError) as error:
            raise ValueError(f"The zip's entry {entry.filename!r} is both a file and a folder.") from error


def _copy_entry(archive: zipfile.ZipFile, entry: zipfile.ZipInfo, place: Path, total: int, limits: ZipLimits) -> int:
    """Returns the bytes unpacked so far in all."""
    size = 0
    with archive.open(entry) as source, place.open("xb") as file:
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
        ValueError: absolute, with a drive, a backslash, `..`, a control character, or too long.
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
    )
    if bad:
        raise ValueError(f"The zip's entry {name[:80]!r} does not name a place inside the folder it is unpacked to.")
    return path


def single_folder(folder: Path) -> Path:
    """Where the content is: archives often hold one folder that holds everything."""
    inside = [path for path in folder.iterdir() if path.name not in ("__MACOSX", ".DS_Store")]
    return inside[0] if len(inside) == 1 and inside[0].is_dir() else folder
