"""Where several machines share finished folders and files: a bucket of an S3-compatible store, or another folder (obstore).

In: a folder or file of this machine and what it is called. Out: the same bytes on another machine, or a sentence. An artifact is KIND/ID/
manifest.json, which names its files with their sizes and SHA-256, and KIND/ID/<SHA-256> for each content. The manifest is written last, so
a reader finds an artifact whole or not at all, and writing it anew sends only what changed. What comes back is compared with the manifest
before anybody sees it: the store is not trusted more than a disk. Credentials are obstore's to find (AWS_... variables, or the machine's role).
"""

import hashlib
import json
import os
import re
import shutil
import tempfile
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path, PurePosixPath
from typing import TypeVar

import obstore
from obstore.exceptions import BaseError
from obstore.store import LocalStore, MemoryStore, ObjectStore, S3Store

FORMAT, VERSION = "drgs artifact", 1
MANIFEST = "manifest.json"
SCHEMES = ("file:///", "memory://", "s3://")
ENDPOINT_VARIABLES = ("AWS_ENDPOINT_URL", "AWS_ENDPOINT")
MOST_FILES = 200_000
PIECE_BYTES = 8 << 20
"""Of one request, so that each ends in bounded time and memory."""
REQUEST_TIMEOUT = "30s"
CONNECT_TIMEOUT = "3s"
RETRIES = 3
RETRY_SECONDS = 10
"""A store that is away is known to be so after about this time."""
CONNECTIONS = 8
"""Files of one artifact on their way at the same time."""
TRIES = 3
"""When an artifact is written anew while it is read."""

Item = TypeVar("Item")

_ID = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,127}")
_SHA256 = re.compile(r"[0-9a-f]{64}")


class ArtifactError(Exception):
    """The text is a sentence."""


class StoreAway(ArtifactError):
    """The store does not answer, or refuses us; the same call may be made again."""


class ArtifactMissing(ArtifactError):
    """The store has no artifact of this name."""


class ArtifactDamaged(ArtifactError):
    """What the store holds is not what was put there."""


@dataclass(frozen=True)
class StoredFile:
    bytes: int
    sha256: str
    """Lower case, hexadecimal; also its name in the store."""


@dataclass(frozen=True)
class Manifest:
    """What an artifact consists of."""

    files: dict[str, StoredFile]
    """By path relative to the folder, with `/`; one entry `.` where the artifact is a single file."""

    @property
    def is_file(self) -> bool:
        return set(self.files) == {"."}

    @property
    def digest(self) -> str:
        """Equal for equal contents."""
        return hashlib.sha256(encode_manifest(self)).hexdigest()


def encode_manifest(manifest: Manifest) -> bytes:
    files = {path: vars(file) for path, file in sorted(manifest.files.items())}
    return json.dumps({"format": FORMAT, "version": VERSION, "files": files}, indent=1).encode()


def decode_manifest(data: bytes, what: str) -> Manifest:
    """
    Raises:
        ArtifactDamaged: no manifest of ours, a newer one, or one whose paths leave the folder.
    """
    try:
        document = json.loads(data)
        if document["format"] != FORMAT or document["version"] > VERSION:
            raise ValueError(f"its format is {document['format']!r}, version {document['version']!r}")
        files = {path: StoredFile(int(file["bytes"]), str(file["sha256"])) for path, file in document["files"].items()}
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise ArtifactDamaged(f"The stored manifest of {what} is damaged or newer than this program ({error}).") from error
    for path, file in files.items():
        if not _is_inside(path, len(files)) or file.bytes < 0 or not _SHA256.fullmatch(file.sha256):
            raise ArtifactDamaged(f"The stored manifest of {what} is damaged: its entry {path[:80]!r} names no place inside it.")
    if len(files) > MOST_FILES:
        raise ArtifactDamaged(f"The stored manifest of {what} is damaged: it names {len(files)} files; at most {MOST_FILES} are read.")
    return Manifest(files)


def _is_inside(path: str, count: int) -> bool:
    if path == ".":
        return count == 1
    return bool(path) and "\0" not in path and "\\" not in path and all(part not in ("", ".", "..") for part in path.split("/"))


class ArtifactStore:
    """Final. Thread-safe. Kinds and ids are the service's own, never a user's words."""

    def __init__(self, store: ObjectStore, name: str) -> None:
        """
        Args:
            name: of the store in sentences; holds no secret.
        """
        self._store = store
        self.name = name

    def put(self, kind: str, id: str, source: Path, leave_out: Callable[[str], bool] = lambda path: False) -> Manifest:
        """Keep a folder, or a file, under this name; what was there is replaced in one step.

        Args:
            leave_out: of a path relative to the folder: whether it stays here.

        Raises:
            StoreAway: nothing changed in the store that a reader would see.
        """
        place, what = self._place(kind, id), f"{kind}/{id}"
        paths = _files_below(source, leave_out)
        manifest = Manifest({path: _hashed(source / path) for path in paths})
        try:
            before = {file.sha256 for file in self.manifest(kind, id).files.values()}
        except (ArtifactMissing, ArtifactDamaged):
            before = set()
        wanted = {file.sha256: source / path for path, file in manifest.files.items() if file.sha256 not in before}

        def send(item: tuple[str, Path]) -> None:
            with self._answers(what):
                obstore.put(self._store, f"{place}/{item[0]}", item[1], chunk_size=PIECE_BYTES, max_concurrency=2)

        _all(send, list(wanted.items()))
        with self._answers(what):
            obstore.put(self._store, f"{place}/{MANIFEST}", encode_manifest(manifest))
        stale = sorted(before - {file.sha256 for file in manifest.files.values()})
        if stale:
            with self._answers(what):
                obstore.delete(self._store, [f"{place}/{name}" for name in stale])
        return manifest

    def manifest(self, kind: str, id: str) -> Manifest:
        """
        Raises:
            StoreAway, ArtifactMissing, ArtifactDamaged: a sentence.
        """
        with self._answers(f"{kind}/{id}"):
            data = bytes(obstore.get(self._store, f"{self._place(kind, id)}/{MANIFEST}").bytes())
        return decode_manifest(data, f"{kind}/{id}")

    def has(self, kind: str, id: str) -> bool:
        """
        Raises:
            StoreAway: a sentence.
        """
        try:
            with self._answers(f"{kind}/{id}"):
                obstore.head(self._store, f"{self._place(kind, id)}/{MANIFEST}")
        except ArtifactMissing:
            return False
        return True

    def get(self, kind: str, id: str, place: Path) -> None:
        """Fetch an artifact to where nothing is yet; another process that does the same at this time does no harm.

        Raises:
            StoreAway, ArtifactMissing, ArtifactDamaged: a sentence, and nothing is at `place`.
        """
        draft = Path(tempfile.mkdtemp(prefix=f".{place.name}.", dir=place.parent))
        try:
            manifest = self._fetch(kind, id, draft / "new")
            if manifest.is_file:
                os.replace(draft / "new", place)
                return
            try:
                (draft / "new").rename(place)
            except OSError:
                if not place.is_dir():  # else another one was quicker, with the same bytes
                    raise
        finally:
            shutil.rmtree(draft, ignore_errors=True)

    def get_file(self, kind: str, id: str, path: str) -> bytes:
        """One small file of an artifact.

        Raises:
            StoreAway, ArtifactMissing, ArtifactDamaged: a sentence.
        """
        file = self.manifest(kind, id).files.get(path)
        if file is None:
            raise ArtifactMissing(f"The store {self.name} has no {path} of {kind}/{id}.")
        pieces: list[bytes] = []
        self._receive(kind, id, path, file, pieces.append)
        return b"".join(pieces)

    def update(self, kind: str, id: str, place: Path, manifest: Manifest, keep: Callable[[str], bool]) -> None:
        """Make a folder of this machine the same as the stored one, file by file.

        Args:
            keep: of a path relative to the folder: whether it is this machine's own.

        Raises:
            StoreAway, ArtifactMissing, ArtifactDamaged: a sentence; files that came are there.
        """
        draft = Path(tempfile.mkdtemp(prefix=f".{place.name}.", dir=place.parent))
        try:
            here = {path: _hashed(place / path) for path in _files_below(place, keep)}
            changed = {path: file for path, file in manifest.files.items() if here.get(path) != file}
            self._fetch_files(kind, id, Manifest(changed), draft)
            for path in changed:
                (place / path).parent.mkdir(mode=0o700, parents=True, exist_ok=True)
                os.replace(draft / path, place / path)
            for path in here.keys() - manifest.files.keys():
                (place / path).unlink()
        finally:
            shutil.rmtree(draft, ignore_errors=True)

    def delete(self, kind: str, id: str) -> None:
        """Forget an artifact, if there is one.

        Raises:
            StoreAway: a sentence; call it again.
        """
        place = self._place(kind, id)
        with self._answers(f"{kind}/{id}"):
            paths = [entry["path"] for page in obstore.list(self._store, f"{place}/") for entry in page]
            # The manifest first: from then on there is no artifact.
            for found in ([p for p in paths if p.endswith(f"/{MANIFEST}")], [p for p in paths if not p.endswith(f"/{MANIFEST}")]):
                if found:
                    obstore.delete(self._store, found)

    def list(self, kind: str) -> list[str]:
        """Ids, sorted.

        Raises:
            StoreAway: a sentence.
        """
        with self._answers(kind):
            paths = [PurePosixPath(entry["path"]) for page in obstore.list(self._store, f"{kind}/") for entry in page]
        return sorted(path.parent.name for path in paths if path.name == MANIFEST)

    def _fetch(self, kind: str, id: str, place: Path) -> Manifest:
        manifest = self.manifest(kind, id)
        for attempt in range(TRIES):
            try:
                self._fetch_files(kind, id, manifest, place)
            except ArtifactMissing as error:
                newer = self.manifest(kind, id)
                if newer == manifest or attempt == TRIES - 1:
                    raise ArtifactDamaged(f"The stored copy of {kind}/{id} is damaged: one of its files is gone.") from error
                manifest = newer  # it was written anew meanwhile
                shutil.rmtree(place, ignore_errors=True)
            else:
                break
        return manifest

    def _fetch_files(self, kind: str, id: str, manifest: Manifest, folder: Path) -> None:
        def receive(item: tuple[str, StoredFile]) -> None:
            target = folder / item[0]
            target.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            with target.open("wb") as out:
                self._receive(kind, id, item[0], item[1], out.write)

        if not manifest.is_file:
            folder.mkdir(mode=0o700, exist_ok=True)
        _all(receive, list(manifest.files.items()))

    def _receive(self, kind: str, id: str, path: str, file: StoredFile, take: Callable[[bytes], object]) -> None:
        address, digest, received = f"{self._place(kind, id)}/{file.sha256}", hashlib.sha256(), 0
        while received < file.bytes:
            length = min(PIECE_BYTES, file.bytes - received)
            try:
                with self._answers(f"{kind}/{id}"):
                    piece = bytes(obstore.get_range(self._store, address, start=received, length=length))
            except StoreAway:
                # Asked for bytes beyond the end, stores differ in what they say.
                with self._answers(f"{kind}/{id}"):
                    if obstore.head(self._store, address)["size"] >= file.bytes:
                        raise
                break
            digest.update(piece)
            received += len(piece)
            take(piece)
            if len(piece) < length:
                break
        if received != file.bytes or digest.hexdigest() != file.sha256:
            raise ArtifactDamaged(
                f"The stored copy of {kind}/{id} is damaged: {'the file' if path == '.' else path} has other bytes than were put there "
                f"({received} of {file.bytes}); bring {self.name} back from a backup, or delete what is damaged."
            )

    def _place(self, kind: str, id: str) -> str:
        if not _ID.fullmatch(kind) or not _ID.fullmatch(id):
            raise ValueError(f"an artifact is called KIND/ID with letters, digits, '_', '.' and '-'; found {kind}/{id[:80]}")
        return f"{kind}/{id}"

    @contextmanager
    def _answers(self, what: str) -> Iterator[None]:
        """Around calls of obstore and nothing else: its errors in our words. Of those that say what is not there, only a missing bucket
        concerns the store itself."""
        try:
            yield
        except FileNotFoundError as error:
            if "NoSuchBucket" in str(error):
                raise StoreAway(f"The artifact store {self.name} does not exist; make the bucket, or name another one.") from error
            raise ArtifactMissing(f"The store {self.name} does not have {what}.") from error
        except (BaseError, OSError) as error:
            reason = str(error).strip().splitlines()[0][:300]
            raise StoreAway(
                f"The artifact store {self.name} does not answer, or refuses this service; nothing was changed. Try again in a moment. ({reason})"
            ) from error


def open_artifact_store(url: str) -> ArtifactStore:
    """The store that a setting names: file:///FOLDER, memory:// (of this process alone) or s3://BUCKET[/PREFIX].

    Raises:
        ValueError: the address is of another kind, or obstore cannot make sense of it.
    """
    try:
        if url.startswith("file:///"):
            folder = Path(url.removeprefix("file://"))
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            return ArtifactStore(LocalStore(folder), url)
        if url.startswith("memory://"):
            return ArtifactStore(MemoryStore(), url)
        if url.startswith("s3://"):
            # Whoever names an endpoint without TLS wants it so.
            plain = any(os.environ.get(name, "").startswith("http://") for name in ENDPOINT_VARIABLES)
            store = S3Store.from_url(
                url,
                client_options={"timeout": REQUEST_TIMEOUT, "connect_timeout": CONNECT_TIMEOUT, "allow_http": plain},
                retry_config={"max_retries": RETRIES, "retry_timeout": timedelta(seconds=RETRY_SECONDS)},
            )
            return ArtifactStore(store, url)
    except (BaseError, OSError) as error:
        raise ValueError(f"artifact store {url}: {str(error).splitlines()[0]}") from error
    raise ValueError(f"artifact store {url}: expected one of {', '.join(SCHEMES)}")


def _files_below(folder: Path, leave_out: Callable[[str], bool]) -> list[str]:
    """Relative paths, sorted; links are left out, since they lead elsewhere."""
    if folder.is_file():
        return ["."]
    found = (path for path in folder.rglob("*") if path.is_file() and not path.is_symlink())
    return sorted(name for name in (path.relative_to(folder).as_posix() for path in found) if not leave_out(name))


def _hashed(path: Path) -> StoredFile:
    with path.open("rb") as file:
        return StoredFile(os.fstat(file.fileno()).st_size, hashlib.file_digest(file, "sha256").hexdigest())


def _all(work: Callable[[Item], None], items: list[Item]) -> None:
    """Several at a time; the first error ends it."""
    if len(items) < 2:
        for item in items:
            work(item)
        return
    with ThreadPoolExecutor(min(CONNECTIONS, len(items)), thread_name_prefix="artifacts") as pool:
        for _ in pool.map(work, items):
            pass
