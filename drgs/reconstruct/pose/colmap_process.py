"""Start run_colmap.py in a process of its own, pass on how far it is, and end it when told to.

It is stopped by ending the process: its database survives that, and what it had finished stays.
"""

import json
import os
import queue
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterable
from pathlib import Path

from drgs.reconstruct.progress import BuildStopped

POLL_SECONDS = 0.5
PATIENCE_SECONDS = 5.0
"""Between asking the process to end and ending it."""
LOG_TAIL = 300
"""Characters of the log in a sentence."""
CRASHES = {getattr(signal, name) for name in ("SIGSEGV", "SIGBUS", "SIGABRT", "SIGFPE") if hasattr(signal, name)}
"""By which a library ends for reasons of its own. Seen once: a SIGBUS while it looked for features, with memory and disk free."""
ALONE = {"OMP_NUM_THREADS": "1"}
"""Pictures and pairs are shared among threads of COLMAP's own. Its index of a picture's features asks for OpenMP's besides, and came out otherwise now and then on
a busy machine (once in twenty tries): fewer matches, and other poses for the same seed."""
PROGRAM = Path(__file__).with_name("run_colmap.py")


def colmap_process(job: Path, told: Callable[[str, int, int], None], should_stop: Callable[[], bool]) -> None:
    """Run the steps of a job file that are not done yet; where the library crashes, once more.

    Args:
        told: called with step, done, total.

    Raises:
        BuildStopped: as asked; the process has ended.
        ValueError: it ended by itself before its work was done.
    """
    log = job.parent / "colmap.log"
    log.write_text("")
    code = _ended(job, log, told, should_stop)
    if -code in CRASHES:
        code = _ended(job, log, told, should_stop)
    if code != 0:
        said = " ".join(log.read_text(errors="replace").split())[-LOG_TAIL:]
        how = f"was ended by signal {-code} (too little memory, or a full disk?)" if code < 0 else "failed"
        raise ValueError(
            f"{log}: pycolmap {how} before the poses were found; go on with --resume, or read the file: {said or 'it is empty'}"
        )


def _ended(job: Path, log: Path, told: Callable[[str, int, int], None], should_stop: Callable[[], bool]) -> int:
    """Exit code of a process that went as far as it came; what it says beside its reports is added to `log`."""
    with log.open("a") as output:
        process = subprocess.Popen(
            [sys.executable, "-P", str(PROGRAM), str(job)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=output,
            text=True,
            env=os.environ | ALONE,
            start_new_session=True,  # Ctrl-C is for us, who end it in order
        )
    assert process.stdout is not None
    lines: queue.Queue[str | None] = queue.Queue()
    reader = threading.Thread(target=_read_lines, args=(process.stdout, lines), daemon=True)
    reader.start()
    try:
        _follow(lines, told, should_stop)
        process.wait()
    finally:
        _end(process)
        reader.join()
        process.stdout.close()
    return process.returncode


def _follow(lines: "queue.Queue[str | None]", told: Callable[[str, int, int], None], should_stop: Callable[[], bool]) -> None:
    """Until the process closes its output."""
    while True:
        if should_stop():
            raise BuildStopped
        try:
            line = lines.get(timeout=POLL_SECONDS)
        except queue.Empty:
            continue
        if line is None:
            return
        if line.startswith('{"step"'):  # libraries print, too
            report = json.loads(line)
            told(report["step"], report["done"], report["total"])


def _read_lines(output: Iterable[str], lines: "queue.Queue[str | None]") -> None:
    """Into the queue; None at the end."""
    try:
        for line in output:
            lines.put(line)
    finally:
        lines.put(None)


def _end(process: subprocess.Popen[str]) -> None:
    if process.stdin is not None:
        process.stdin.close()
    if process.poll() is None:
        process.terminate()
        try:
            process.wait(PATIENCE_SECONDS)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
