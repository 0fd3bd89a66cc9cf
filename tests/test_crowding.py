"""Who runs on the same cores is noticed, and cores are left to them."""

import sys
import threading
import time

import pytest
import torch

from drgs.crowding import LOOK_SECONDS, Crowding, scheduled_seconds
from drgs.warp_torch import thread_count
from drgs_server.render.thread import _spare_cores


class Schedule:
    """A thread that waits for a core for some share of the time."""

    def __init__(self) -> None:
        self.ran, self.waited = 3.0, 1.0

    def __call__(self) -> tuple[float, float]:
        return self.ran, self.waited

    def passes(self, seconds: float, share: float) -> None:
        self.ran += seconds * (1 - share)
        self.waited += seconds * share


def test_cores_are_crowded_while_they_are_waited_for_and_not_behind_it() -> None:
    schedule, told = Schedule(), list[bool]()
    crowding = Crowding(told.append, schedule)
    crowding.look()
    for share, expected in (
        (0.0, []),
        (0.15, []),
        (0.4, [True]),
        (0.15, [True]),
        (0.3, [True]),
        (0.02, [True, False]),
        (0.0, [True, False]),
    ):
        schedule.passes(1.1 * LOOK_SECONDS, share)
        crowding.look()
        assert told == expected, share
    assert not crowding.crowded


def test_what_was_before_the_first_look_and_moments_decide_nothing() -> None:
    schedule, told = Schedule(), list[bool]()
    schedule.passes(10.0, 0.9)
    crowding = Crowding(told.append, schedule)
    crowding.look()
    for _ in range(3):
        schedule.passes(0.3 * LOOK_SECONDS, 0.9)
        crowding.look()
    assert told == []
    schedule.passes(0.3 * LOOK_SECONDS, 0.9)
    crowding.look()
    assert told == [True]


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


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere the system does not say how long threads wait")
def test_the_system_tells_what_another_thread_ran() -> None:
    thread, before = threading.get_native_id(), scheduled_seconds()[0]
    told = []
    asking = threading.Thread(target=lambda: told.append(scheduled_seconds(thread)))
    asking.start()
    asking.join()
    assert before <= told[0][0] <= scheduled_seconds()[0]


def test_rendering_leaves_half_of_the_cores_while_they_are_crowded() -> None:
    counted = []

    def work() -> None:
        for crowded in (False, True, False):
            _spare_cores(crowded)
            counted.append((thread_count(), torch.get_num_threads()))

    thread = threading.Thread(target=work)  # what it sets is its own
    thread.start()
    thread.join()
    cores, threads = thread_count(), torch.get_num_threads()
    half = max(1, cores // 2)
    assert counted == [(cores, threads), (half, min(half, threads)), (cores, threads)]
