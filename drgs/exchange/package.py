"""A folder, or the same zipped, of named files with a manifest that holds their hashes. Written atomically.

In and out: a manifest (plain JSON) and file name -> bytes. What the files mean is the caller's business.
Reading trusts nothing: names, sizes, compression ratios and hashes are checked, and nothing is unpacked to disk.
"""

import hashlib
import json
import os
import shutil
import tempfile
import zipfile
from pathlib import Path, PurePosixPath

from drgs.exchange.zip_entries import open_entry, open_zip

MANIFEST = "asset.json"
MAX_FILE_BYTES = 4 << 30
MAX_ENTRIES = 20_000
MAX_RATIO = 200
"""Of unpacked to packed size; a larger one in a file above a megabyte is a zip bomb."""
_CHUNK = 1 << 20


def write_package(path: Path, manifest: dict, files: dict[str, bytes]) -> None:
    """Write a folder (or a zip, if the path ends in .zip) at once: other programs see the old one or the new one.

    An existing package is replaced; files of the folder that are not the package's own stay. If the power fails between the
    two renames of a replacement, the old package is left beside the path under a name that ends in `.old`.

    Raises:
        ValueError: the path is taken by something that is no package.
    """
    path = Path(os.path.abspath(path))
    described = manifest | {
        "files": {name: {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()} for name, data in files.items()}
    }
    text = json.dumps(described, indent=1, allow_nan=False).encode()
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".zip":
        _write_zip(path, {MANIFEST: text, **files})
    else:
        _write_folder(path, {**files, MANIFEST: text})
    _sync_folder(path.parent)


def read_package(path: Path, known: tuple[str, ...], required: tuple[str, ...], newest: int) -> tuple[dict, dict[str, bytes]]:
    """The manifest and those files among `known` that it names.

    Raises:
        ValueError: one sentence: no manifest, a newer schema, an unsafe name, a missing, truncated or changed file.
    """
    path = Path(path)
    if path.is_dir():
        return _checked(path, lambda name: _read_file(path, name), known, required, newest)
    if not path.exists():
        raise ValueError(f"{path}: does not exist; expected an asset folder or zip")
    with open_zip(path, f"{path}: is no asset folder; as a file it") as archive:
        prefix = _check_names(path, archive)
        return _checked(path, lambda name: _read_entry(path, archive, prefix + name), known, required, newest)


def _checked(path: Path, read, known: tuple[str, ...], required: tuple[str, ...], newest: int) -> tuple[dict, dict[str, bytes]]:
    text = read(MANIFEST)
    if text is None:
        raise ValueError(f"{path}: has no {MANIFEST}; expected an asset")
    try:
        manifest = json.loads(text)
    except ValueError as error:
        raise ValueError(f"{path}: {MANIFEST} is damaged ({error})") from error
    except RecursionError as error:
        raise ValueError(f"{path}: {MANIFEST} is damaged (brackets within brackets without end)") from error
    version, listed = (manifest.get("schema_version"), manifest.get("files")) if isinstance(manifest, dict) else (None, None)
    if not isinstance(version, int) or isinstance(version, bool) or version < 1:
        raise ValueError(f"{path}: {MANIFEST} has the schema version {version!r}; expected a whole number from 1")
    if version > newest:
        raise ValueError(f"{path}: was written by a newer drgs (schema version {version}; this one reads up to {newest}); update drgs")
    if not isinstance(listed, dict):
        raise ValueError(f"{path}: {MANIFEST} lists no files; it is damaged")
    unsafe = [name for name in listed if name in ("", ".", "..") or any(c in name for c in "/\\:\0")]
    if unsafe:
        raise ValueError(f"{path}: {MANIFEST} names {unsafe[0]!r}; expected plain file names inside the asset")
    missing = [name for name in required if name not in listed]
    if missing:
        raise ValueError(f"{path}: {MANIFEST} does not list {missing[0]}; the asset is incomplete")
    files = {}
    for name in known:
        if name not in listed:
            continue
        data = read(name)
        if data is None:
            raise ValueError(f"{path}: {name} is missing; the asset is damaged")
        expected = listed[name] if isinstance(listed[name], dict) else {}
        if len(data) != expected.get("bytes"):
            raise ValueError(f"{path}: {name} has {len(data)} bytes, {expected.get('bytes')} were written; the asset is damaged")
        if hashlib.sha256(data).hexdigest() != expected.get("sha256"):
            raise ValueError(f"{path}: {name} has changed since it was written (its sha256 differs); the asset is damaged")
        files[name] = data
    return manifest, files


def _read_file(folder: Path, name: str) -> bytes | None:
    file = folder / name
    if not file.is_file():
        return None
    if file.stat().st_size > MAX_FILE_BYTES:
        raise ValueError(f"{file}: is larger than the limit of {MAX_FILE_BYTES} bytes")
    return file.read_bytes()


def _check_names(path: Path, archive: zipfile.ZipFile) -> str:
    """Refuse hostile entries; returns the folder inside the zip that holds the manifest, '' or 'name/'."""
    entries = archive.infolist()
    if len(entries) > MAX_ENTRIES:
        raise ValueError(f"{path}: has {len(entries)} entries; the limit is {MAX_ENTRIES}")
    names = [entry.filename for entry in entries]
    for entry in entries:
        parts = PurePosixPath(entry.filename).parts
        kind = entry.external_attr >> 28
        if "\\" in entry.filename or ":" in entry.filename or ".." in parts or entry.filename.startswith("/") or kind not in (0, 4, 8):
            raise ValueError(f"{path}: the zip entry {entry.filename!r} is no plain file inside the asset")
    if len(set(names)) < len(names):
        raise ValueError(f"{path}: two zip entries have one name")
    # A folder zipped with its own name holds everything one level down.
    return next(
        (name[: -len(MANIFEST)] for name in names if name == MANIFEST or (name.endswith("/" + MANIFEST) and name.count("/") == 1)), ""
    )


def _read_entry(path: Path, archive: zipfile.ZipFile, name: str) -> bytes | None:
    try:
        entry = archive.getinfo(name)
    except KeyError:
        return None
    chunks, size = [], 0
    with open_entry(archive, entry, f"{path}: {name}") as stream:
        while chunk := stream.read(_CHUNK):
            size += len(chunk)
            if size > MAX_FILE_BYTES or (size > _CHUNK and size > MAX_RATIO * entry.compress_size):
                raise ValueError(f"{path}: {name} unpacks to more than {MAX_RATIO} times its size or {MAX_FILE_BYTES} bytes")
            chunks.append(chunk)
    return b"".join(chunks)


def _write_zip(path: Path, files: dict[str, bytes]) -> None:
    if path.is_dir():
        raise ValueError(f"{path}: is a folder; choose another name for the zip")
    handle, name = tempfile.mkstemp(prefix=f".{path.name}.", suffix=".tmp", dir=path.parent)
    temporary = Path(name)
    try:
        with os.fdopen(handle, "wb") as stream:
            # Fixed dates: the same asset gives the same zip. Already compressed files are stored as they are.
            with zipfile.ZipFile(stream, "w") as archive:
                for file, data in files.items():
                    info = zipfile.ZipInfo(file, (1980, 1, 1, 0, 0, 0))
                    info.external_attr = 0o100644 << 16
                    packed = zipfile.ZIP_STORED if file.endswith((".exr", ".jpg", ".zip")) else zipfile.ZIP_DEFLATED
                    archive.writestr(info, data, packed, compresslevel=1)
            stream.flush()
            os.fsync(stream.fileno())
        temporary.chmod(0o644)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def _write_folder(path: Path, files: dict[str, bytes]) -> None:
    if path.exists() and not path.is_dir():
        raise ValueError(f"{path}: is a file; expected a folder to write the asset to, or a name ending in .zip")
    own = _own_files(path)
    foreign = sorted(name for name in files if name not in own and (path / name).exists())
    if foreign:
        raise ValueError(f"{path}: already holds {foreign[0]}, which belongs to no asset; move it away or choose another folder")
    temporary = Path(tempfile.mkdtemp(prefix=f".{path.name}.", suffix=".tmp", dir=path.parent))
    try:
        temporary.chmod(0o755)
        for name, data in files.items():
            with open(temporary / name, "wb") as stream:
                stream.write(data)
                stream.flush()
                os.fsync(stream.fileno())
        _sync_folder(temporary)
        if not path.exists():
            temporary.rename(path)
            return
        old = temporary.with_suffix(".old")
        path.rename(old)
        try:
            temporary.rename(path)
        except OSError:
            old.rename(path)
            raise
        for entry in old.iterdir():  # checkpoints and whatever else lives beside the asset's files
            if entry.name not in own:
                entry.rename(path / entry.name)
        shutil.rmtree(old)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _own_files(path: Path) -> set[str]:
    """Names that the package now at `path` wrote; empty where there is none."""
    if not (path / MANIFEST).is_file():
        return set()
    try:
        manifest = json.loads((path / MANIFEST).read_bytes())
    except ValueError:  # damaged: it names nothing, and is replaced
        return {MANIFEST}
    listed = manifest.get("files") if isinstance(manifest, dict) else None
    return {MANIFEST, *(listed if isinstance(listed, dict) else ())}


def _sync_folder(folder: Path) -> None:
    """Make renames inside a folder survive a power cut, where the system lets folders be opened."""
    if os.name == "nt":
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
