"""What CUDA runs, where there is none (pretended_cuda.py): no tensor is on the wrong device, and pictures are the CPU's."""

import json
import subprocess
import sys
from pathlib import Path

import pytest


@pytest.mark.slow
def test_a_build_pictures_edits_matter_and_a_servers_channels_go_through_on_a_pretended_gpu(tmp_path: Path) -> None:
    done = subprocess.run([sys.executable, "-m", "tests.run_on_pretended_cuda", tmp_path], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-3000:]
    launched = json.loads(done.stdout.splitlines()[-1])["launched"]
    # The ways that only CUDA goes; raise_horizons is the plain twin of what the CPU launches.
    names = (
        "blend_pixels",
        "blend_pixels_backward",
        "query_closest",
        "query_any",
        "raise_horizons",
        "see_blocks",
        "filter_level",
        "scatter_particles",
    )
    assert all(any(kernel.endswith(name) and count > 0 for kernel, count in launched.items()) for name in names), launched
