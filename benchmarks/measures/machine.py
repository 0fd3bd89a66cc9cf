"""On what something was measured."""

import os
import platform
from pathlib import Path


def machine() -> str:
    """Processor, cores that this process may use, and how busy the machine is."""
    model = platform.processor() or platform.machine()
    facts = Path("/proc/cpuinfo")
    if facts.is_file():
        named = [line.partition(":")[2].strip() for line in facts.read_text().splitlines() if line.startswith("model name")]
        model = named[0] if named else model
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return f"{model}, {cores} of {os.cpu_count()} cores, load {os.getloadavg()[0]:.0f}"
