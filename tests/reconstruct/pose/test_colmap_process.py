"""The process that looks for poses is followed, ended, and outlived by nothing."""

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from drgs.reconstruct.pose import colmap_process as module
from drgs.reconstruct.pose.colmap_process import colmap_process
from drgs.reconstruct.progress import BuildStopped
from tests.patience import PATIENCE_SECONDS


@pytest.fixture
def program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    path = tmp_path / "program.py"
    monkeypatch.setattr(module, "PROGRAM", path)
    monkeypatch.setattr(module, "PATIENCE_SECONDS", 0.5)
    return path


def test_its_lines_are_passed_on_and_others_are_no_matter(program: Path, tmp_path: Path):
    program.write_text("""print('{"step": "features", "done": 1, "total": 3}'); print("a word of a library")""")
    told: list[tuple[str, int, int]] = []
    colmap_process(tmp_path / "job.json", lambda *report: told.append(report), lambda: False)
    assert told == [("features", 1, 3)]


def test_its_threads_start_none_of_their_own(program: Path, tmp_path: Path):
    """Else what is found depends on what else the machine does."""
    program.write_text("""import os; print('{"step": "features", "done": %s, "total": 1}' % os.environ["OMP_NUM_THREADS"])""")
    told: list[tuple[str, int, int]] = []
    colmap_process(tmp_path / "job.json", lambda *report: told.append(report), lambda: False)
    assert told == [("features", 1, 1)]


def test_one_that_does_not_listen_is_killed(program: Path, tmp_path: Path):
    program.write_text("import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); print('{}', flush=True); time.sleep(600)")
    started = time.monotonic()
    asked: list[int] = []
    with pytest.raises(BuildStopped):
        colmap_process(tmp_path / "job.json", lambda *report: None, lambda: asked.append(1) or len(asked) > 2)
    assert time.monotonic() - started < PATIENCE_SECONDS


@pytest.mark.parametrize(
    ("code", "sentence"),
    [
        (
            "import os; os.kill(os.getpid(), 9)",
            r"pycolmap was ended by signal 9 \(too little memory, or a full disk\?\) .* go on with --resume",
        ),
        ("raise SystemExit('no room left')", "pycolmap failed before the poses were found; .* no room left"),
    ],
)
def test_one_that_ends_by_itself_is_told_with_its_log(program: Path, tmp_path: Path, code: str, sentence: str):
    program.write_text(code)
    with pytest.raises(ValueError, match=sentence):
        colmap_process(tmp_path / "job.json", lambda *report: None, lambda: False)


@pytest.mark.parametrize("crashes", [1, 2])
def test_one_that_crashes_is_tried_once_more(program: Path, tmp_path: Path, crashes: int):
    tries = tmp_path / "tries"
    program.write_text(f"""
import os, pathlib, sys
tries = pathlib.Path({str(tries)!r})
tries.write_text(tries.read_text() + "x" if tries.exists() else "x")
print("try", len(tries.read_text()), file=sys.stderr, flush=True)
if len(tries.read_text()) <= {crashes}:
    os.abort()
""")
    if crashes == 2:
        with pytest.raises(ValueError, match=r"pycolmap was ended by signal 6 .* try 1 .*try 2"):
            colmap_process(tmp_path / "job.json", lambda *report: None, lambda: False)
    else:
        colmap_process(tmp_path / "job.json", lambda *report: None, lambda: False)
    assert tries.read_text() == "xx"


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="makes a named pipe")
def test_it_ends_when_who_started_it_is_gone(tmp_path: Path):
    pytest.importorskip("pycolmap")
    # The end of its stdin is what it sees of that. The job is a pipe that never says anything.
    job = tmp_path / "job.json"
    os.mkfifo(job)
    command = [sys.executable, Path(module.__file__).with_name("run_colmap.py"), job]
    assert subprocess.run(command, stdin=subprocess.DEVNULL, timeout=PATIENCE_SECONDS).returncode == 1
