"""The server's connections: how many are kept, how long a request may take to arrive, and how large its head may be. uvicorn's own protocol with
what it lacks, for it waits without end for what a caller does not send.

A connection is a stranger's until one of its requests has shown the token (security.py says so). Strangers cannot keep others out: there is
always a place for a new one, for which the oldest of the address that has most is closed. So a health check is answered however
many connections are open.
"""

import json
import logging
from asyncio import TimerHandle, Transport
from collections import Counter
from http import HTTPStatus
from typing import Any, ClassVar

from uvicorn.protocols.http.httptools_impl import STATUS_LINE, HttpToolsProtocol

from drgs_server.settings import Limits

CONNECTION = "drgs.connection"
"""Key of a scope: the GuardedConnection that its request came by."""

log = logging.getLogger(__name__)


class Connections:
    """Final. Those of one server, on its event loop. A stream's is counted until it becomes one, then by the gate."""

    def __init__(self, limits: Limits) -> None:
        self.limits = limits
        self._strangers: dict[GuardedConnection, None] = {}
        """Oldest first."""
        self._admitted: set[GuardedConnection] = set()

    def opened(self, connection: "GuardedConnection") -> None:
        """Count a new one, at the cost of an old stranger where there are too many."""
        if len(self._strangers) >= self.limits.stranger_connections:
            crowd = Counter(stranger.address for stranger in self._strangers).most_common(1)[0][0]
            of_crowd = [stranger for stranger in self._strangers if stranger.address == crowd]
            idle = next((stranger for stranger in of_crowd if not stranger.is_answered), of_crowd[0])
            self.closed(idle)
            idle.abort()
        self._strangers[connection] = None

    def admit(self, connection: "GuardedConnection") -> bool:
        """Whether it may stay as one of a caller with the token."""
        if self.is_admitted(connection):
            return True
        if len(self._admitted) >= self.limits.connections:
            return False
        self._strangers.pop(connection, None)
        self._admitted.add(connection)
        return True

    def is_admitted(self, connection: "GuardedConnection") -> bool:
        return connection in self._admitted

    def closed(self, connection: "GuardedConnection") -> None:
        self._strangers.pop(connection, None)
        self._admitted.discard(connection)


class GuardedConnection(HttpToolsProtocol):
    """One connection. Its classes are made by `guarded_connections`, each with the connections that it counts among."""

    guard: ClassVar[Connections]

    def connection_made(self, transport: Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self.address = self.client[0] if self.client else "?"
        self._timer: TimerHandle | None = None
        self._write_timer: TimerHandle | None = None
        self._head_bytes: int | None = 0
        """Of the request that is arriving; None between its head and the next request."""
        self._body_arrives = False
        self._heard_at = self.loop.time()
        self.guard.opened(self)
        self._wait(self.guard.limits.head_seconds)

    @property
    def is_answered(self) -> bool:
        """Whether an answer is under way."""
        return self.cycle is not None and not self.cycle.response_complete

    def admit(self) -> bool:
        """Whether it may stay, now that a request of it has shown the token."""
        return self.guard.admit(self)

    def abort(self) -> None:
        """Close at once, whatever is under way."""
        self._stop_timers()
        self.transport.abort()

    # ---- uvicorn's and the parser's calls ---------------------------------------------------------------------------------

    def connection_lost(self, exc: Exception | None) -> None:
        self._stop_timers()
        self.guard.closed(self)
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        self._heard_at = self.loop.time()
        super().data_received(data)
        if self.transport.is_closing() or self.parser is None or self.transport.get_protocol() is not self:
            return  # closed, or a stream's from here on
        if self._head_bytes is not None:
            self._head_bytes += len(data)
            self._check_head(self._head_bytes)
        elif not self._body_arrives and not self.is_answered and self._timer is None:
            # Line ends between two requests begin none, yet they stopped the clock of an idle connection.
            self._wait(self.guard.limits.head_seconds)

    def on_message_begin(self) -> None:
        super().on_message_begin()
        self.scope[CONNECTION] = self  # type: ignore[literal-required]
        if self._head_bytes is None:
            self._wait(self.guard.limits.head_seconds)
        self._head_bytes = 0

    def on_headers_complete(self) -> None:
        self._head_bytes, self._body_arrives = None, True
        self._wait(self.guard.limits.body_seconds)
        if self._check_head(len(self.url) + sum(len(name) + len(value) + 4 for name, value in self.headers)):
            super().on_headers_complete()

    def on_message_complete(self) -> None:
        super().on_message_complete()
        self._body_arrives = False
        self._stop_waiting()

    def handle_websocket_upgrade(self) -> None:
        self._stop_timers()
        self.guard.closed(self)
        super().handle_websocket_upgrade()

    def send_400_response(self, msg: str) -> None:
        if not self.transport.is_closing():  # else it was refused with a better sentence
            self._refuse(400, "This is no HTTP request that can be read.")

    def pause_writing(self) -> None:
        super().pause_writing()
        if self._write_timer is None:
            self._watch_writing()

    def resume_writing(self) -> None:
        super().resume_writing()
        if self._write_timer is not None:
            self._write_timer.cancel()
            self._write_timer = None

    # ---- clocks and refusals -----------------------------------------------------------------------------------------------

    def _wait(self, seconds: float) -> None:
        self._stop_waiting()
        self._timer = self.loop.call_later(seconds, self._overdue)

    def _stop_waiting(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _stop_timers(self) -> None:
        self._stop_waiting()
        if self._write_timer is not None:
            self._write_timer.cancel()
            self._write_timer = None

    def _overdue(self) -> None:
        """The head did not arrive in its time, or nothing of the body did."""
        self._timer = None
        if self.transport.is_closing():
            return
        limits, silent = self.guard.limits, self.loop.time() - self._heard_at
        if self._body_arrives:
            # Who has the token may take all the time that it needs, as long as something arrives, or we are those who do not read.
            admitted = self.guard.is_admitted(self)
            if self.flow.read_paused or (admitted and silent < limits.body_seconds):
                self._wait(limits.body_seconds - (0.0 if self.flow.read_paused else silent))
                return
            self._refuse(408, f"The body did not arrive: nothing of it came for {limits.body_seconds:g} s; send it again.")
        elif self.is_answered:
            self.cycle.keep_alive = False  # the next request will not be waited for
        elif self._head_bytes:
            self._refuse(408, f"The head of the request did not arrive within {limits.head_seconds:g} s; send it again.")
        else:
            self.transport.close()

    def _check_head(self, size: int) -> bool:
        most = self.guard.limits.head_bytes
        if size > most:
            self._refuse(431, f"The head of a request has at most {most} bytes; this one has more.")
        return size <= most

    def _watch_writing(self) -> None:
        """Let go of a caller that does not read: what waits for it must get less."""
        waiting, seconds = self.transport.get_write_buffer_size(), self.guard.limits.send_seconds

        def look() -> None:
            self._write_timer = None
            if self.transport.get_write_buffer_size() < waiting:
                self._watch_writing()
            else:
                log.warning("a caller at %s did not read its answer for %g s; the connection was closed", self.address, seconds)
                self.abort()

        self._write_timer = self.loop.call_later(seconds, look)

    def _refuse(self, status: int, sentence: str) -> None:
        """Answer without the app and close; of an answer under way only the connection's end is left to say."""
        self._stop_timers()
        cycle = self.cycle
        if cycle is not None and cycle.response_complete and self._body_arrives:
            self.transport.close()  # it was answered before its body came
            return
        if cycle is not None and not cycle.response_complete:
            started, cycle.disconnected = cycle.response_started, True
            cycle.message_event.set()
            if started:
                self.transport.abort()
                return
        problem: dict[str, Any] = {"type": "about:blank", "title": HTTPStatus(status).phrase, "status": status, "detail": sentence}
        body = json.dumps(problem).encode()
        head = [STATUS_LINE[status], *(b"%b: %b\r\n" % header for header in self.server_state.default_headers)]
        head.append(b"content-type: application/problem+json\r\ncontent-length: %d\r\nconnection: close\r\n\r\n" % len(body))
        self.transport.write(b"".join(head) + body)
        self.transport.close()


def guarded_connections(limits: Limits) -> type[GuardedConnection]:
    """The protocol for one server."""
    return type("GuardedConnections", (GuardedConnection,), {"guard": Connections(limits)})
