"""Idle threads of a build while others want the cores."""

import json
import os
import subprocess
import sys
import threading
import time

import pytest

from drgs import brief_waits
from drgs.brief_waits import IdleTeam, brief_waits_where_crowded
from drgs.openmp import ASLEEP, SPINS

CODE = """
import json, time
import torch
from drgs.brief_waits import IdleTeam

def burnt():
    before = time.process_time()
    for _ in range(40):
        torch.ones(1 << 17).mul_(2.0)
        time.sleep(0.01)
    return time.process_time() - before

team = IdleTeam()
burnt()
alone = burnt()
team.hold()
with_team = burnt()
team.release()
print(json.dumps([alone, with_team, burnt()]))
"""
CHOICES = ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT", "OMP_NUM_THREADS")


@pytest.mark.skipif(sys.platform != "linux", reason="torch's packages for other systems bring other threads")
@pytest.mark.skipif(
    len(os.sched_getaffinity(0)) < 2 if sys.platform == "linux" else False, reason="on one core two threads are too many already"
)
def test_with_an_idle_team_threads_that_wait_burn_little() -> None:
    environment = {name: value for name, value in os.environ.items() if name not in CHOICES}
    done = subprocess.run([sys.executable, "-c", CODE], capture_output=True, text=True, env=environment, check=True)
    alone, with_team, behind = json.loads(done.stdout)
    assert with_team < 0.6 * min(alone, behind), (alone, with_team, behind)


class Waits:
    """Of the thread that computes: it waits for a core all the time, or never."""

    def __init__(self) -> None:
        self.crowded, self._told = False, (0.0, 0.0)

    def __call__(self, thread: int) -> tuple[float, float]:
        assert thread == threading.main_thread().native_id
        ran, waited = self._told
        self._told = (ran, waited + 1) if self.crowded else (ran + 1, waited)
        return self._told


@pytest.fixture
def waits(monkeypatch: pytest.MonkeyPatch) -> Waits:
    told = Waits()
    monkeypatch.setattr(brief_waits, "scheduled_seconds", told)
    monkeypatch.setattr(brief_waits, "LOOK_SECONDS", 0.01)
    for name in ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT"):
        monkeypatch.delenv(name, raising=False)
    return told


def teams() -> int:
    return sum(thread.name == "idle team" for thread in threading.enumerate())


def wait_for(count: int) -> None:
    until = time.monotonic() + 20
    while teams() != count and time.monotonic() < until:
        time.sleep(0.01)
    assert teams() == count


def test_a_team_is_kept_while_others_want_the_cores(waits: Waits) -> None:
    with brief_waits_where_crowded():
        waits.crowded = True
        wait_for(1)
        waits.crowded = False
        wait_for(0)
        waits.crowded = True
        wait_for(1)
    assert teams() == 0


def test_a_team_does_not_outlast_work_that_fails(waits: Waits) -> None:
    with pytest.raises(RuntimeError, match="no"), brief_waits_where_crowded():
        waits.crowded = True
        wait_for(1)
        raise RuntimeError("no")
    assert teams() == 0


@pytest.mark.parametrize("told", [("OMP_WAIT_POLICY", "passive"), ("GOMP_SPINCOUNT", "9"), ("GOMP_SPINCOUNT", ASLEEP)])
def test_where_threads_sleep_or_wait_as_the_user_says_nothing_is_done(
    waits: Waits, monkeypatch: pytest.MonkeyPatch, told: tuple[str, str]
) -> None:
    monkeypatch.setenv(*told)
    monkeypatch.setattr(brief_waits, "Crowding", None)  # would fail
    with brief_waits_where_crowded():
        pass


@pytest.mark.parametrize("program", ["a build", "torch first"])
def test_builds_that_spin_are_watched(waits: Waits, monkeypatch: pytest.MonkeyPatch, program: str) -> None:
    if program == "a build":
        monkeypatch.setenv("GOMP_SPINCOUNT", SPINS)
    with brief_waits_where_crowded():
        waits.crowded = True
        wait_for(1)
    assert teams() == 0


def test_a_team_that_was_never_held_is_released_at_once() -> None:
    IdleTeam().release()
    assert teams() == 0
