"""The first start compiles the renderer in a process of its own, says so, and ends it with the server."""

import sys
import threading
from pathlib import Path

import pytest

from drgs import compiled_kernels
from drgs_server import first_start
from drgs_server.first_start import KernelCompiler


class FakeProcess:
    """Runs until it is told to end, or has ended at once."""

    def __init__(self, code: int | None) -> None:
        self.code, self.ended = code, threading.Event()
        if code is not None:
            self.ended.set()

    def poll(self) -> int | None:
        return self.code if self.ended.is_set() else None

    def wait(self, timeout: float | None = None) -> int:
        assert self.ended.wait(timeout or 10)
        assert self.code is not None
        return self.code

    def terminate(self) -> None:
        self.code = -15
        self.ended.set()


def started(
    monkeypatch: pytest.MonkeyPatch, code: int | None, compiled: bool = False
) -> tuple[KernelCompiler, list[list[str]], FakeProcess]:
    process, commands = FakeProcess(code), []
    monkeypatch.setattr(first_start, "are_compiled", lambda: compiled)
    monkeypatch.setattr(first_start.subprocess, "Popen", lambda command, **_: commands.append(command) or process)
    compiler = KernelCompiler("cpu")
    compiler.start()
    for thread in threading.enumerate():
        if thread.name == "kernel-compiler" and code is not None:
            thread.join(10)
    return compiler, commands, process


def test_what_is_compiled_is_not_compiled_again(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> None:
    _, commands, _ = started(monkeypatch, 0, compiled=True)
    assert commands == [] and capfd.readouterr().err == ""


@pytest.mark.parametrize(("code", "said"), [(0, "is compiled ("), (3, "exit code 3); it is when pictures need it")])
def test_who_starts_a_server_first_is_told(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], code: int, said: str
) -> None:
    _, commands, _ = started(monkeypatch, code)
    assert commands == [[sys.executable, "-P", "-m", "drgs.render.compile_kernels", "cpu"]]
    lines = capfd.readouterr().err.splitlines()
    assert len(lines) == 2 and "once: about ten seconds" in lines[0] and said in lines[1]


def test_a_server_that_ends_ends_what_it_compiles_and_does_not_complain(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    compiler, commands, process = started(monkeypatch, None)
    while not commands:
        pass
    compiler.stop()
    assert process.poll() == -15
    for thread in threading.enumerate():
        if thread.name == "kernel-compiler":
            thread.join(10)
    assert "could not" not in capfd.readouterr().err


def test_the_note_is_of_this_code_and_of_this_folder_of_kernels(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    package = tmp_path / "drgs"
    for part in ("maths", "render"):
        (package / part).mkdir(parents=True)
        (package / part / "a.py").write_text("1")
    (package / "warp_torch.py").write_text("2")
    monkeypatch.setattr(compiled_kernels, "PACKAGE", package)
    assert not compiled_kernels.are_compiled()
    note = compiled_kernels.note()
    note.parent.mkdir(parents=True)
    note.touch()
    assert compiled_kernels.are_compiled()
    monkeypatch.setenv("WARP_CACHE_PATH", str(tmp_path / "elsewhere"))
    assert not compiled_kernels.are_compiled()
    monkeypatch.delenv("WARP_CACHE_PATH")
    (package / "render" / "a.py").write_text("10")
    assert not compiled_kernels.are_compiled()
