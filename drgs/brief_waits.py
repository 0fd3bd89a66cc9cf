"""What a program does that had loaded torch when drgs came to choose how its idle threads wait (openmp.py): GNU's OpenMP lets them look for work so long
that two such programs on one machine stop each other.

It asks how many threads it has before each wait, though, and where these are more than cores it looks a moment only (its "throttled" spin count,
libgomp/config/linux/wait.h). So where others want the cores one thread more is kept that has a team of its own, which does nothing. Bits stay
what they are. Always to have it costs a fit that is alone a quarter of its time.
"""

import threading
from collections.abc import Iterator
from contextlib import contextmanager

from drgs.crowding import LOOK_SECONDS, Crowding, scheduled_seconds
from drgs.openmp import CHOSEN_IN_TIME

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
    """Around work of the calling thread that lasts: torch's idle threads wait briefly while others want the cores. Where that was chosen in time, nothing."""
    if CHOSEN_IN_TIME:
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
