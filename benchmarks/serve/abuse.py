"""Try from outside to break a server: what it must refuse, bear and outlive, in some hundreds of trials.

    python -m benchmarks abuse [--json] [--quick] [--only GROUP ...] [--asset FILE]

Starts `drgs serve` on a new data folder and asks it as anybody could, over HTTP and WebSockets; nothing of the server is imported. Trials
stand in tables in benchmarks/serve/trials/, a file for each way in. --quick leaves out those that take long (load, kills, most files). Prints
`held` and `failed` in all and by group, each failure with a sentence, the peak of memory of the server and its children, and how long
/healthz took meanwhile. Exit code 1 where a trial failed.
"""

import argparse
import json
import os
import signal
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from benchmarks.serve.trials import access, captures, changes, connections, disk, faults, load, streams, uploads, weights
from benchmarks.serve.trials.load import MOST_BYTES
from benchmarks.serve.trials.shapes import ball, obj
from benchmarks.serve.trials.site import Site, Trial
from benchmarks.serve.trials.watch import PROBE_SECONDS, UNJUDGED_PROBE_SECONDS, HealthWatch, MemoryWatch, percentile_ms

SOURCES = (changes, weights, streams, uploads, captures, connections, access, load, faults, disk)
MOST_HEALTH_MS = 100.0
"""Of /healthz, p99 over everything. The short form, which shares its machine with tests, does not judge it."""

LONG_SECONDS = 20.0
"""A trial that takes longer is told on stderr."""


def main(arguments: list[str]) -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks abuse", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--quick", action="store_true", help="the short form")
    parser.add_argument("--only", nargs="+", metavar="GROUP", help="trials of these groups")
    parser.add_argument("--asset", type=Path, help="zipped asset or mesh that trials look at; without it a small ball")
    given = parser.parse_args(arguments)
    chosen = [trial for trial in all_trials() if (trial.quick or not given.quick) and (not given.only or trial.group in given.only)]
    if not chosen:
        raise ValueError(f"there are no such trials; the groups are {', '.join(sorted({trial.group for trial in all_trials()}))}")
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that the server is ended, too
    with tempfile.TemporaryDirectory() as folder:
        probe_seconds = UNJUDGED_PROBE_SECONDS if given.quick else PROBE_SECONDS
        found = measure(chosen, Path(folder), given.asset, judge_health=not given.quick and not given.only, probe_seconds=probe_seconds)
    print(json.dumps(found, indent=None if given.json else 1))
    if found["failed"]:
        raise SystemExit(1)


def all_trials() -> Iterator[Trial]:
    """In the order in which they run."""
    for source in SOURCES:
        yield from source.trials()


def measure(
    trials: list[Trial], folder: Path, asset: Path | None = None, judge_health: bool = False, probe_seconds: float = PROBE_SECONDS
) -> dict:
    """Run them one by one on one server.

    Args:
        asset: what most of them look at; a small ball where None.
        probe_seconds: between two calls of /healthz.
    """
    site = Site(folder)
    started = time.monotonic()
    site.start()
    assert site.process is not None
    memory, health = MemoryWatch(site.process.pid), HealthWatch(site.port, probe_seconds)
    failures: list[dict[str, str]] = []
    groups: dict[str, dict[str, int]] = {}
    peaks: dict[str, int] = {}
    slowest: tuple[float, str] = (0.0, "")

    def count(group: str, name: str, complaint: str | None) -> None:
        groups.setdefault(group, {"held": 0, "failed": 0})["held" if complaint is None else "failed"] += 1
        if complaint is not None:
            failures.append({"group": group, "trial": name, "sentence": complaint})
            print(f"{group}: {name}: {complaint}", file=sys.stderr, flush=True)

    try:
        site.mesh = obj(*ball())
        sent = site.upload("/api/assets", asset.name if asset else "ball.obj", asset.read_bytes() if asset else site.mesh)
        if sent.status != 201:
            raise OSError(f"the object was not taken: {sent.status} {sent.sentence}")
        site.asset = sent.document["id"]
        for trial in trials:
            begun = time.monotonic()
            count(trial.group, trial.name, _run(trial, site))
            peaks[trial.group] = max(peaks.get(trial.group, 0), memory.since_last() >> 20)
            if time.monotonic() - begun > LONG_SECONDS:
                print(f"{trial.group}: {trial.name}: took {time.monotonic() - begun:.0f} s", file=sys.stderr, flush=True)
            slowest = max(slowest, (time.monotonic() - begun, f"{trial.group}: {trial.name}"))
        memory.stop()
        answers = health.stop()
        p99 = percentile_ms(answers, 0.99)
        count(
            "memory",
            f"at most {MOST_BYTES >> 30} GiB",
            None if memory.peak_bytes <= MOST_BYTES else f"{memory.peak_bytes / 2**30:.2f} GiB at the peak",
        )
        if judge_health:
            held = p99 is not None and p99 <= MOST_HEALTH_MS
            count("health", f"p99 of /healthz at most {MOST_HEALTH_MS:.0f} ms", None if held else f"p99 is {p99} ms")
        log = site.log.read_text(errors="replace")
        stacks = log.count("Traceback (most recent call last)")
        count("log", "no stack in the server's log", f"{stacks}, the last one ends: {_last_stack(log)}" if stacks else None)
    finally:
        site.stop()
    return {
        "held": sum(group["held"] for group in groups.values()),
        "failed": len(failures),
        "groups": groups,
        "failures": failures,
        "peak_memory_mib": memory.peak_bytes >> 20,
        "peak_memory_mib_by_group": peaks,
        "healthz_p50_ms": percentile_ms(answers, 0.5),
        "healthz_p99_ms": p99,
        "healthz_calls": len(answers),
        "slowest_trial": slowest[1],
        "slowest_seconds": round(slowest[0], 1),
        "seconds": round(time.monotonic() - started, 1),
        "cores": os.cpu_count(),
    }


def _run(trial: Trial, site: Site) -> str | None:
    """What did not hold; a trial that raises counts as one that did not."""
    try:
        complaint = trial.run(site)
    except Exception as error:  # whatever a trial meets is what is counted here
        complaint = f"{type(error).__name__}: {error}"[:300]
    return complaint if complaint is None or site.is_well() is None else f"{complaint}; and {site.is_well()}"


def _last_stack(log: str) -> str:
    lines = log[log.rindex("Traceback (most recent call last)") :].splitlines()[1:]
    return next((line for line in lines if line and not line.startswith(" ")), "")[:200]
