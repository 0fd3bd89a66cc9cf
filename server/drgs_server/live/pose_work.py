"""A pose under way: its thread asks between two steps whether to go on, and gives its place to others where it turns out to be long; and
the threads of such work."""

import asyncio
import logging
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import TypeVar

from drgs.scene.edits import Edit
from drgs_server.api.problems import ProblemError
from drgs_server.live.admission import WAITING_SIMULATIONS, Admission, Caller, Place
from drgs_server.render.interface import AbstractLoadedAsset
from drgs_server.render.thread import give_way
from drgs_server.settings import Limits

Result = TypeVar("Result")

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


class PoseThreads:
    """Final. All methods are called on the event loop.

    Loading and posing may take long (a simulation up to a late moment); the render thread goes on with other sessions meanwhile.
    """

    def __init__(self, limits: Limits, admission: Admission) -> None:
        self._admission = admission
        threads = limits.poses_at_once + limits.simulations_at_once + WAITING_SIMULATIONS
        self._posing = ThreadPoolExecutor(threads, thread_name_prefix="pose", initializer=give_way)
        self._keeping = ThreadPoolExecutor(1, thread_name_prefix="keep", initializer=give_way)

    def close(self) -> None:
        """Poses under way are finished, those that wait are not begun."""
        self._posing.shutdown(wait=False, cancel_futures=True)
        self._keeping.shutdown(wait=True, cancel_futures=True)

    async def call(
        self, function: Callable[[PoseWork], Result], caller: Caller, begun: Callable[[PoseWork], None] = lambda work: None
    ) -> Result:
        """What the function returns, on a thread of its own once it is its turn. Cancelled, it ends at its next step.

        Args:
            begun: is given the work when it is its turn.

        Raises:
            ProblemError: too much waits already, the work was cancelled, or its edits do not fit.
        """
        place, loop = Place(self._admission, "pose", caller, 0), asyncio.get_running_loop()
        await place.enter()
        work = PoseWork(place)
        begun(work)

        def leave(_: object) -> None:
            with suppress(RuntimeError):  # the loop has ended, and with it all waiting
                loop.call_soon_threadsafe(place.leave)

        future = self._posing.submit(function, work)
        # The place is free when the thread is, which may be later than nobody wants its result any more.
        future.add_done_callback(leave)
        try:
            return await asyncio.wrap_future(future)
        except asyncio.CancelledError:
            work.cancel()
            raise
        except PoseCancelled as error:
            raise ProblemError(409, "This change was cancelled while it was computed; everything is as before.") from error
        except ValueError as error:
            raise ProblemError(422, str(error)) from error
        except ArithmeticError as error:
            raise ProblemError(422, f"The edits hold numbers that cannot be computed with ({error}).") from error

    def keep(self, loaded: AbstractLoadedAsset, edits: Sequence[Edit], path: Path) -> None:
        """Write what edits have made of an asset; nobody waits for it, and where it fails, opening their session takes longer."""

        def write() -> None:
            try:
                loaded.keep(edits, path)
            except (OSError, ValueError) as error:
                logging.getLogger(__name__).warning("a pose could not be kept: %s", error)

        self._keeping.submit(write)
