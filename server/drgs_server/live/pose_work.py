"""A pose under way: its thread asks between two steps whether to go on, and gives its place to others where it turns out to be long."""

import asyncio
import threading
import time
from concurrent.futures import CancelledError, Future

from drgs_server.live.admission import Place

QUICK_SECONDS = 0.5
"""A pose that takes longer is a simulation, however it came to be: it waits for a place among those, and other sessions' edits pass it."""


class PoseCancelled(Exception):
    """Somebody asked for the work to be given up."""


class PoseWork:
    """Final. `go_on` is called on the posing thread, `cancel` on the event loop."""

    def __init__(self, place: Place) -> None:
        """
        Args:
            place: held among the poses.
        """
        self._place = place
        self._loop = asyncio.get_running_loop()
        self._lock = threading.Lock()
        self._began = time.monotonic()
        self._is_long = False
        self._cancelled = False
        self._turn: Future[None] | None = None

    def cancel(self) -> None:
        """Let the work end at its next step."""
        with self._lock:
            self._cancelled = True
            if self._turn is not None:
                self._turn.cancel()

    def go_on(self) -> None:
        """Called between two steps.

        Raises:
            PoseCancelled: the work is no longer wanted.
            ProblemError: it is a long one, and too many of those wait already.
        """
        with self._lock:
            if self._cancelled:
                raise PoseCancelled
            if self._is_long or time.monotonic() - self._began < QUICK_SECONDS:
                return
            self._is_long = True
            self._turn = asyncio.run_coroutine_threadsafe(self._place.become("simulation"), self._loop)
        try:
            self._turn.result()
        except CancelledError:
            raise PoseCancelled from None
