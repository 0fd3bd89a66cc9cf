"""Whether others want the cores that a thread runs on: then work that is spread over all of them waits for its last part again and again, and fewer
threads get more done. Beside a build on two cores one thread makes as many moving pictures as two, in two thirds of the processor time.

Linux says how long a thread waited for a core; elsewhere nobody is ever in the way.
"""

import os
from collections.abc import Callable

OTHERS_COME, OTHERS_GO = 0.2, 0.1
"""Share of the time in which the thread could have run that it waited for a core: from the first on cores are crowded, until it is below the second."""
LOOK_SECONDS = 0.25
"""Of such time between two looks."""


def scheduled_seconds() -> tuple[float, float]:
    """How long the calling thread ran, and waited for a core while it could have run; zeros where the system does not say."""
    try:
        with open("/proc/thread-self/schedstat") as told:
            ran, waited, _ = told.read().split()
    except (OSError, ValueError):
        return 0.0, 0.0
    return int(ran) / 1e9, int(waited) / 1e9


class Crowding:
    """Final. Of the thread that looks."""

    def __init__(self, use_threads: Callable[[int | None], None], scheduled: Callable[[], tuple[float, float]] = scheduled_seconds) -> None:
        """
        Args:
            use_threads: limits the threads that the calling one spreads its work over; None: no limit.
        """
        self._use_threads, self._scheduled = use_threads, scheduled
        self._before: tuple[float, float] | None = None
        self.crowded = False

    def look(self) -> None:
        """Take half of the cores where others want them too, and all again when they are gone."""
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
            self._use_threads(max(1, (os.cpu_count() or 1) // 2) if crowded else None)
