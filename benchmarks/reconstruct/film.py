"""What `drgs build` makes of a film alone: no poses, no masks; the film is drawn by an independent renderer, so all is known.

    python -m benchmarks film OUT --scenes SCENE ... [--tables print wood] [--preset draft] [--frames 64] [--spp 16] [--size 640 480] [--json]

Mitsuba draws each scene's true object standing on a textured table under the scene's light, along a path around it (scenes/draw_film.py). The MP4 is
all that the build is given; what came of it is held against the truth (measures/score_film.py says how). A row stands in OUT/rows.jsonl as soon as it
is finished and is not made again; a film that is drawn is not drawn again, and a build that was killed goes on. OUT/table.md is the table, and
OUT/SCENE_TABLE.png shows frames, errors of outlines and the asset's own pictures. Needs Mitsuba (docs/performance.md).
"""

import argparse
import json
import shutil
import sys
from dataclasses import asdict
from pathlib import Path

from benchmarks.builds.build_process import built_asset, cli_command
from benchmarks.measures.report_table import markdown_table
from benchmarks.measures.score_film import score_film
from benchmarks.reconstruct.ablate import commit, read_rows
from benchmarks.scenes.bench_scene import BenchScene, open_scene, read_true_mesh
from benchmarks.scenes.draw_film import TABLES, FilmDrawing, check_filmable, draw_film
from drgs.reconstruct.presets import PRESETS

RENDER_RAYS = 64
"""A pixel of the asset's own pictures."""


def main(arguments: list[str]) -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks film", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path)
    parser.add_argument("--scenes", nargs="+", type=Path, required=True)
    parser.add_argument("--tables", nargs="+", choices=TABLES, default=["print", "wood"])
    parser.add_argument("--preset", choices=list(PRESETS), default="draft")
    parser.add_argument("--frames", type=int, default=FilmDrawing.frames)
    parser.add_argument("--spp", type=int, default=FilmDrawing.samples, help="rays a pixel of the film")
    parser.add_argument("--size", nargs=2, type=int, default=[FilmDrawing.width, FilmDrawing.height], metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--json", action="store_true", help="the rows on one line")
    given = parser.parse_args(arguments)
    if any(side % 2 for side in given.size):
        raise ValueError(f"--size {given.size[0]} {given.size[1]}: expected even numbers, as films have")
    scenes = [open_scene(folder) for folder in given.scenes]
    for scene in scenes:
        check_filmable(scene)  # complain before the first film
    given.out.mkdir(parents=True, exist_ok=True)
    rows, failures = [], []
    for scene in scenes:
        for table in given.tables:
            drawing = FilmDrawing(table, given.frames, given.spp, *given.size)
            try:
                rows.append(row(scene, drawing, given.out, given.preset))
            except BuildFailedError as error:
                failures.append({"scene": scene.folder.name, "table": table, "failed": str(error)})
    text = main_table(read_rows(given.out), failures)
    (given.out / "table.md").write_text(text + "\n")
    print(text, file=sys.stderr)
    print(json.dumps(rows + failures, indent=None if given.json else 1))


class BuildFailedError(Exception):
    """Of the film no asset could be made, which is a finding; it is tried again by the next run."""


def row(scene: BenchScene, drawing: FilmDrawing, out: Path, preset: str) -> dict:
    """Its figures, kept or made.

    Raises:
        BuildFailedError: the build came to no end.
        ValueError: the row was kept with other settings, or the film cannot be drawn.
    """
    key = {"scene": scene.folder.name, "table": drawing.table}
    asked = {"preset": preset, "drawing": asdict(drawing)}
    kept = next((kept for kept in read_rows(out) if all(kept[name] == value for name, value in key.items())), None)
    if kept is not None:
        if {name: kept.get(name) for name in asked} != asked:
            raise ValueError(
                f"{out} holds a row of {key['scene']}, {drawing.table}, made otherwise than {json.dumps(asked)}; choose another folder"
            )
        return kept
    name = f"{key['scene']}_{drawing.table}"
    film, work = drawn_film(scene, drawing, out / name / "film"), out / name / f"build_{preset}"
    try:
        build = built_asset(cli_command(film / "film.mp4", work / "asset", preset), work, key | asked)
    except ValueError as error:
        raise BuildFailedError(str(error)) from error
    figures = score_film(work / "asset", film, read_true_mesh(scene), work / "renders", RENDER_RAYS, out / f"{name}.png")
    made = key | asked | {"commit": commit(), "build": build, "figures": figures}
    with (out / "rows.jsonl").open("a") as file:
        file.write(json.dumps(made) + "\n")
    return made


def drawn_film(scene: BenchScene, drawing: FilmDrawing, folder: Path) -> Path:
    """The folder, drawn unless it is there.

    Raises:
        ValueError: it is there, drawn otherwise.
    """
    identity = {"scene": scene.folder.name} | asdict(drawing)
    if folder.exists():
        kept = json.loads((folder / "drawing.json").read_text())
        if kept != identity:
            raise ValueError(f"{folder} was drawn by {json.dumps(kept)}, expected {json.dumps(identity)}; choose another folder")
        return folder
    drawing_here = folder.with_name(f"{folder.name}.drawing")
    shutil.rmtree(drawing_here, ignore_errors=True)
    drawing_here.mkdir(parents=True)
    draw_film(scene, drawing_here, drawing)
    (drawing_here / "drawing.json").write_text(json.dumps(identity))
    drawing_here.rename(folder)
    return folder


def main_table(rows: list[dict], failures: list[dict]) -> str:
    """Markdown: a line a film; those of which no asset came are last."""
    lines: list[dict[str, object]] = []
    for made in rows:
        figures = made["figures"]
        poses, masks, mesh = figures["poses"], figures["masks"], figures["mesh"]
        by_cameras, refined = (f"{mesh[how]['built_to_true']:.2f} / {mesh[how]['true_to_built']:.2f}" for how in ("by_cameras", "refined"))
        lines.append(
            {
                "scene": made["scene"], "table": made["table"], "preset": made["preset"], "placed": f"{poses['placed']} of {poses['given']}",
                "angle °": poses["degrees_median"], "centre %": poses["distance_percent_median"],
                "masks IoU": masks["iou"], "missed %": masks["missed_percent"], "too much %": masks["extra_percent"],
                "mesh %": by_cameras, "mesh after ICP %": refined, "views dB": f"{figures['views']['psnr']:.2f}",
                "seconds": round(made["build"]["seconds"]), "processor s": round(made["build"]["cpu_seconds"]),
            }
        )  # fmt: skip
    lines += [{"scene": failure["scene"], "table": failure["table"], "placed": failure["failed"]} for failure in failures]
    columns = (
        "scene", "table", "preset", "placed", "angle °", "centre %", "masks IoU", "missed %", "too much %", "mesh %", "mesh after ICP %",
        "views dB", "seconds", "processor s",
    )  # fmt: skip
    return markdown_table(lines, list(columns))
