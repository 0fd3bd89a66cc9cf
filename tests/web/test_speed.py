"""What a user waits for, within what the viewer promises: the benchmark's own figures, from a short run of it."""

import json
import subprocess
import sys

import pytest

from tests.web.browser import ROOT
from tests.web.conftest import RunningServer

ATTEMPTS = 3
"""Of a measurement on a machine that others may use too: one that keeps a promise shows that the code does."""


@pytest.mark.alone
def test_the_viewer_is_as_quick_as_promised(server: RunningServer) -> None:
    missed: list[str] = ["not measured"]
    for _ in range(ATTEMPTS):
        command = [sys.executable, "-m", "benchmarks", "viewer", "--repeats", "3", "--turn-seconds", "2", "--json"]
        measured = json.loads(subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout)
        print(measured)
        kept = {
            "edit_to_pixel_ms": measured["edit_to_pixel_ms"] <= 250,
            "local_fps": measured["local_fps"] >= 30,
            "traced_fps": measured["traced_fps"] >= 5,
            "reconnect_s": measured["reconnect_s"] <= 2,
            "bundle_gz_kb": measured["bundle_gz_kb"] <= 1500,
        }
        missed = [f"{name} is {measured[name]}" for name, keeps in kept.items() if not keeps]
        if not missed:
            break
    assert not missed
