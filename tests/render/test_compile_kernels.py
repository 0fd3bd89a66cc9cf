import sys
from pathlib import Path

import pytest

from drgs import compiled_kernels
from drgs.render import compile_kernels


@pytest.mark.slow
def test_pictures_of_all_kinds_are_made_and_the_note_is_left(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    states, frames = [], []
    resolve = compile_kernels.resolve_frame
    monkeypatch.setattr(compile_kernels, "resolve_frame", lambda state: states.append(state) or frames.append(resolve(state)))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(sys, "argv", ["compile_kernels", "cpu"])
    compile_kernels.main()
    assert compiled_kernels.are_compiled()
    assert [state.is_quick for state in states] == [False, True, True, True, False, True]
    assert states[3].kept_light is not None and states[4].rates is not None, "light was kept, and passes look unevenly"
    assert all(float((frame.gbuffer.coverage > 0).float().mean()) > 0.1 for frame in frames), "the object is seen"


def test_a_home_that_cannot_be_written_to_is_said(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    monkeypatch.setattr(compile_kernels, "compile_kernels", lambda device: None)
    monkeypatch.setattr(sys, "argv", ["compile_kernels", "cpu"])
    compile_kernels.main()
    assert "cannot be noted" in capfd.readouterr().err and not compiled_kernels.are_compiled()
