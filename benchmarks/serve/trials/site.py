"""A server under trial: started by its command on a folder of its own, asked through its public interface, and read off its log.

`Trial` is one thing that is tried. It says in a sentence what did not hold, or None.
"""

import http.client
import json
import os
import queue
import signal
import subprocess
import sys
import threading
import time
import uuid
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

START_SECONDS = 120.0
STOP_SECONDS = 50.0
ANSWER_SECONDS = 60.0
"""Longer than this no single call may take."""
LONGEST_SENTENCE = 1000
"""Characters of an error: what was sent is not sent back whole."""
REFUSED = frozenset({400, 401, 403, 404, 405, 409, 411, 413, 414, 415, 422, 429, 431})
"""What a wrong call may be answered with."""


@dataclass(frozen=True)
class Trial:
    """One thing that is tried."""

    group: str
    name: str
    run: Callable[["Site"], str | None]
    quick: bool = True
    """Whether the short form runs it, too."""


@dataclass(frozen=True)
class Answer:
    """Of one call."""

    status: int
    headers: dict[str, str]
    """By lower-case name."""
    body: bytes
    seconds: float

    @property
    def document(self) -> Any:
        return json.loads(self.body)

    @property
    def sentence(self) -> str:
        """`detail` of a problem, else the body's beginning."""
        try:
            return str(self.document["detail"])
        except (ValueError, KeyError, TypeError):
            return self.body[:200].decode(errors="replace")


@dataclass
class Site:
    """Final. Start it before the first trial."""

    folder: Path
    worker: bool = False
    environment: dict[str, str] = field(default_factory=dict)
    """More variables for the server."""
    process: subprocess.Popen | None = None
    port: int = 0
    token: str = ""
    asset: str = ""
    """Id of a small object that every trial may use."""
    mesh: bytes = b""
    """The file that it was made of."""
    shared_session: str = ""
    """Id of a session for trials that leave it as it was; made by the first of them."""

    @property
    def data(self) -> Path:
        return self.folder / "data"

    @property
    def log(self) -> Path:
        return self.folder / "server.log"

    def command(self) -> list[str]:
        worker = "--worker" if self.worker else "--no-worker"
        return [sys.executable, "-m", "drgs", "serve", "--data", str(self.data), "--port", "0", worker]

    def launch(self) -> subprocess.Popen:
        """The process, which may not have come up yet."""
        with self.log.open("ab") as log:
            return subprocess.Popen(
                self.command(),
                stdout=subprocess.PIPE,
                stderr=log,
                text=True,
                env={**os.environ, **self.environment},
                start_new_session=True,
            )

    def start(self) -> None:
        """
        Raises:
            OSError: it did not come up.
        """
        self.process = self.launch()
        line = first_line(self.process)
        if "#token=" not in line:
            self.kill()
            raise OSError(f"the server did not start: it said {line!r}; its log ends {self.log.read_text(errors='replace')[-500:]!r}")
        address, _, self.token = line.split()[-1].partition("/#token=")
        self.port = int(address.rpartition(":")[2])

    def stop(self) -> None:
        if self.process is not None and self.process.poll() is None:
            self.process.send_signal(signal.SIGTERM)
            try:
                self.process.wait(STOP_SECONDS)
            except subprocess.TimeoutExpired:
                self.kill()

    def kill(self) -> None:
        """As kill -9, together with everything that it started."""
        if self.process is not None and self.process.poll() is None:
            os.killpg(self.process.pid, signal.SIGKILL)
            self.process.wait()

    def request(
        self,
        method: str,
        path: str,
        body: bytes | None = None,
        headers: dict[str, str] | None = None,
        bearer: bool = True,
        seconds: float = ANSWER_SECONDS,
    ) -> Answer:
        """One call on a connection of its own.

        Raises:
            OSError, http.client.HTTPException: no answer.
        """
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=seconds)
        start = time.monotonic()
        try:
            sent = {"Authorization": f"Bearer {self.token}"} if bearer else {}
            connection.request(method, path, body, sent | (headers or {}))
            answer = connection.getresponse()
            content = answer.read()
            found = {name.lower(): value for name, value in answer.getheaders()}
            return Answer(answer.status, found, content, time.monotonic() - start)
        finally:
            connection.close()

    def send(self, method: str, path: str, document: Any, **options: Any) -> Answer:
        """A call with a JSON body."""
        return self.request(method, path, json.dumps(document).encode(), {"Content-Type": "application/json"}, **options)

    def upload(self, path: str, name: str, data: bytes, fields: dict[str, str] | None = None, seconds: float = 120.0) -> Answer:
        """A multipart call with one file."""
        border = uuid.uuid4().hex
        parts = [
            f'--{border}\r\nContent-Disposition: form-data; name="{key}"\r\n\r\n{value}\r\n'.encode()
            for key, value in (fields or {}).items()
        ]
        head = f'--{border}\r\nContent-Disposition: form-data; name="file"; filename="{name}"\r\nContent-Type: application/octet-stream\r\n\r\n'
        body = b"".join(parts) + head.encode() + data + f"\r\n--{border}--\r\n".encode()
        return self.request("POST", path, body, {"Content-Type": f"multipart/form-data; boundary={border}"}, seconds=seconds)

    def session(self, asset: str | None = None) -> str:
        """Id of a new session."""
        answer = self.send("POST", "/api/sessions", {"asset": asset or self.asset})
        if answer.status != 201:
            raise OSError(f"no session: {answer.status} {answer.sentence}")
        return answer.document["id"]

    def complaint(self, answer: Answer, allowed: Iterable[int] = REFUSED) -> str | None:
        """What is wrong with an answer: its status, or the sentence of an error."""
        if answer.status not in set(allowed):
            return f"answered {answer.status}: {answer.sentence[:200]}"
        if answer.status < 400:
            return None
        if "json" not in answer.headers.get("content-type", "json"):
            # The web server's own answers to what is no HTTP, or too long or too slow for it.
            return None if answer.status in (400, 408, 431) else f"{answer.status} is no problem: {answer.body[:100]!r}"
        if len(answer.sentence) > LONGEST_SENTENCE:
            return f"the sentence has {len(answer.sentence)} characters"
        if str(self.folder) in answer.sentence or "Traceback" in answer.sentence:
            return f"the sentence shows the server's inside: {answer.sentence[:200]}"
        if answer.status in (429, 503) and "retry-after" not in answer.headers:
            return f"{answer.status} without Retry-After"
        return None

    def is_well(self) -> str | None:
        """Whether it still answers."""
        try:
            answer = self.request("GET", "/healthz", bearer=False, seconds=20)
        except (OSError, http.client.HTTPException) as error:
            return f"healthz did not answer ({error})"
        return None if answer.status == 200 else f"healthz answered {answer.status}"


def first_line(process: subprocess.Popen, seconds: float = START_SECONDS) -> str:
    """The first line on its stdout; empty if there is none in time or at all."""
    lines: queue.Queue[str] = queue.Queue()
    stdout = process.stdout
    assert stdout is not None
    threading.Thread(target=lambda: lines.put(stdout.readline()), daemon=True).start()
    try:
        return lines.get(timeout=seconds).strip()
    except queue.Empty:
        return ""
