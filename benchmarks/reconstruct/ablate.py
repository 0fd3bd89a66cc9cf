"""Builds of variants on scenes, one after the other, measured and put into one table. Killed and started again it goes on where it was.

    python -m benchmarks ablate --variants base many:fit.densify.budget=60000 variants.toml --scenes DIR ... --preset fast [--seeds 3] --out DIR

A variant is a name and settings that differ from the preset (builds/variants.py). Each build is a process of its own in
DIR/SCENE/VARIANT/seed_K. A finished row stands in DIR/rows.jsonl and is not run again; DIR/table.md holds the main figures, and differences to the
first variant: with several seeds those within twice the spread (most less least) are in brackets, for they may be noise. DIR/curves holds PSNR
and surfels over minutes and iterations, and where variants begin with different presets, what each build reached over the time it took
(benchmarks/presets.toml: draft, fast, full and two between). Rows that failed are tried again by the next call.
"""

import argparse
import json
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks._plot import Curve, linear_svg
from benchmarks.builds.build_process import built_asset, read_events
from benchmarks.builds.build_variant import variant_command
from benchmarks.builds.fit_curves import write_curves
from benchmarks.builds.variants import Variant, apply_overrides, read_variants
from benchmarks.measures.measure_asset import PARTS, QualitySettings, measure_asset
from benchmarks.measures.report_table import flat_figures, markdown_table
from benchmarks.scenes.bench_scene import BenchScene, open_scene
from benchmarks.scenes.split_capture import scene_folder
from drgs.reconstruct.presets import PRESETS
from drgs.scene.asset import load_asset

DEFAULT_PARTS = ("figures", "mesh", "outlines", "primary", "light")


@dataclass(frozen=True)
class Column:
    """A main figure: the mean of all leaves of a document whose dotted names begin and end so."""

    title: str
    begin: str
    end: str
    digits: int = 2


COLUMNS = (
    Column("views dB", "figures.views.", ".psnr"),
    Column("SSIM", "figures.views.", ".ssim", 3),
    Column("normals °", "figures.maps.", ".normal_mae"),
    Column("relit dB", "figures.relight.", ".psnr_scaled"),
    Column("deformed dB", "figures.deform.", ".psnr_scaled"),
    Column("albedo dB", "figures.maps.", ".albedo_psnr"),
    Column("roughness", "figures.maps.", ".roughness_rmse", 3),
    Column("metallic", "figures.maps.", ".metallic_rmse", 3),
    Column("light dB", "figures.maps.", ".env_psnr"),
    Column("mesh %", "mesh.", ".completeness_mean"),
    Column("offset %", "mesh.", ".offset_median"),
    Column("outline px", "outlines.mesh.", ".signed_pixels"),
    Column("mesh primary dB", "primary.psnr.", ".mesh"),
    Column("lamps", "light.", ".brightest_energy_scaled"),
    Column("surfels", "asset.", ".surfels", 0),
    Column("seconds", "build.", ".seconds", 0),
    Column("CPU s", "build.", ".cpu_seconds", 0),
    Column("MiB", "build.", ".peak_memory_mib", 0),
)


REACHED = ("views dB", "relit dB", "deformed dB")
"""Titles of COLUMNS in the plots over time."""


def main(arguments: list[str]) -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks ablate", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--variants", nargs="+", required=True, help="files, or words like base and NAME:path=value,path=value")
    parser.add_argument("--scenes", nargs="+", type=Path, required=True)
    parser.add_argument("--preset", default="fast", choices=list(PRESETS))
    parser.add_argument("--seeds", type=int, default=1, help="builds of each, seeds 0, 1, ...")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--parts", nargs="+", default=list(DEFAULT_PARTS), choices=list(PARTS), metavar="PART", help=", ".join(PARTS))
    parser.add_argument("--spp", type=int, default=256, help="rays a pixel of the scored pictures")
    parser.add_argument("--views", type=int, default=4, help="test views of the parts that render their own pictures")
    parser.add_argument("--side", type=int, default=800, help="of a capture that is split: largest side of the pictures held out [pixels]")
    parser.add_argument("--device", default="auto", choices=["auto", "cpu", "cuda"])
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args(arguments)
    variants = read_variants(given.variants)
    for variant in variants:
        apply_overrides(PRESETS[variant.preset or given.preset], variant.overrides)  # complain before the first build
    if given.seeds < 1:
        raise ValueError(f"--seeds is {given.seeds}; expected at least 1")
    settings = QualitySettings(tuple(given.parts), given.spp, given.views)
    scenes = [open_scene(scene_folder(folder, given.out / folder.name / "capture", given.side)) for folder in given.scenes]

    def run(scene: BenchScene, variant: Variant, seed: int, work: Path) -> dict:
        preset = variant.preset or given.preset
        command = variant_command(scene.folder, work / "asset", preset, variant.name, variant.overrides, seed, given.device)
        what = {"preset": preset, "overrides": variant.overrides, "seed": seed}
        build = built_asset(command, work, what)
        return {"build": build} | measure_asset(scene, load_asset(work / "asset"), work, settings)

    rows = run_rows(variants, scenes, given.preset, given.seeds, given.out, run)
    table = main_table(rows, [variant.name for variant in variants])
    (given.out / "table.md").write_text(table + "\n")
    write_curves(given.out / "curves", progress_of(rows, given.out))
    if any(variant.preset for variant in variants):
        write_reached(given.out / "curves", rows)
    print(table, file=sys.stderr)
    if given.json:
        print(json.dumps({"rows": rows, "failed": read_failures(given.out)}))


def run_rows(
    variants: list[Variant],
    scenes: list[BenchScene],
    preset: str,
    seeds: int,
    out: Path,
    run: Callable[[BenchScene, Variant, int, Path], dict],
) -> list[dict]:
    """The finished rows of all combinations, in order; those that are not in out/rows.jsonl yet are run.

    Raises:
        ValueError: a kept row is of a variant that had other settings then.
    """
    out.mkdir(parents=True, exist_ok=True)
    kept = read_rows(out)
    failures: dict[str, str] = {}
    rows = []
    for seed in range(seeds):  # all variants get their first seed before any gets its second
        for scene in scenes:
            for variant in variants:
                key = {"scene": scene.name, "variant": variant.name, "seed": seed}
                row = next((row for row in kept if all(row[name] == value for name, value in key.items())), None)
                asked = {"preset": variant.preset or preset, "overrides": variant.overrides}
                if row is not None and {name: row[name] for name in asked} != asked:
                    raise ValueError(
                        f"{out} holds a row of {variant.name} with {row['preset']}, {row['overrides']}; expected {asked}: rename it"
                    )
                if row is None:
                    work = out / scene.name / variant.name / f"seed_{seed}"
                    try:
                        row = key | asked | {"commit": commit()} | run(scene, variant, seed, work)
                    except ValueError as error:
                        failures[str(work.relative_to(out))] = str(error)
                        print(f"ablate: {work.relative_to(out)} failed: {error}", file=sys.stderr)
                        continue
                    with (out / "rows.jsonl").open("a") as file:
                        file.write(json.dumps(row) + "\n")
                rows.append(row)
    (out / "failed.json").write_text(json.dumps(failures))
    return rows


def read_rows(out: Path) -> list[dict]:
    """Rows of out/rows.jsonl; a last line that a kill cut short is left out, and removed."""
    path = out / "rows.jsonl"
    if not path.is_file():
        return []
    text = path.read_text()
    whole = text[: text.rfind("\n") + 1]
    if whole != text:
        path.write_text(whole)
    return [json.loads(line) for line in whole.splitlines()]


def read_failures(out: Path) -> dict:
    return json.loads((out / "failed.json").read_text())


def main_figures(row: dict) -> dict[str, float]:
    """By title of COLUMNS; what the scene has no truth for is not there."""
    flat = [(f"{name}", value) for name, value in flat_figures(row) if isinstance(value, int | float) and not isinstance(value, bool)]
    figures = {}
    for column in COLUMNS:
        values = [value for name, value in flat if name.startswith(column.begin) and f".{name}".endswith(column.end)]
        if values:
            figures[column.title] = float(np.mean(values))
    return figures


def main_table(rows: list[dict], variants: list[str]) -> str:
    """Two Markdown tables: the main figures (mean and, of several seeds, ± half the spread), and what differs from the first variant."""
    groups: dict[tuple[str, str], list[dict[str, float]]] = {}
    for row in rows:
        groups.setdefault((row["scene"], row["variant"]), []).append(main_figures(row))
    resumed = {(row["scene"], row["variant"]) for row in rows if row.get("build", {}).get("resumed")}
    digits = {column.title: column.digits for column in COLUMNS}
    values, differences = [], []
    for (scene, variant), runs in sorted(groups.items(), key=lambda item: (item[0][0], variants.index(item[0][1]))):
        value: dict[str, object] = {"scene": scene, "variant": variant + ("*" if (scene, variant) in resumed else "")}
        difference: dict[str, object] = {"scene": scene, "variant": variant}
        for title in runs[0]:
            mean, width = _mean_and_spread(runs, title)
            value[title] = f"{mean:.{digits[title]}f}" + (f" ±{width / 2:.{digits[title]}f}" if len(runs) > 1 else "")
            base = groups.get((scene, variants[0]))
            if base is not None and title in base[0]:
                base_mean, base_width = _mean_and_spread(base, title)
                text = f"{mean - base_mean:+.{digits[title]}f}"
                difference[title] = f"({text})" if len(runs) > 1 and abs(mean - base_mean) < 2 * max(width, base_width) else text
        values.append(value)
        if variant != variants[0] and (scene, variants[0]) in groups:
            differences.append(difference)
    columns = ["scene", "variant", *(column.title for column in COLUMNS if any(column.title in value for value in values))]
    parts = [markdown_table(values, columns)]
    if resumed:
        parts.append("\\* was killed and went on: its time is of all runs together, some work was done twice.")
    if differences:
        parts += [f"Against {variants[0]}:", markdown_table(differences, columns)]
    return "\n\n".join(parts)


def _mean_and_spread(runs: list[dict[str, float]], title: str) -> tuple[float, float]:
    found = [run[title] for run in runs if title in run]
    return float(np.mean(found)), max(found) - min(found)


def progress_of(rows: list[dict], out: Path) -> dict[str, dict[str, list[dict]]]:
    """By scene and variant, of seed 0: what the build told on the way."""
    progress: dict[str, dict[str, list[dict]]] = {}
    for row in rows:
        events = read_events(out / row["scene"] / row["variant"] / "seed_0" / "progress.jsonl")
        if row["seed"] == 0 and events:
            progress.setdefault(row["scene"], {})[row["variant"]] = events
    return progress


def write_reached(folder: Path, rows: list[dict]) -> None:
    """reached_SCENE.svg: the main figures in decibels of each build of seed 0 over its minutes of processor time."""
    folder.mkdir(parents=True, exist_ok=True)
    for scene in dict.fromkeys(row["scene"] for row in rows):
        found = [main_figures(row) for row in rows if row["scene"] == scene and row["seed"] == 0]
        found = sorted((figures for figures in found if "CPU s" in figures), key=lambda figures: figures["CPU s"])
        titles = [title for title in REACHED if all(title in figures for figures in found)]
        curves = [Curve(title, [(figures["CPU s"] / 60, figures[title]) for figures in found]) for title in titles]
        if curves and found:
            (folder / f"reached_{scene}.svg").write_text(linear_svg(curves, scene, "processor minutes", "dB"))


def commit() -> str | None:
    """Short name of the checkout's commit, + where files differ from it; None outside a checkout."""
    command = ["git", "describe", "--always", "--dirty=+", "--exclude=*"]
    done = subprocess.run(command, cwd=Path(__file__).parent, capture_output=True, text=True)
    return done.stdout.strip() if done.returncode == 0 else None


if __name__ == "__main__":
    main(sys.argv[1:])
