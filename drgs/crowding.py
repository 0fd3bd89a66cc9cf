"""Whether others want the cores that a thread runs on: then work that is spread over all of them waits for its last part again and again.

Linux says how long a thread waited for a core; elsewhere nobody is ever in the way.
"""

from collections.abc import Callable

OTHERS_COME, OTHERS_GO = 0.2, 0.1
"""Share of the time in which the thread could have run that it waited for a core: from the first on cores are crowded, until it is below the second."""
LOOK_SECONDS = 0.25
"""Of such time between two looks."""


def scheduled_seconds(thread: int | None = None) -> tuple[float, float]:
    """How long a thread of this process ran, and waited for a core while it could have run; zeros where the system does not say.

    Args:
        thread: its native id; None: the calling one.
    """
    try:
        with open("/proc/thread-self/schedstat" if thread is None else f"/proc/self/task/{thread}/schedstat") as told:
            ran, waited, _ = told.read().split()
    except (OSError, ValueError):
        return 0.0, 0.0
    return int(ran) / 1e9, int(waited) / 1e9


class Crowding:
    """Final. Of one thread, which `scheduled` speaks of."""

    def __init__(self, changed: Callable[[bool], None], scheduled: Callable[[], tuple[float, float]] = scheduled_seconds) -> None:
        """
        Args:
            changed: called by look() where others have come, with True, or gone.
        """
        self._changed, self._scheduled = changed, scheduled
        self._before: tuple[float, float] | None = None
        self.crowded = False

    def look(self) -> None:
        ran, waited = self._scheduled()
        if self._before is None:
            self._before = ran, waited
            return
        could, late = ran + waited - sum(self._before), waited - self._before[1]
        if could < LOOK_SECONDS:
            return
        self._before = ran, waited
        crowded = late > could * (OTHERS_GO if self.crowded else OTHERS_COME)
        if crowded != self.crowded:
            self.crowded = crowded
            self._changed(crowded)
