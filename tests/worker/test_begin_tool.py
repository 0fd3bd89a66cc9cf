"""File tools as processes: what they say and end with, and that none outlives who asked for it."""

import fcntl
import os
import resource
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import psutil
import pytest

from drgs_worker.jobs import begin_tool as module
from drgs_worker.jobs import tool_parent
from drgs_worker.jobs.begin_tool import RunningTool, begin_tool
from tests.patience import PATIENCE_SECONDS

FEW_FILES = 1024
"""Numbers of files from here on are too large for select."""
TETRAHEDRON = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


def wait_until(condition: Callable[[], Any], what: str) -> Any:
    deadline = time.monotonic() + PATIENCE_SECONDS
    while not (answer := condition()):
        assert time.monotonic() < deadline, f"waited too long for {what}"
        time.sleep(0.02)
    return answer


def ended(tool: RunningTool) -> tuple[int, str]:
    assert tool.wait(PATIENCE_SECONDS)
    tool.close()
    return tool.result()


@pytest.fixture
def waiting(tmp_path: Path) -> Path:
    """A file that keeps its reader waiting for ever."""
    place = tmp_path / "waiting.exr"
    os.mkfifo(place)
    return place


def children_of_parent() -> list[psutil.Process]:
    assert module._parent is not None
    return psutil.Process(module._parent.process.pid).children()


@pytest.mark.slow
def test_tools_say_what_is_wrong_and_leave_what_is_right_and_all_have_one_parent(tmp_path: Path) -> None:
    (tmp_path / "four.obj").write_text(TETRAHEDRON)
    (tmp_path / "none.obj").write_text("nothing")
    right = begin_tool("asset", str(tmp_path / "four.obj"), str(tmp_path / "four"))
    parent = module._parent
    wrong = begin_tool("asset", str(tmp_path / "none.obj"), str(tmp_path / "none"))
    assert ended(right) == (0, "")
    code, said = ended(wrong)
    assert code == 2 and "none.obj" in said.splitlines()[-1]
    assert (tmp_path / "four" / "asset.json").exists() and not (tmp_path / "none").exists()
    assert module._parent is parent is not None
    parent.process.kill()
    parent.process.wait()
    assert ended(begin_tool("asset", str(tmp_path / "four.obj"), str(tmp_path / "again"))) == (0, ""), "another parent was started"


@pytest.mark.slow
def test_a_tool_that_is_stopped_or_forgotten_is_over_while_others_go_on(waiting: Path, tmp_path: Path) -> None:
    stopped, forgotten = (begin_tool("environment", str(waiting), str(tmp_path / "out")) for _ in range(2))
    wait_until(lambda: len(children_of_parent()) == 2, "two tools that wait")
    assert not stopped.wait(0.05)
    stopped.stop()
    assert ended(stopped) == (-9, "")
    assert len(children_of_parent()) == 1
    forgotten.close()
    wait_until(lambda: not children_of_parent(), "the end of a tool that nobody waits for")


def large_mesh() -> str:
    """So large that torch shares out its loops among threads."""
    side = 120
    corners = [f"v {x / side} {y / side} 0" for y in range(side) for x in range(side)]
    lower = [y * side + x + 1 for y in range(side - 1) for x in range(side - 1)]
    faces = [f"f {a} {a + 1} {a + side}\nf {a + 1} {a + side + 1} {a + side}" for a in lower]
    return "\n".join(corners + faces)


@pytest.mark.slow
@pytest.mark.skipif(not tool_parent.FORKS, reason="tools are started one by one here")
def test_the_parent_has_no_threads_and_its_children_as_many_as_they_like(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    (tmp_path / "large.obj").write_text(large_mesh())
    for name in ("first", "second"):
        assert ended(begin_tool("asset", str(tmp_path / "large.obj"), str(tmp_path / name))) == (0, "")
        assert module._parent is not None
        assert psutil.Process(module._parent.process.pid).num_threads() == 1
    module._parent.asking.close()
    assert module._parent.process.wait(PATIENCE_SECONDS) == 0


@pytest.mark.slow
def test_tools_and_their_parent_end_with_who_asked(waiting: Path, tmp_path: Path) -> None:
    program = """
import sys, time
from drgs_worker.jobs import begin_tool
tool = begin_tool.begin_tool("environment", *sys.argv[1:])
print(begin_tool._parent.process.pid, flush=True)
time.sleep(600)
"""
    command = [sys.executable, "-c", program, str(waiting), str(tmp_path / "out")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as asking:
        assert asking.stdout is not None
        parent = psutil.Process(int(asking.stdout.readline()))
        (tool,) = wait_until(parent.children, "the tool")
        asking.kill()
    wait_until(lambda: not parent.is_running() and not tool.is_running(), "the end of both")


def test_a_tool_that_ended_with_its_parent_has_failed_with_what_it_said() -> None:
    here, there = socket.socketpair()
    there.sendall(b"half a sent")
    there.close()
    assert ended(RunningTool(here)) == (1, "half a sent")


@contextmanager
def more_files(count: int) -> Iterator[None]:
    """This process may have so many files open."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (max(soft, count), hard))
    yield
    resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


@pytest.fixture
def parent_here(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[socket.socket], int]]:
    """The parent's loop in this process, which keeps its signals."""
    monkeypatch.setattr(tool_parent, "IDLE_SECONDS", 0.05)
    monkeypatch.setattr(tool_parent, "_load_what_tools_need", lambda: None)
    monkeypatch.setattr(tool_parent.gc, "freeze", lambda: None)
    handlers = {number: tool_parent.signal.getsignal(number) for number in (tool_parent.signal.SIGINT, tool_parent.signal.SIGCHLD)}
    yield lambda asking: tool_parent.main([str(asking.detach())])
    tool_parent.signal.set_wakeup_fd(-1)
    for number, handler in handlers.items():
        tool_parent.signal.signal(number, handler)


def test_a_parent_that_nobody_asks_ends_and_its_socket_takes_no_more(parent_here: Callable[[socket.socket], int]) -> None:
    here, there = socket.socketpair()
    with here, there, more_files(2 * FEW_FILES):
        assert parent_here(socket.socket(fileno=fcntl.fcntl(there, fcntl.F_DUPFD, FEW_FILES))) == 0
        there.close()
        with pytest.raises(BrokenPipeError):
            here.send(b"+")
