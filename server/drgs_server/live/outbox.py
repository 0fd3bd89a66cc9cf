"""What waits to be written to one client, bounded in bytes.

A whole edit log is not kept here: its place in the line is, and it is written down when its turn comes, as it is then. Changes of a log that a client
is too slow for give way to one whole log. Of pictures there are never more than a client may leave unacknowledged; everything else is
counted, and a client for which too much waits is let go.
"""

import asyncio
from collections import deque
from typing import Literal

Kind = Literal["picture", "text", "change", "log"]

MOST_MESSAGES = 2000


class Outbox:
    """Final. On the event loop."""

    def __init__(self, most_bytes: int) -> None:
        """
        Args:
            most_bytes: that may wait, without pictures.
        """
        self._most_bytes = most_bytes
        self._waiting: deque[tuple[Kind, str | bytes]] = deque()
        self._bytes = 0
        self._filled = asyncio.Event()
        self.overrun = asyncio.Event()
        """Set once too much waits; nothing is taken any more."""

    @property
    def waiting_bytes(self) -> int:
        """Without pictures."""
        return self._bytes

    def put(self, message: str | bytes) -> None:
        """A picture (bytes), or anything that must arrive."""
        self._append("picture" if isinstance(message, bytes) else "text", message)

    def put_change(self, message: str) -> None:
        """A change of the log; where half of what may wait is waiting already, the whole log instead of all that do."""
        if self._log_waits:
            return  # which will have this change in it
        if self._bytes + len(message) <= self._most_bytes // 2:
            self._append("change", message)
        else:
            self.put_log()

    def put_log(self) -> None:
        """The whole log, as it is when its turn comes; changes that wait are in it."""
        if self._log_waits:
            return
        self._waiting = deque(waiting for waiting in self._waiting if waiting[0] != "change")
        self._bytes = sum(len(message) for kind, message in self._waiting if kind != "picture")
        self._append("log", "")

    @property
    def _log_waits(self) -> bool:
        return any(kind == "log" for kind, _ in self._waiting)

    def _append(self, kind: Kind, message: str | bytes) -> None:
        if self.overrun.is_set():
            return
        self._waiting.append((kind, message))
        self._bytes += 0 if kind == "picture" else len(message)
        self._filled.set()
        if self._bytes > self._most_bytes or len(self._waiting) > MOST_MESSAGES:
            self._waiting.clear()
            self._bytes = 0
            self.overrun.set()

    async def take(self) -> tuple[Kind, str | bytes]:
        """The oldest, as soon as there is one."""
        while not self._waiting:
            self._filled.clear()
            await self._filled.wait()
        kind, message = self._waiting.popleft()
        self._bytes -= 0 if kind == "picture" else len(message)
        return kind, message
