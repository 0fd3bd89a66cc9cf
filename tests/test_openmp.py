"""How torch's idle threads wait, which programs choose before torch is loaded."""

import json
import os
import subprocess
import sys

import pytest

from drgs.openmp import ASLEEP, BLAS_ASLEEP, SPINS, sleep_at_once, spin_briefly, spin_briefly_unless_told


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


@pytest.mark.parametrize(("given", "found"), [({}, SPINS), ({"GOMP_SPINCOUNT": ASLEEP}, ASLEEP), ({"OMP_WAIT_POLICY": "active"}, None)])
def test_importing_the_library_chooses_what_nobody_has(given: dict[str, str], found: str | None) -> None:
    code = "import json, os, sys, drgs; print(json.dumps([os.environ.get('GOMP_SPINCOUNT'), 'torch' in sys.modules]))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=os.environ | given)
    assert json.loads(done.stdout) == [found, False]


def test_a_server_changes_what_importing_the_library_chose() -> None:
    spin_briefly_unless_told()
    assert os.environ["GOMP_SPINCOUNT"] == SPINS
    sleep_at_once()
    assert os.environ["GOMP_SPINCOUNT"] == ASLEEP
    spin_briefly_unless_told()
    assert os.environ["GOMP_SPINCOUNT"] == ASLEEP


@pytest.mark.parametrize(("command", "chosen"), [("doctor", SPINS), ("serve", ASLEEP)])
def test_the_command_line_chooses_before_torch_is_loaded(monkeypatch: pytest.MonkeyPatch, command: str, chosen: str) -> None:
    """Whatever started it chose for itself; but for a server, which does so when it begins."""
    monkeypatch.setenv("GOMP_SPINCOUNT", ASLEEP)
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
    assert json.loads(done.stderr.splitlines()[-1]) == [chosen, False]
