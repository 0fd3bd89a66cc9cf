"""Start run_colmap.py in a process of its own, pass on how far it is, and end it when told to.

It is stopped by ending the process: its database survives that, and what it had finished stays.
"""

import json
import queue
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
PROGRAM = Path(__file__).with_name("run_colmap.py")


def colmap_process(job: Path, told: Callable[[str, int, int], None], should_stop: Callable[[], bool]) -> None:
    """Run the steps of a job file that are not done yet.

    Args:
        told: called with step, done, total.

    Raises:
        BuildStopped: as asked; the process has ended.
        ValueError: it ended by itself before its work was done.
    """
    log = job.parent / "colmap.log"
    with log.open("w") as output:
        process = subprocess.Popen(
            [sys.executable, "-P", str(PROGRAM), str(job)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=output,
            text=True,
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
    if process.returncode != 0:
        said = " ".join(log.read_text(errors="replace").split())[-LOG_TAIL:]
        how = f"was ended by signal {-process.returncode} (too little memory?)" if process.returncode < 0 else "failed"
        raise ValueError(
            f"{log}: pycolmap {how} before the poses were found; go on with --resume, or read the file: {said or 'it is empty'}"
        )


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
