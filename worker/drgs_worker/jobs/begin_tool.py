"""Begin a file tool (file_tool.py) as a process of its own, forked off one that has loaded what tools need (tool_parent.py).

That process is started with the first tool, ends when none was asked for in a while, and is started again then. All callers of a process share it.
"""

import json
import os
import resource
import socket
import subprocess
import sys
import threading
from contextlib import suppress
from dataclasses import dataclass
from typing import Final

READ_BYTES: Final = 1 << 16
WITHOUT_THREADS: Final = {"CUDA_VISIBLE_DEVICES": "", "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
"""A process that forks should have neither opened a GPU nor begun threads: its children have none of them, and wait for ever for what they would do."""


@dataclass(frozen=True, eq=False)
class _Parent:
    process: subprocess.Popen
    asking: socket.socket


_lock = threading.Lock()
_parent: _Parent | None = None


class RunningTool:
    """A file tool at work, which ends with this object's `close` if not before. Final."""

    def __init__(self, channel: socket.socket) -> None:
        self.channel: Final = channel
        """What the tool says comes out of it, to its end; `hear` is to be given that."""
        self._said = b""

    def hear(self, said: bytes) -> None:
        self._said += said

    def wait(self, seconds: float) -> bool:
        """Whether the tool has ended, as soon as it has; after so long without a word of it, False."""
        self.channel.settimeout(seconds)
        try:
            while said := self.channel.recv(READ_BYTES):
                self.hear(said)
        except TimeoutError:
            return False
        return True

    def result(self) -> tuple[int, str]:
        """Of a tool that has ended: its exit code, less than 0 where a signal ended it, and what it wrote to stderr."""
        errors, ended, code = self._said.rpartition(b"\0")
        if not ended:  # with its parent
            errors, code = code, b"1"
        return int(code), errors.decode(errors="replace")

    def stop(self) -> None:
        """End it; it is over when `channel` is."""
        with suppress(OSError):  # it has ended by itself
            self.channel.shutdown(socket.SHUT_WR)

    def close(self) -> None:
        self.channel.close()


def begin_tool(*arguments: str) -> RunningTool:
    """Begin the tool with the arguments of `file_tool.main`, and with the limits of the size of files that this process has now."""
    global _parent
    here, there = socket.socketpair()
    with there:
        asked = {"arguments": arguments, "file_limits": resource.getrlimit(resource.RLIMIT_FSIZE), "threads": _threads()}
        here.sendall(json.dumps(asked).encode() + b"\n")
        with _lock:
            if _parent is None or not _is_given(_parent, there):
                if _parent is not None:
                    _parent.asking.close()
                    _parent.process.poll()
                _parent = _start()
                _is_given(_parent, there)
    return RunningTool(here)


def _threads() -> int:
    """How many a process like this one computes with."""
    given = os.environ.get("OMP_NUM_THREADS", "")
    return int(given) if given.isdecimal() and int(given) > 0 else os.cpu_count() or 1


def _is_given(parent: _Parent, channel: socket.socket) -> bool:
    try:
        socket.send_fds(parent.asking, [b"+"], [channel.fileno()])
    except OSError:  # it has ended
        return False
    return True


def _start() -> _Parent:
    here, there = socket.socketpair()
    with there:
        process = subprocess.Popen(
            [sys.executable, "-P", "-m", "drgs_worker.jobs.tool_parent", str(there.fileno())],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            pass_fds=[there.fileno()],
            env={**os.environ, **WITHOUT_THREADS},
        )
    return _Parent(process, here)
