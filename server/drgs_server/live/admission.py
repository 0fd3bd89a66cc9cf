"""One queue before everything heavy: how much runs at once, whose turn is next, and when to say "not now".

Heavy are finished pictures, poses, poses that turn out to be simulations, and the processes that read and write files. Each kind has a number
that may run at once; together they may take so much memory, by estimate. Who waits is served fairly: of those for whom there is room, the caller
that was served longest ago comes next, then the session of that caller, then the request that came first. A caller who leaves while waiting leaves
the queue, and where too many wait already the answer is 429 with the time after which trying again makes sense.
"""

import asyncio
import time
from collections import OrderedDict
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from itertools import count
from typing import Literal

from drgs_server.api.problems import ProblemError
from drgs_server.settings import Limits

Kind = Literal["picture", "pose", "simulation", "file"]
Caller = tuple[str, ...]
"""Whom a request is for, the widest first: the address, then the session."""

WAITING_SIMULATIONS = 16
"""Each keeps a thread, which holds what it has computed so far."""
LONGEST_RETRY_SECONDS = 60.0
KNOWN_CALLERS = 10_000
"""Whose last turn is remembered."""
_WEIGHT = 0.2
"""Of the newest measurement of how long a kind takes."""


@dataclass(eq=False)
class _Waiting:
    kind: Kind
    caller: Caller
    bytes: int
    number: int
    admitted: asyncio.Future[None] = field(default_factory=lambda: asyncio.get_running_loop().create_future())


class Place:
    """Final. What one request holds; on the event loop."""

    def __init__(self, admission: "Admission", kind: Kind, caller: Caller, bytes: int) -> None:
        self._admission = admission
        self._caller = caller
        self._held: tuple[Kind, int, float] | None = None
        self.kind = kind
        self.bytes = bytes

    async def enter(self) -> None:
        """Wait for the turn.

        Raises:
            ProblemError: too many wait already.
        """
        await self._admission._wait(self.kind, self._caller, self.bytes)
        self._held = (self.kind, self.bytes, self._admission._clock())

    async def become(self, kind: Kind, bytes: int = 0) -> None:
        """Give the place up and wait for one of another kind; raises as `enter` does, and then holds none."""
        self.leave()
        self.kind, self.bytes = kind, bytes
        await self.enter()

    def leave(self) -> None:
        """Whatever is held is free for others; more than once does no harm."""
        if self._held is not None:
            held, self._held = self._held, None
            self._admission._free(*held)


class Admission:
    """Final. All methods are called on the event loop."""

    def __init__(self, limits: Limits, clock: Callable[[], float] = time.monotonic) -> None:
        self._numbers: dict[Kind, int] = {
            "picture": limits.pictures_at_once,
            "pose": limits.poses_at_once,
            "simulation": limits.simulations_at_once,
            "file": limits.file_tools_at_once,
        }
        self._limits = limits
        self._clock = clock
        self._running: dict[Kind, int] = dict.fromkeys(self._numbers, 0)
        self._bytes = 0
        self._waiting: list[_Waiting] = []
        self._arrivals = count()
        self._turns = count(1)
        self._served: OrderedDict[Caller, int] = OrderedDict()
        """The number of each caller's last turn."""
        self._seconds: dict[Kind, float] = dict.fromkeys(self._numbers, 1.0)
        """That one of a kind takes."""

    def running(self, kind: Kind) -> int:
        return self._running[kind]

    def waiting(self) -> int:
        return len(self._waiting)

    @asynccontextmanager
    async def place(self, kind: Kind, caller: Caller, bytes: int = 0) -> AsyncIterator[Place]:
        """Room for one heavy thing, for as long as the context lasts.

        Args:
            bytes: of memory that it takes, estimated; 0 for what is only counted.

        Raises:
            ProblemError: 429, too many wait already.
        """
        place = Place(self, kind, caller, bytes)
        await place.enter()
        try:
            yield place
        finally:
            place.leave()

    async def _wait(self, kind: Kind, caller: Caller, bytes: int) -> None:
        waiting = _Waiting(kind, caller, min(bytes, self._limits.heavy_bytes), next(self._arrivals))
        of_kind = [other for other in self._waiting if other.kind == kind]
        if not (self._waiting if bytes else of_kind) and self._has_room(waiting):
            self._admit(waiting)
            return
        most = WAITING_SIMULATIONS if kind == "simulation" else self._limits.waiting
        of_caller = sum(other.caller[:1] == caller[:1] for other in of_kind)
        if len(of_kind) >= most or of_caller >= self._limits.waiting_of_one:
            seconds = max(1.0, min(LONGEST_RETRY_SECONDS, self._seconds[kind] * len(of_kind) / self._numbers[kind]))
            raise ProblemError(429, f"{len(of_kind)} requests like this one wait already; try again in a moment.", retry_after=seconds)
        self._waiting.append(waiting)
        try:
            await waiting.admitted
        except asyncio.CancelledError:
            if waiting.admitted.done() and not waiting.admitted.cancelled():
                self._free(kind, waiting.bytes, self._clock())  # its turn had just come
            else:
                self._waiting.remove(waiting)
                self._next()  # one behind it may fit
            raise

    def _has_room(self, waiting: _Waiting) -> bool:
        if self._running[waiting.kind] >= self._numbers[waiting.kind]:
            return False
        # What needs more than there is runs alone.
        return not waiting.bytes or not self._bytes or self._bytes + waiting.bytes <= self._limits.heavy_bytes

    def _admit(self, waiting: _Waiting) -> None:
        self._running[waiting.kind] += 1
        self._bytes += waiting.bytes
        turn = next(self._turns)
        for length in range(1, len(waiting.caller) + 1):
            self._served.pop(waiting.caller[:length], None)
            self._served[waiting.caller[:length]] = turn
        while len(self._served) > KNOWN_CALLERS:
            self._served.popitem(last=False)

    def _free(self, kind: Kind, bytes: int, since: float) -> None:
        self._running[kind] -= 1
        self._bytes -= min(bytes, self._limits.heavy_bytes)
        self._seconds[kind] += _WEIGHT * (self._clock() - since - self._seconds[kind])
        self._next()

    def _next(self) -> None:
        """Admit whom there is room for."""
        while (chosen := self._first_that_fits()) is not None:
            self._waiting.remove(chosen)
            self._admit(chosen)
            chosen.admitted.set_result(None)

    def _first_that_fits(self) -> _Waiting | None:
        """In the order of turns. What waits for memory is not overtaken by what needs some, too: large things would wait for ever."""
        memory_is_awaited = False
        open_kinds = {kind for kind, number in self._numbers.items() if self._running[kind] < number}
        candidates = [one for one in self._waiting if one.kind in open_kinds and not one.admitted.cancelled()]
        for one in sorted(candidates, key=self._turn):
            if not one.bytes or (not memory_is_awaited and self._has_room(one)):
                return one
            memory_is_awaited = True
        return None

    def _turn(self, waiting: _Waiting) -> tuple[int, ...]:
        prefixes = (waiting.caller[:length] for length in range(1, len(waiting.caller) + 1))
        return (*(self._served.get(prefix, 0) for prefix in prefixes), waiting.number)
