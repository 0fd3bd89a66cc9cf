"""How the client sends large files: in parts, going on from what has arrived whenever the connection is lost or the server restarts
(api/routes/uploads.py has the protocol, tus 1.0.0)."""

import base64
import os
import tempfile
import time
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

import httpx

from drgs_server.client_stream import ServerError

PART_BYTES = 8 << 20
"""Sent in one request: what is lost at most when a proxy on the way keeps requests until they are whole."""
FIRST_PAUSE_SECONDS, LONGEST_PAUSE_SECONDS = 0.25, 10.0
"""Between attempts."""
PATIENCE_SECONDS = 300.0
"""Without a byte getting through, after which it is given up."""
TUS = {"Tus-Resumable": "1.0.0"}
BUSY = (408, 429, 502, 503, 504)
"""Answers after which the same call may succeed."""


def send_in_parts(
    http: httpx.Client,
    file: IO[bytes],
    name: str,
    progress: Callable[[float], None] = lambda _: None,
    patience_seconds: float = PATIENCE_SECONDS,
) -> str:
    """The id of the complete upload.

    Args:
        progress: is told the share that has arrived, 0..1.

    Raises:
        ServerError: the server refuses it, or has forgotten it.
        httpx.TransportError: nothing got through for so long.
    """
    length = file.seek(0, os.SEEK_END)
    attempts = _Attempts(http, patience_seconds)
    filename = base64.b64encode(name.encode()).decode()
    made = attempts.call("POST", "/api/uploads", {"Upload-Length": str(length), "Upload-Metadata": f"filename {filename}"})
    address = made.headers["Location"]
    offset = 0
    while offset < length:
        file.seek(offset)
        sent = attempts.try_call(
            "PATCH", address, {"Upload-Offset": str(offset), "Content-Type": "application/offset+octet-stream"}, file.read(PART_BYTES)
        )
        if sent is None or sent.status_code == httpx.codes.CONFLICT:
            sent = attempts.call("HEAD", address, {})
        arrived = int(sent.headers["Upload-Offset"])
        if arrived > offset:
            attempts.succeeded()
        offset = arrived
        progress(offset / length)
    return address.rpartition("/")[2]


class _Attempts:
    """Final. Calls that are made again, with growing pauses."""

    def __init__(self, http: httpx.Client, patience_seconds: float) -> None:
        self._http = http
        self._patience_seconds = patience_seconds
        self.succeeded()

    def succeeded(self) -> None:
        """Something got through: patience begins anew."""
        self._since = time.monotonic()
        self._pause_seconds = FIRST_PAUSE_SECONDS

    def call(self, method: str, path: str, headers: dict[str, str]) -> httpx.Response:
        """The answer, however many attempts it takes."""
        while True:
            if (answer := self.try_call(method, path, headers)) is not None:
                return answer

    def try_call(self, method: str, path: str, headers: dict[str, str], content: bytes | None = None) -> httpx.Response | None:
        """One attempt; None, after a pause, where the call may be made again. A conflict is an answer."""
        try:
            answer = self._http.request(method, path, headers=TUS | headers, content=content)
        except httpx.TransportError:
            if time.monotonic() - self._since > self._patience_seconds:
                raise
        else:
            if not answer.is_error or answer.status_code == httpx.codes.CONFLICT:
                return answer
            if answer.status_code not in BUSY or time.monotonic() - self._since > self._patience_seconds:
                raise server_error(answer)
        time.sleep(self._pause_seconds)
        self._pause_seconds = min(2 * self._pause_seconds, LONGEST_PAUSE_SECONDS)
        return None


def server_error(response: httpx.Response) -> ServerError:
    """What an answer says is wrong."""
    try:
        detail = response.json()["detail"]
    except (ValueError, KeyError, TypeError):
        detail = response.text[:200] or response.reason_phrase
    return ServerError(response.status_code, str(detail))


@contextmanager
def as_zip(path: Path) -> Iterator[IO[bytes]]:
    """The file itself, or a temporary zip of the folder (stored: pictures do not get smaller)."""
    if path.is_file():
        with path.open("rb") as file:
            yield file
        return
    if not path.is_dir():
        raise ValueError(f"{path}: expected the folder or zip of a capture")
    with tempfile.TemporaryFile() as file:
        with zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:
            for entry in sorted(path.rglob("*")):
                if entry.is_file():
                    archive.write(entry, entry.relative_to(path))
        file.seek(0)
        yield file
