"""A build in a process of its own, as a user starts it: seconds of each stage, peak memory, and what it told on the way."""

import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class BuildRun:
    """What a finished build took."""

    seconds: float
    cpu_seconds: float
    """Summed over threads; steadier than the clock where other work runs beside."""
    seconds_per_stage: dict[str, float]
    peak_memory_mib: int


def run_build(command: Sequence[str], log: Path | None = None) -> BuildRun:
    """Run a command of Python that prints progress as `drgs build --json-progress` does.

    Args:
        log: gets the progress reports as JSON lines, each with elapsed_seconds; those of a run that was killed before stay, and its seconds count.

    Raises:
        ValueError: the build failed; its own words are on stderr.
    """
    spent = elapsed_seconds(log)
    started = time.perf_counter()
    last: dict = {}
    process = subprocess.Popen([sys.executable, *command], stdout=subprocess.PIPE, text=True)

    def listen() -> None:
        nonlocal last
        assert process.stdout is not None
        for line in process.stdout:
            last = json.loads(line)
            if log is not None and last["stage"] != "done":
                event = last | {"elapsed_seconds": round(spent + time.perf_counter() - started, 2)}
                with log.open("a") as file:
                    file.write(json.dumps(event) + "\n")

    listener = threading.Thread(target=listen)
    listener.start()
    # wait4 knows this process's own peak; RUSAGE_CHILDREN knows the largest of all processes waited for so far.
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    listener.join()
    if process.returncode != 0 or "provenance" not in last:
        raise ValueError(f"the build ended with exit code {process.returncode}")
    # Linux counts in KiB, macOS in bytes.
    peak = usage.ru_maxrss * (1 if sys.platform == "darwin" else 1024)
    stages = {stage: round(seconds, 2) for stage, seconds in last["provenance"]["seconds"].items()}
    cpu_seconds = round(usage.ru_utime + usage.ru_stime, 2)
    return BuildRun(round(spent + time.perf_counter() - started, 2), cpu_seconds, stages, round(peak / 2**20))


def read_events(log: Path | None) -> list[dict]:
    """The reports of a log; a last line that a kill cut short is left out."""
    if log is None or not log.is_file():
        return []
    lines = log.read_text().split("\n")
    return [json.loads(line) for line in lines[:-1]]


def elapsed_seconds(log: Path | None) -> float:
    events = read_events(log)
    return float(events[-1]["elapsed_seconds"]) if events else 0.0


def built_asset(command: Sequence[str], work: Path, what: dict) -> dict:
    """Build work/asset, which the command writes, unless that was done; what it took, or had taken.

    Args:
        what: says which build it is, so that no other is taken for it.

    Returns:
        {"seconds", "cpu_seconds", "seconds_per_stage", "peak_memory_mib", "resumed"}. Of a build that was killed in between, seconds are those
        of all its runs, the processor's, the stages' and the memory those of the last one.

    Raises:
        ValueError: the folder holds another build, or this one failed.
    """
    work.mkdir(parents=True, exist_ok=True)
    identity, kept, log = work / "build_of.json", work / "build.json", work / "progress.jsonl"
    if identity.is_file() and json.loads(identity.read_text()) != what:
        raise ValueError(f"{work} holds a build of {identity.read_text()}; expected {json.dumps(what)}: choose another --out")
    identity.write_text(json.dumps(what))
    if not (kept.is_file() and (work / "asset" / "asset.json").is_file()):
        resumed = log.is_file()
        run = run_build(command, log)
        kept.write_text(json.dumps(vars(run) | {"resumed": resumed}))
    return json.loads(kept.read_text())


def cli_command(dataset: Path, asset: Path, preset: str, seed: int = 0, device: str = "auto", resume: bool = True) -> list[str]:
    """Of `drgs build`.

    Args:
        resume: go on from the checkpoints that a killed one left, where there are some.
    """
    resuming = ["--resume"] if resume and Path(f"{asset}.build").is_dir() else []
    options = ["--preset", preset, "--seed", str(seed), "--device", device, "--json-progress", *resuming]
    return ["-m", "drgs", "build", str(dataset), str(asset), *options]
