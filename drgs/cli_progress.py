"""How long work reports on a terminal or in a pipe: a bar on stderr, JSON lines on stdout, and a first Ctrl-C that asks politely."""

import json
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from threading import Event
from types import TracebackType
from typing import Any

from drgs.reconstruct.progress import Progress, plain_progress


class StopOnInterrupt:
    """Between enter and exit the first Ctrl-C sets a flag, so that the work can save itself; the second interrupts at once."""

    def __init__(self) -> None:
        self._asked = Event()

    def is_set(self) -> bool:
        return self._asked.is_set()

    def __enter__(self) -> "StopOnInterrupt":
        self._previous = signal.signal(signal.SIGINT, self._interrupt)
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        signal.signal(signal.SIGINT, self._previous)

    def _interrupt(self, number: int, frame: Any) -> None:
        if self._asked.is_set():
            raise KeyboardInterrupt
        self._asked.set()
        print("\ndrgs: stopping after saving a checkpoint; Ctrl-C again stops at once", file=sys.stderr)


@contextmanager
def build_progress(as_json_lines: bool) -> Iterator[Callable[[Progress], None]]:
    """Where a build's progress reports go: JSON lines on stdout (without the preview picture), or a bar on stderr."""
    if as_json_lines:

        def report_line(progress: Progress) -> None:
            print(json.dumps(plain_progress(progress)), flush=True)

        yield report_line
        return
    with _bar() as bar:
        task = bar.add_task("Starting", total=1.0, note="")

        def report_bar(progress: Progress) -> None:
            note = progress.message or ("" if progress.psnr is None else f"{progress.psnr:.2f} dB")
            bar.update(task, completed=progress.fraction, description=progress.stage, note=note)

        yield report_bar


@contextmanager
def frame_progress(title: str, total: int | None) -> Iterator[Callable[[str], None]]:
    """A bar on stderr that advances by one for each finished picture, named by the argument."""
    with _bar() as bar:
        task = bar.add_task(title, total=total, note="")
        yield lambda name: bar.update(task, advance=1, note=name)


def _bar() -> Any:
    """A bar that leaves nothing behind, and none at all where stderr is no terminal: there a failure is to be one sentence."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    note = TextColumn("{task.fields[note]}")
    columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeElapsedColumn(), TimeRemainingColumn(), note)
    console = Console(stderr=True)
    return Progress(*columns, console=console, transient=True, disable=not console.is_terminal)
