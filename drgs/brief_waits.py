"""How long builds let idle threads wait where others want the cores. GNU's OpenMP lets them look for work first (openmp.py): good for a build that is alone,
but two on one machine stop each other by it, most of all where torch was loaded before drgs could choose how long.

It asks how many threads it has before each wait, though, and where these are more than cores it looks a moment only (its "throttled" spin count,
libgomp/config/linux/wait.h). So where others want the cores one thread more is kept that has a team of its own, which does nothing. Bits stay
what they are. Always to have it costs a fit that is alone a quarter of its time; two drafts of a teapot at once take 114 s with it, 163 without.
"""

import threading
from collections.abc import Iterator
from contextlib import contextmanager

from drgs.crowding import LOOK_SECONDS, Crowding, scheduled_seconds
from drgs.openmp import spin_unless_told

ENOUGH_FOR_ALL_THREADS = 1 << 20
"""Elements of which torch gives each thread some."""


class IdleTeam:
    """Final. Threads of OpenMP's that do nothing, from hold() to release()."""

    def __init__(self) -> None:
        self._over: threading.Event | None = None
        self._thread: threading.Thread | None = None

    def hold(self) -> None:
        """Back when the team is there."""
        there, self._over = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=_be_a_team, args=(there, self._over), name="idle team", daemon=True)
        self._thread.start()
        there.wait()

    def release(self) -> None:
        if self._thread is not None and self._over is not None:
            self._over.set()
            self._thread.join()  # its team ends with it
            self._thread = None


def _be_a_team(there: threading.Event, over: threading.Event) -> None:
    import torch

    try:
        torch.ones(ENOUGH_FOR_ALL_THREADS).mul_(2.0)
    finally:
        there.set()
    over.wait()


@contextmanager
def brief_waits_where_crowded() -> Iterator[None]:
    """Around work of the calling thread that lasts: torch's idle threads wait briefly while others want the cores. Where they sleep at once, or wait as the user
    says, nothing."""
    if not spin_unless_told():
        yield
        return
    team, over, of_caller = IdleTeam(), threading.Event(), threading.get_native_id()
    crowding = Crowding(lambda crowded: team.hold() if crowded else team.release(), lambda: scheduled_seconds(of_caller))

    def watch() -> None:
        while not over.wait(LOOK_SECONDS):
            crowding.look()
        team.release()

    watcher = threading.Thread(target=watch, name="crowding", daemon=True)
    watcher.start()
    try:
        yield
    finally:
        over.set()
        watcher.join()
