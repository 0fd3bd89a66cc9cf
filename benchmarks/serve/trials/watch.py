"""What is measured while trials run: memory of the server with all that it started, and how long /healthz takes."""

import http.client
import math
import multiprocessing
import threading
import time
from multiprocessing.queues import Queue
from multiprocessing.synchronize import Event

import psutil

MEMORY_SECONDS = 0.2
PROBE_SECONDS = 0.05
UNJUDGED_PROBE_SECONDS = 0.5
"""In the short form, which does not judge it: calls take the cores of what is tried."""
LONGEST_PROBE_SECONDS = 30.0


class MemoryWatch:
    """Final. Samples the resident memory of a process and all that it started in a thread, until it is stopped; what two of them share counts
    twice."""

    def __init__(self, pid: int) -> None:
        self._process = psutil.Process(pid)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self.peak_bytes = 0
        self.peak_processes = 0
        self._recent_bytes = 0
        self._thread.start()

    def since_last(self) -> int:
        """Most bytes since the last call of this."""
        found, self._recent_bytes = max(self._recent_bytes, self.now()), 0
        return found

    def now(self) -> int:
        """Bytes at this moment."""
        try:
            own, total = self._process.cmdline(), self._process.memory_info().rss
        except psutil.Error:
            return 0
        for process in self._all()[1:]:
            try:
                # What has just been forked is the server's own memory until it runs its program.
                total += 0 if process.cmdline() == own else process.memory_info().rss
            except psutil.Error:  # it ended meanwhile
                continue
        return total

    def _all(self) -> list[psutil.Process]:
        try:
            return [self._process, *self._process.children(recursive=True)]
        except psutil.Error:
            return []

    def _run(self) -> None:
        while not self._stop.wait(MEMORY_SECONDS):
            sample = self.now()
            self.peak_bytes, self._recent_bytes = max(self.peak_bytes, sample), max(self._recent_bytes, sample)
            self.peak_processes = max(self.peak_processes, len(self._all()))

    def stop(self) -> None:
        self._stop.set()
        self._thread.join()


class HealthWatch:
    """Final. Asks /healthz from a process of its own, whose answers no work of this one delays, with `pause_seconds` between two calls."""

    def __init__(self, port: int, pause_seconds: float = PROBE_SECONDS) -> None:
        context = multiprocessing.get_context("spawn")
        self._results: Queue = context.Queue()
        self._stop: Event = context.Event()
        self._process = context.Process(target=_probe, args=(port, pause_seconds, self._stop, self._results), daemon=True)
        self._process.start()

    def stop(self) -> list[float]:
        """Seconds of each answer; infinity for one that did not come."""
        self._stop.set()
        found = self._results.get(timeout=2 * LONGEST_PROBE_SECONDS)
        self._process.join()
        return found


def _probe(port: int, pause_seconds: float, stop: Event, results: Queue) -> None:
    seconds = []
    while not stop.wait(pause_seconds):
        start = time.perf_counter()
        connection = http.client.HTTPConnection("127.0.0.1", port, timeout=LONGEST_PROBE_SECONDS)
        try:
            connection.request("GET", "/healthz")
            well = connection.getresponse().status == 200
        except (OSError, http.client.HTTPException):
            well = False
        finally:
            connection.close()
        seconds.append(time.perf_counter() - start if well else math.inf)
    results.put(seconds)


def percentile_ms(seconds: list[float], share: float) -> float | None:
    """None where answers did not come, or none was asked for."""
    if not seconds:
        return None
    found = sorted(seconds)[max(0, math.ceil(share * len(seconds)) - 1)]
    return round(1e3 * found, 1) if math.isfinite(found) else None
