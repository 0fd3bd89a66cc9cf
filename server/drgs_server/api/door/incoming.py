"""Uploads that arrive in parts and go on after a lost connection: what has come of each lies in the data directory, so that a restart loses none of it.

In: parts, each with the place that it begins at. Out: a file that is complete, for routes/captures.py to unpack. What counts as arrived is what the
file holds. Knows nothing of what is in the files, and nothing of HTTP but the problems that it raises.
"""

import asyncio
import os
import re
import uuid
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from weakref import WeakValueDictionary

from pydantic import BaseModel
from starlette.concurrency import run_in_threadpool
from starlette.requests import ClientDisconnect

from drgs_server.api.problems import ProblemError
from drgs_server.settings import Limits

WRITE_BYTES = 1 << 20
"""Gathered before they are written."""
_ID = re.compile(r"[0-9a-f]{32}")


class _Announced(BaseModel):
    """What a sender said at first, kept as ID.json."""

    name: str
    length: int


@dataclass(frozen=True)
class Incoming:
    """One upload, as far as it has come."""

    id: str
    name: str
    """Of the sender's file, as a name."""
    length: int
    """Bytes when it is complete."""
    offset: int
    """Bytes that have come."""
    path: Path


class IncomingUploads:
    """Final. `append` and `alone` are called on the event loop, the rest in any thread."""

    def __init__(self, folder: Path, limits: Limits) -> None:
        self._folder = folder
        self._limits = limits
        self._turns = count()
        self._newest: dict[str, int] = {}
        """Of each upload, who appends to it."""
        self._locks: WeakValueDictionary[str, asyncio.Lock] = WeakValueDictionary()
        """Of uploads that somebody works with; who does keeps the lock."""

    def announce(self, name: str, length: int) -> Incoming:
        """Make room for a file of this length.

        Raises:
            ProblemError: 413, it is too large; 429, too much is announced already.
        """
        if length > self._limits.upload_bytes:
            raise ProblemError(413, f"The upload has {length} bytes; at most {self._limits.upload_bytes} are taken.")
        others = list(self._all())
        if len(others) >= self._limits.incoming_uploads:
            raise ProblemError(429, f"{len(others)} uploads are unfinished; finish or delete one, or wait until the oldest is forgotten.")
        announced = sum(other.length for other in others)
        if announced + length > self._limits.incoming_bytes:
            raise ProblemError(
                429,
                f"Unfinished uploads have {announced} bytes, and with this one more than {self._limits.incoming_bytes}; finish or delete one.",
            )
        upload_id = uuid.uuid4().hex
        path = self._folder / upload_id
        path.touch(0o600, exist_ok=False)
        draft = self._folder / f".{upload_id}.new"
        draft.write_text(_Announced(name=name, length=length).model_dump_json())
        draft.rename(self._folder / f"{upload_id}.json")
        return self.read(upload_id)

    def read(self, upload_id: str) -> Incoming:
        """
        Raises:
            ProblemError: 404, there is no such upload.
        """
        path = self._folder / upload_id
        try:
            if not _ID.fullmatch(upload_id):
                raise FileNotFoundError
            said = _Announced.model_validate_json(path.with_suffix(".json").read_text())
            return Incoming(upload_id, said.name, said.length, path.stat().st_size, path)
        except FileNotFoundError as error:
            raise ProblemError(
                404, f"No upload has the id {upload_id[:64]!r}; it was used, deleted or forgotten. Begin another."
            ) from error

    async def append(self, upload_id: str, offset: int, parts: AsyncIterator[bytes]) -> Incoming:
        """Write what arrives, as it arrives. A later call for the same upload takes over: the connection of the earlier one may be dead without
        anybody here knowing.

        Raises:
            ProblemError: 404; 409, `offset` is not where the upload is, or another call took over; 413, more came than was announced.
        """
        turn = self._newest[upload_id] = next(self._turns)
        try:
            async with self.alone(upload_id):  # what the earlier call is writing just now still counts
                found = await run_in_threadpool(self.read, upload_id)
            if found.offset != offset:
                raise ProblemError(409, f"This upload goes on at byte {found.offset}; found a part that begins at {offset}.")
            at = offset
            async for part in _gathered(parts):
                if at + len(part) > found.length:
                    raise ProblemError(413, f"This upload was announced with {found.length} bytes; more came.")
                async with self.alone(upload_id):
                    if self._newest.get(upload_id) != turn:
                        raise ProblemError(409, "Another call goes on with this upload.")
                    await run_in_threadpool(_write, found.path, at, part)
                at += len(part)
            return await run_in_threadpool(self.read, upload_id)
        finally:
            if self._newest.get(upload_id) == turn:
                del self._newest[upload_id]

    @asynccontextmanager
    async def alone(self, upload_id: str) -> AsyncIterator[None]:
        """Nobody else writes or uses this upload meanwhile."""
        lock = self._locks.setdefault(upload_id, asyncio.Lock())
        async with lock:
            yield

    def remove(self, upload_id: str) -> None:
        """Forget an upload; does nothing where there is none."""
        path = self._folder / upload_id
        if _ID.fullmatch(upload_id):
            path.with_suffix(".json").unlink(missing_ok=True)
            path.unlink(missing_ok=True)

    def remove_before(self, time: float) -> int:
        """Forget uploads of which nothing has come since `time` [seconds since the epoch], and what is left of such. Returns how many files went."""
        gone = 0
        for path in self._folder.iterdir():
            try:
                if path.suffix == ".json" and path.with_suffix("").exists():
                    continue  # goes with what it tells of
                if path.stat().st_mtime < time:
                    path.with_suffix(".json").unlink(missing_ok=True)
                    path.unlink(missing_ok=True)
                    gone += 1
            except FileNotFoundError:
                continue
        return gone

    def _all(self) -> Iterator[Incoming]:
        for path in self._folder.glob("*.json"):
            try:
                yield self.read(path.stem)
            except ProblemError:
                continue  # it has just been used


async def _gathered(parts: AsyncIterator[bytes]) -> AsyncIterator[bytes]:
    """The same bytes in larger pieces; those before the connection was lost come, too."""
    held = bytearray()
    try:
        async for part in parts:
            held += part
            if len(held) >= WRITE_BYTES:
                yield bytes(held)
                held.clear()
    except ClientDisconnect:
        yield bytes(held)
        raise
    if held:
        yield bytes(held)


def _write(path: Path, at: int, part: bytes) -> None:
    try:
        descriptor = os.open(path, os.O_WRONLY)  # not made where it is gone
    except FileNotFoundError as error:
        raise ProblemError(404, "This upload was deleted meanwhile. Begin another.") from error
    try:
        done = 0
        while done < len(part):
            done += os.pwrite(descriptor, part[done:], at + done)
    finally:
        os.close(descriptor)
