"""The one thread that renders. It serves quick calls first (pick, explain), then finished pictures and viewers in turn: a slice of the one, a slice of
the others, of which those that move come before those that refine.

torch, Warp and Embree let go of Python's lock while they compute, so the event loop answers meanwhile; and they already use every
core for one picture, so a second render thread would only make both slower.
"""

import logging
import os
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any, TypeVar

from drgs.crowding import Crowding
from drgs_server.live.viewer import Viewer
from drgs_server.render.settle_memory import settle_memory

T = TypeVar("T")

LONGEST_WAIT_SECONDS = 1.0
PAUSE_AFTER_ERROR_SECONDS = 2.0
SETTLE_AFTER_SLICES = (1, 30)
"""The first pictures load kernels and all that they need."""


MODESTY = 7
"""Nice value of threads that compute for long."""


def give_way() -> None:
    """Let the calling thread, and those it starts, wait where the cores are busy: rendering takes all it gets, and the event loop, which answers
    within milliseconds, and a browser on the same machine, which draws sixty pictures a second, need little. Linux only, where a thread has
    a priority of its own."""
    if sys.platform != "linux":
        return
    try:
        thread = threading.get_native_id()
        os.setpriority(os.PRIO_PROCESS, thread, os.getpriority(os.PRIO_PROCESS, thread) + MODESTY)  # the system stops at 19
    except OSError as error:  # a sandbox may forbid it; pictures are made all the same
        logging.getLogger(__name__).warning("rendering keeps the priority of the server: %s", error)


class RenderThread:
    """Final. Start it once, add and remove viewers, call functions on it."""

    def __init__(self) -> None:
        self._crowding = Crowding(_spare_cores)
        self._wake = threading.Condition()
        self._calls: deque[tuple[Future, Callable[[], Any]]] = deque()
        self._calls_in_turn: deque[tuple[Future, Callable[[], Any]]] = deque()
        self._viewer_is_next = True
        """Where a viewer and a call in turn are both due."""
        self._viewers: list[Viewer] = []
        self._failed_until: dict[Viewer, float] = {}
        self._stopping = False
        self._slices = 0
        self._thread = threading.Thread(target=self._run, name="render", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        """Finish the present slice; calls that wait are cancelled."""
        with self._wake:
            self._stopping = True
            self._wake.notify()
        self._thread.join(timeout=10)

    def call(self, function: Callable[[], T]) -> "Future[T]":
        """Run it on the render thread, in order, before the next slice."""
        return self._enqueue(self._calls, function)

    def call_in_turn(self, function: Callable[[], T]) -> "Future[T]":
        """The same for a slice of long work, which takes turns with viewers: however much of it there is, their pictures go on."""
        return self._enqueue(self._calls_in_turn, function)

    def _enqueue(self, calls: deque[tuple[Future, Callable[[], Any]]], function: Callable[[], T]) -> "Future[T]":
        future: Future[T] = Future()
        with self._wake:
            if self._stopping:
                future.cancel()
                return future
            calls.append((future, function))
            self._wake.notify()
        return future

    def add(self, viewer: Viewer) -> None:
        with self._wake:
            self._viewers.append(viewer)
            self._wake.notify()

    def remove(self, viewer: Viewer) -> None:
        with self._wake:
            if viewer in self._viewers:
                self._viewers.remove(viewer)
            self._failed_until.pop(viewer, None)

    def wake(self) -> None:
        """Something came in that may have made a viewer due."""
        with self._wake:
            self._wake.notify()

    def _run(self) -> None:
        give_way()
        while True:
            viewer = None
            with self._wake:
                if self._stopping:
                    for future, _ in (*self._calls, *self._calls_in_turn):
                        future.cancel()
                    return
                call = self._calls.popleft() if self._calls else None
                if call is None and self._calls_in_turn and not self._viewer_is_next:
                    call, self._viewer_is_next = self._calls_in_turn.popleft(), True
                if call is None:
                    viewer, due_at = self._next_viewer()
                    self._viewer_is_next = False
                    if viewer is None and self._calls_in_turn:
                        call, self._viewer_is_next = self._calls_in_turn.popleft(), True
                    elif viewer is None:
                        self._wake.wait(min(max(due_at - time.monotonic(), 0.001), LONGEST_WAIT_SECONDS))
                        continue
            if call is not None:
                _answer(*call)
            elif viewer is not None:
                self._serve(viewer)

    def _next_viewer(self) -> tuple[Viewer | None, float]:
        """A viewer that is due, or None and when the next one is."""
        now = time.monotonic()
        soonest = now + LONGEST_WAIT_SECONDS
        due = []
        for viewer in self._viewers:
            at = viewer.due_at(self._crowding.crowded)
            if at is None:
                continue
            at = max(at, self._failed_until.get(viewer, 0.0))
            if at <= now:
                due.append(viewer)
            else:
                soonest = min(soonest, at)
        if not due:
            return None, soonest
        chosen = next((viewer for viewer in due if viewer.moving), due[0])
        # Whoever was served goes to the end of the line.
        self._viewers.remove(chosen)
        self._viewers.append(chosen)
        return chosen, now

    def _serve(self, viewer: Viewer) -> None:
        try:
            self._crowding.look()
            viewer.work()
            self._slices += 1
            if self._slices in SETTLE_AFTER_SLICES:
                settle_memory()
        except Exception as error:
            # One viewer's failure is told to it and must not end the others'.
            logging.getLogger(__name__).exception("rendering failed")
            with self._wake:
                self._failed_until[viewer] = time.monotonic() + PAUSE_AFTER_ERROR_SECONDS
            viewer.tell_error(f"This picture could not be rendered: {type(error).__name__}: {error}")


def _spare_cores(crowded: bool) -> None:
    """Leave half of the cores to others where these want them: beside a build on two cores one thread makes as many moving pictures as two, in two thirds
    of the processor time."""
    from drgs.warp_torch import thread_count, use_threads  # no picture was made before it was loaded

    use_threads(None)
    if crowded:
        use_threads(max(1, thread_count() // 2))


def _answer(future: Future, function: Callable[[], Any]) -> None:
    if not future.set_running_or_notify_cancel():
        return
    try:
        future.set_result(function())
    except BaseException as error:
        future.set_exception(error)
