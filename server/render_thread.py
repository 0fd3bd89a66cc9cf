"""The one thread that renders. It serves calls first (load, pose, pick), then viewers in turn, those that move before those that refine.

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

from server.settle_memory import settle_memory
from server.viewer import Viewer

T = TypeVar("T")

LONGEST_WAIT_SECONDS = 1.0
PAUSE_AFTER_ERROR_SECONDS = 2.0
SETTLE_AFTER_SLICES = (1, 30)
"""The first pictures load kernels and all that they need."""


MODESTY = 5
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

    def __init__(self, on_error: Callable[[Viewer, str], None] = lambda viewer, sentence: None) -> None:
        self._wake = threading.Condition()
        self._calls: deque[tuple[Future, Callable[[], Any]]] = deque()
        self._viewers: list[Viewer] = []
        self._failed_until: dict[Viewer, float] = {}
        self._stopping = False
        self._slices = 0
        self._on_error = on_error
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
        future: Future[T] = Future()
        with self._wake:
            if self._stopping:
                future.cancel()
                return future
            self._calls.append((future, function))
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
                    while self._calls:
                        self._calls.popleft()[0].cancel()
                    return
                call = self._calls.popleft() if self._calls else None
                if call is None:
                    viewer, due_at = self._next_viewer()
                    if viewer is None:
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
            at = viewer.due_at()
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
            viewer.work()
            self._slices += 1
            if self._slices in SETTLE_AFTER_SLICES:
                settle_memory()
        except Exception as error:
            # One viewer's failure is told to it and must not end the others'.
            logging.getLogger(__name__).exception("rendering failed")
            with self._wake:
                self._failed_until[viewer] = time.monotonic() + PAUSE_AFTER_ERROR_SECONDS
            self._on_error(viewer, f"This picture could not be rendered: {type(error).__name__}: {error}")


def _answer(future: Future, function: Callable[[], Any]) -> None:
    if not future.set_running_or_notify_cancel():
        return
    try:
        future.set_result(function())
    except BaseException as error:
        future.set_exception(error)
