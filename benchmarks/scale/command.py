"""How costs grow: each as a curve over one size, and the exponent k of cost ~ size^k.

    python -m benchmarks scale [--only NAME ...] [--asset ASSET] [--scene SCENE [--preset PRESET]] [--plots OUT] [--repeats 3] [--json]

pixels: a moving picture (32 rays a pixel, denoised, with kept light) and a first still pass of 32 rays, of ASSET or a made object.
faces: the same of a ball with bumps of 10 k to 1 M faces, its tree, and this process's memory. surfels: a G-buffer of a torus of Gaussians.
samples: a still of 8 to 512 rays a pixel. edits: one more edit on a server with 10 to 10 000 in force, until it is acknowledged and until a picture
shows it, and bytes of messages. assets: a server's memory beyond its own with 1 to 8 open assets, and MiB a MiB of their files.
builds, only where --only names it: `drgs build` of 16, 32 and 64 photographs of SCENE; with --preset also builds_pixels, of photographs shrunk to 100, 200
and 400 pixels. Exponents: `exponent` over all points by least squares, `last_exponent` between the last two; up to
{linear} is called no faster than linear. Costs of what is made once (kernels, trees, tables) are in none but what names them.
"""

import argparse
import json
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from benchmarks.scale.assets import assets
from benchmarks.scale.builds import builds, builds_pixels
from benchmarks.scale.cost_curve import LINEAR, CostCurve, table_lines, write_plot
from benchmarks.scale.edits import edits
from benchmarks.scale.faces import faces
from benchmarks.scale.pixels import pixels
from benchmarks.scale.samples import samples
from benchmarks.scale.scale_run import ScaleRun, ScaleSizes
from benchmarks.scale.surfels import surfels
from drgs.reconstruct.presets import PRESETS
from drgs.warp_torch import device_from_name

CURVES: dict[str, Callable[[ScaleRun], CostCurve]] = {
    "pixels": pixels,
    "faces": faces,
    "surfels": surfels,
    "samples": samples,
    "edits": edits,
    "assets": assets,
    "builds": builds,
    "builds_pixels": builds_pixels,
}
"""Each name is also that of its sizes."""
LONG = ("builds", "builds_pixels")
"""Made only when they are named."""


def main(arguments: list[str]) -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks scale",
        description=(__doc__ or "").format(linear=LINEAR),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--only", nargs="+", choices=list(CURVES), help=f"default: all but {', '.join(LONG)}")
    parser.add_argument("--sizes", nargs="+", type=int, metavar="X", help="in place of the usual ones, of the curve that --only names")
    parser.add_argument("--asset", type=Path, help="what pictures show; default: a made object")
    parser.add_argument("--scene", type=Path, help="of builds: a folder with transforms_train.json, such as those that draw_scene writes")
    parser.add_argument("--preset", choices=list(PRESETS), help="of builds; default: draft, of photographs as large as they are")
    parser.add_argument("--plots", type=Path, metavar="OUT", help="a folder that gets a log-log SVG a curve")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--device", default="auto", choices=["auto", "cpu", "cuda"])
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args(arguments)
    names = given.only or [name for name in CURVES if name not in LONG]
    with tempfile.TemporaryDirectory(prefix="drgs-scale-") as folder:
        run = ScaleRun(
            Path(folder),
            sizes_of(names, given.sizes),
            given.repeats,
            device_from_name(given.device),
            given.asset,
            given.scene,
            given.preset,
        )
        if "builds" in names and given.preset and not given.sizes:
            names = list(dict.fromkeys([*names, "builds_pixels"]))
        curves = measure(run, names)
    for curve in curves if given.plots else ():
        write_plot(curve, given.plots)
    if given.json:
        print(json.dumps({"curves": {curve.name: curve.document() for curve in curves}}))
    else:
        print("\n\n".join("\n".join(table_lines(curve)) for curve in curves))


def sizes_of(names: list[str], sizes: list[int] | None) -> ScaleSizes:
    """The usual sizes, or with those given for the one curve that is asked for.

    Raises:
        ValueError: sizes are given for several curves, or are no ascending numbers above 0.
    """
    if sizes is None:
        return ScaleSizes()
    if len(names) != 1:
        raise ValueError(f"--sizes is given for {', '.join(names)}; expected one curve named by --only")
    if sizes[0] < 1 or sizes != sorted(set(sizes)):
        raise ValueError(f"--sizes is {sizes}; expected numbers above 0, each larger than the one before")
    changed: dict[str, Any] = {names[0]: tuple(sizes)}
    return replace(ScaleSizes(), **changed)


def measure(run: ScaleRun, names: Sequence[str]) -> list[CostCurve]:
    """Curve after curve.

    Raises:
        ValueError: fewer than one repetition, or builds without a scene.
    """
    if run.repeats < 1:
        raise ValueError(f"--repeats is {run.repeats}; expected at least 1")
    if run.scene is None and any(name in LONG for name in names):
        raise ValueError("builds need --scene SCENE, a folder with transforms_train.json and its photographs")
    return [CURVES[name](run) for name in names]
