"""Build an asset the way a user does, in a process of its own, and measure it: seconds a stage, peak memory, quality.

python -m benchmarks build DATASET [--preset fast] [--out FOLDER] [--spp N] [--json]
"""

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

from benchmarks.builds.build_process import cli_command, run_build


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
    run = run_build(cli_command(dataset, asset, preset, device=device, resume=False))
    return {"dataset": dataset.name, "preset": preset} | vars(run)


def evaluate(asset: Path, dataset: Path, renders: Path, samples_per_pixel: int, device: str) -> dict:
    """The figures of `drgs eval`."""
    command = [sys.executable, "-m", "drgs", "eval", str(asset), str(dataset), "--out", str(renders), "--spp", str(samples_per_pixel)]
    done = subprocess.run([*command, "--device", device, "--json"], stdout=subprocess.PIPE, text=True)
    if done.returncode != 0:
        raise ValueError(f"drgs eval ended with exit code {done.returncode}")
    return json.loads(done.stdout)
