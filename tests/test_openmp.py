"""How torch's idle threads wait, which programs choose before torch is loaded."""

import json
import os
import subprocess
import sys

import pytest

from drgs.openmp import ASLEEP, BLAS_ASLEEP, SPINS, sleep_at_once, spin_briefly


@pytest.fixture(autouse=True)
def nothing_set(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT", "OPENBLAS_THREAD_TIMEOUT"):
        monkeypatch.setenv(name, "")  # so that what a test sets is undone
        monkeypatch.delenv(name)


def test_a_worker_does_not_keep_its_servers_choice() -> None:
    sleep_at_once()
    assert os.environ["GOMP_SPINCOUNT"] == ASLEEP
    spin_briefly()
    assert os.environ["GOMP_SPINCOUNT"] == SPINS
    assert os.environ["OPENBLAS_THREAD_TIMEOUT"] == BLAS_ASLEEP


@pytest.mark.parametrize(("name", "value"), [("OMP_WAIT_POLICY", "active"), ("GOMP_SPINCOUNT", "77")])
def test_what_the_user_has_set_holds(monkeypatch: pytest.MonkeyPatch, name: str, value: str) -> None:
    monkeypatch.setenv(name, value)
    before = dict(os.environ)
    spin_briefly()
    sleep_at_once()
    assert dict(os.environ) == before


@pytest.mark.parametrize(("command", "spins"), [("doctor", SPINS), ("serve", None)])
def test_the_command_line_chooses_before_torch_is_loaded(command: str, spins: str | None) -> None:
    code = """
import json, os, sys
sys.argv = ["drgs", sys.argv[1], "--help"]
import drgs.cli
try:
    drgs.cli.main()
except SystemExit:
    print(json.dumps([os.environ.get("GOMP_SPINCOUNT"), "torch" in sys.modules]), file=sys.stderr)
"""
    done = subprocess.run([sys.executable, "-c", code, command], capture_output=True, text=True)
    assert json.loads(done.stderr.splitlines()[-1]) == [spins, False]
