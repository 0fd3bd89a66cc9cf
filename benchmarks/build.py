"""Build an asset the way a user does, in a process of its own, and measure it: seconds a stage, peak memory, quality.

python -m benchmarks build DATASET [--preset fast] [--out FOLDER] [--spp N] [--json]
"""

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path


def main(arguments: list[str]) -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks build", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("dataset", type=Path)
    parser.add_argument("--preset", default="fast", choices=["draft", "fast", "full"])
    parser.add_argument("--device", default="auto", choices=["auto", "cpu", "cuda"])
    parser.add_argument("--out", type=Path, help="keep the asset and its renders here")
    parser.add_argument("--spp", type=int, default=256, help="rays a pixel of the scored pictures")
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as temporary:
        out = given.out or Path(temporary)
        result = measure_build(given.dataset, out / "asset", given.preset, given.device)
        result["quality"] = evaluate(out / "asset", given.dataset, out / "renders", given.spp, given.device)
    print(json.dumps(result, indent=None if given.json else 1))


def measure_build(dataset: Path, asset: Path, preset: str, device: str) -> dict:
    """Seconds and memory of `drgs build`.

    Raises:
        ValueError: the build failed; its own words are on stderr.
    """
    command = [
        sys.executable,
        "-m",
        "drgs.cli",
        "build",
        str(dataset),
        str(asset),
        "--preset",
        preset,
        "--device",
        device,
        "--json-progress",
    ]
    start = time.perf_counter()
    finished: dict = {}
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        for line in process.stdout:
            finished = json.loads(line)  # the last one is the asset's own account
    if process.returncode != 0:
        raise ValueError(f"drgs build ended with exit code {process.returncode}")
    # The largest of the processes waited for so far: the build is the only one yet. Linux counts in KiB, macOS in bytes.
    peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
    return {
        "dataset": dataset.name,
        "preset": preset,
        "seconds": round(time.perf_counter() - start, 2),
        "seconds_per_stage": {stage: round(seconds, 2) for stage, seconds in finished["provenance"]["seconds"].items()},
        "peak_memory_mib": round(peak / 2**20),
    }


def evaluate(asset: Path, dataset: Path, renders: Path, samples_per_pixel: int, device: str) -> dict:
    """The figures of `drgs eval`."""
    command = [sys.executable, "-m", "drgs.cli", "eval", str(asset), str(dataset), "--out", str(renders), "--spp", str(samples_per_pixel)]
    done = subprocess.run([*command, "--device", device, "--json"], stdout=subprocess.PIPE, text=True)
    if done.returncode != 0:
        raise ValueError(f"drgs eval ended with exit code {done.returncode}")
    return json.loads(done.stdout)
