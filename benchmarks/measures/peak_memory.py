"""Seconds and peak memory of one step within a process, where Linux lets a process forget its earlier peak."""

import re
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

Result = TypeVar("Result")


@dataclass(frozen=True)
class StepCost:
    """What a step took."""

    seconds: float
    peak_memory_mib: int | None
    """Of the whole process while the step ran, libraries and inputs included; None where the system does not tell."""


def measured(step: Callable[[], Result]) -> tuple[Result, StepCost]:
    """Run a step and say what it took."""
    forgotten = _forget_peak()
    started = time.perf_counter()
    result = step()
    return result, StepCost(round(time.perf_counter() - started, 2), _peak_mib() if forgotten else None)


def _forget_peak() -> bool:
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        return False
    return True


def _peak_mib() -> int | None:
    found = re.search(r"VmHWM:\s+(\d+) kB", Path("/proc/self/status").read_text())
    return None if found is None else round(int(found[1]) / 1024)
