"""`drgs build` with settings that no preset has: one JSON argument, progress as JSON lines on stdout. A process of its own, started by ablate.

python -m benchmarks.builds.build_variant '{"dataset": ..., "out": ..., "preset": "fast", "variant": "many", "overrides": {...}, "seed": 0}'
"""

import json
import sys
from pathlib import Path

from benchmarks.builds.variants import apply_overrides
from drgs.cli_progress import build_progress
from drgs.reconstruct.build_asset import BuildSettings, build_asset
from drgs.reconstruct.presets import PRESETS


def main(argument: str) -> None:
    job = json.loads(argument)
    name = job["preset"]
    if job["overrides"]:
        # A name of its own: checkpoints say of which preset they are.
        name = f"{job['preset']}+{job['variant']}"
        PRESETS[name] = apply_overrides(PRESETS[job["preset"]], job["overrides"])
    out = Path(job["out"])
    settings = BuildSettings(preset=name, device=job["device"], seed=job["seed"], resume=Path(f"{out}.build").is_dir())
    with build_progress(True) as report:
        asset = build_asset(Path(job["dataset"]), out, settings, progress=report, previews=False)
    print(json.dumps({"stage": "done", "provenance": asset.provenance}), flush=True)


def variant_command(dataset: Path, out: Path, preset: str, variant: str, overrides: dict, seed: int, device: str) -> list[str]:
    """Arguments of Python that start it."""
    job = {
        "dataset": str(dataset),
        "out": str(out),
        "preset": preset,
        "variant": variant,
        "overrides": overrides,
        "seed": seed,
        "device": device,
    }
    return ["-m", "benchmarks.builds.build_variant", json.dumps(job)]


if __name__ == "__main__":
    main(sys.argv[1])
