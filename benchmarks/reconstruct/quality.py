"""All that is known of an asset's quality on a scene with truth, and where it is lost.

    python -m benchmarks quality SCENE [--asset A | --preset fast [--seeds N]] [--out FOLDER] [--parts figures mesh ...] [--json]

Without --asset it builds one first (FOLDER/asset; a build that was killed goes on). Parts, each left out where the scene lacks the truth for it:

    figures    those of `drgs eval`: views, normals, materials, other lights, deformed
    mesh       distance, signed offset and normals of the mesh (measures/mesh_accuracy.py)
    outlines   distance of the mesh's and the Gaussians' outlines from the masks of the test views [pixels]
    regions    shares of the test views' squared error by region (measures/error_regions.py)
    primary    PSNR of the mesh as primary surface against that of the Gaussians, same views
    light      strength, lamps and looks of the recovered light (measures/light_energy.py)
    swaps      pictures of the asset with one part true and of the truth with one part fitted (measures/swap_parts.py)

SCENE is a folder with test views, or photographs in nerfstudio's layout: of these every eighth is held out and scored (scenes/split_capture.py).
A table goes to stderr, one JSON document to stdout with --json. Pictures are kept in FOLDER/renders and used
again; FOLDER/curves shows the build's PSNR and surfels over minutes and iterations.
"""

import argparse
import json
import sys
import tempfile
from pathlib import Path

import numpy as np

from benchmarks.builds.build_process import built_asset, cli_command, read_events
from benchmarks.builds.fit_curves import write_curves
from benchmarks.measures.measure_asset import PARTS, QualitySettings, measure_asset
from benchmarks.measures.mesh_accuracy import COUNT
from benchmarks.measures.report_table import figure_lines, flat_figures, markdown_table
from benchmarks.scenes.bench_scene import open_scene
from benchmarks.scenes.split_capture import scene_folder
from drgs.scene.asset import load_asset


def main(arguments: list[str]) -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks quality", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scene", type=Path)
    parser.add_argument("--asset", type=Path, help="a built asset; by default one is built")
    parser.add_argument("--preset", default="fast", choices=["draft", "fast", "full"])
    parser.add_argument("--seeds", type=int, help="build this many times, seeds 0, 1, ..., and report means and spreads")
    parser.add_argument("--out", type=Path, help="keep assets and pictures here, and go on from them")
    parser.add_argument("--parts", nargs="+", default=list(PARTS), choices=list(PARTS), metavar="PART", help=", ".join(PARTS))
    parser.add_argument("--spp", type=int, default=256, help="rays a pixel of the scored pictures")
    parser.add_argument("--views", type=int, default=4, help="test views of the parts that render their own pictures")
    parser.add_argument("--swap-spp", type=int, default=128, help="rays a pixel of the pictures of swaps")
    parser.add_argument("--swap-bounces", type=int, default=QualitySettings.swap_bounces)
    parser.add_argument("--mesh-samples", type=int, default=COUNT, help="points whose distance from the other surface is measured")
    parser.add_argument("--side", type=int, default=800, help="of a capture that is split: largest side of the pictures held out [pixels]")
    parser.add_argument("--device", default="auto", choices=["auto", "cpu", "cuda"])
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args(arguments)
    if given.asset is not None and given.seeds is not None:
        raise ValueError("--seeds builds assets, --asset names one that is built; expected one of them")
    if min(given.views, given.spp, given.swap_spp, given.mesh_samples) < 1 or (given.seeds is not None and given.seeds < 1):
        raise ValueError("--views, --spp, --swap-spp, --mesh-samples and --seeds are counts; expected at least 1")
    with tempfile.TemporaryDirectory() as temporary:
        out = given.out or Path(temporary)
        folder = scene_folder(given.scene, out / "capture", given.side)
        if given.seeds is None:
            document = measure(given, folder, out, 0)
        else:
            runs = [measure(given, folder, out / f"seed_{seed}", seed) for seed in range(given.seeds)]
            document = {"scene": runs[0]["scene"], "preset": given.preset, "spread": spread(runs), "runs": runs}
    print("\n".join(report_lines(document)), file=sys.stderr)
    if given.json:
        print(json.dumps(document))


def measure(given: argparse.Namespace, folder: Path, work: Path, seed: int) -> dict:
    """The document of one asset, built first if none is named.

    Args:
        folder: the scene.
    """
    parts = tuple(given.parts)
    settings = QualitySettings(parts, given.spp, given.views, given.swap_spp, given.swap_bounces, given.mesh_samples)
    scene = open_scene(folder)
    build: dict = {}
    if given.asset is None:
        command = cli_command(folder, work / "asset", given.preset, seed, given.device)
        build = {"preset": given.preset, "seed": seed, "build": built_asset(command, work, {"preset": given.preset, "seed": seed})}
        write_curves(work / "curves", {scene.name: {given.preset: read_events(work / "progress.jsonl")}})
    return build | measure_asset(scene, load_asset(given.asset or work / "asset"), work, settings)


def report_lines(document: dict) -> list[str]:
    """The document for people: a figure a line, swaps as a table; of several runs only the spread."""
    lines = figure_lines({name: value for name, value in document.items() if name not in ("runs", "swaps")})
    if "swaps" in document:
        facts = {name: value for name, value in document["swaps"].items() if name != "rows"}
        lines += [*figure_lines({"swaps": facts}), swap_table(document["swaps"]["rows"])]
    return lines


def swap_table(rows: list[dict]) -> str:
    columns = [f"{light}{kind}" for light in ("training", "new", "fitted_light") for kind in ("", " scaled")]
    flat = []
    for row in rows:
        line: dict = {"what is rendered": row["name"]}
        for light in ("training", "new", "fitted_light"):
            if light in row:
                line |= {light: row[light]["psnr"], f"{light} scaled": row[light]["psnr_scaled"]}
        line["new: factors"] = " ".join(f"{factor:.2f}" for factor in row["new"]["scale"])
        flat.append(line)
    return markdown_table(flat, ["what is rendered", *columns, "new: factors"])


def spread(runs: list[dict]) -> dict:
    """Of each figure that is a number in all runs: mean, least and most."""
    tables = [dict(flat_figures(run)) for run in runs]
    found = {}
    for name, first in tables[0].items():
        values = [value for table in tables if isinstance(value := table.get(name), float)]
        if isinstance(first, float) and len(values) == len(tables):
            found[name] = {"mean": float(np.mean(values)), "least": min(values), "most": max(values)}
    return found


if __name__ == "__main__":
    main(sys.argv[1:])
