"""Where others want the cores, half of them are left to these."""

import os
import sys
import threading
import time

import pytest

from drgs_server.render.crowding import LOOK_SECONDS, Crowding, scheduled_seconds

HALF = max(1, (os.cpu_count() or 1) // 2)


class Schedule:
    """A thread that waits for a core for some share of the time."""

    def __init__(self) -> None:
        self.ran, self.waited = 3.0, 1.0

    def __call__(self) -> tuple[float, float]:
        return self.ran, self.waited

    def passes(self, seconds: float, share: float) -> None:
        self.ran += seconds * (1 - share)
        self.waited += seconds * share


def test_threads_are_fewer_while_a_core_is_waited_for_and_all_again_behind_it() -> None:
    schedule, told = Schedule(), list[int | None]()
    crowding = Crowding(told.append, schedule)
    crowding.look()
    for share, expected in ((0.0, []), (0.15, []), (0.4, [HALF]), (0.15, [HALF]), (0.3, [HALF]), (0.02, [HALF, None]), (0.0, [HALF, None])):
        schedule.passes(1.1 * LOOK_SECONDS, share)
        crowding.look()
        assert told == expected, share
    assert not crowding.crowded


def test_what_was_before_the_first_look_and_moments_decide_nothing() -> None:
    schedule, told = Schedule(), list[int | None]()
    schedule.passes(10.0, 0.9)
    crowding = Crowding(told.append, schedule)
    crowding.look()
    for _ in range(3):
        schedule.passes(0.3 * LOOK_SECONDS, 0.9)
        crowding.look()
    assert told == []
    schedule.passes(0.3 * LOOK_SECONDS, 0.9)
    crowding.look()
    assert told == [HALF]


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere the system does not say how long threads wait")
def test_the_system_tells_what_the_calling_thread_ran() -> None:
    told = []

    def work() -> None:
        before, until = scheduled_seconds(), time.thread_time() + 0.05
        while time.thread_time() < until:
            pass
        told.append((scheduled_seconds()[0] - before[0], scheduled_seconds()[1] - before[1]))

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    ((ran, waited),) = told
    assert 0.04 < ran < 0.5 and waited >= 0
