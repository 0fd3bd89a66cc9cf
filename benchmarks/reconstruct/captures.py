"""What builds make of captures that were taken otherwise: through a lens that bends, in several sizes, exposed differently, or balanced, with grain, masks and cameras
that are a little off, on a turntable.

    python -m benchmarks captures OUT --scenes SCENE ... [--ways lens sizes exposures white grain masks cutouts poses turned] [--preset draft] [--spp 32] [--every 1] [--side 256]

All but the last change a scene's photographs (scenes/retake_photographs.py) and are held against a build of the scene as it is. For the last, both the
plain and the turned capture are drawn by us, from the scene's mesh and materials under its light (draw_scene), for nobody photographed the scene so.
A row stands in OUT/rows.jsonl as soon as it is finished and is not made again; a build that was killed goes on. OUT/table.md is the table, with how far
each row is from its plain one; the wanted 0.3 dB of views and 0.5 dB of relit pictures are marked where they are missed.
"""

import argparse
import json
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.builds.build_process import built_asset, cli_command
from benchmarks.measures.report_table import markdown_table
from benchmarks.reconstruct.ablate import commit, read_rows
from benchmarks.reconstruct.build import evaluate
from benchmarks.reconstruct.draw_scene import Drawing, draw_photographs, draw_scene, drawn_cameras
from benchmarks.scenes.bench_scene import open_scene, read_true_mesh
from benchmarks.scenes.retake_photographs import WAYS, retake_photographs
from drgs.reconstruct.presets import PRESETS
from drgs.render.intersect.trace_rays import build_tracer

PLAIN, DRAWN, TURNED = "plain", "drawn", "turned"
MOST_VIEWS_LOST, MOST_RELIT_LOST = 0.3, 0.5
"""[dB] that a capture taken otherwise may be below its plain one."""


def main(arguments: list[str]) -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks captures", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path)
    parser.add_argument("--scenes", nargs="+", type=Path, required=True)
    parser.add_argument("--ways", nargs="+", choices=[*WAYS, TURNED], default=[*WAYS, TURNED])
    parser.add_argument("--preset", choices=list(PRESETS), default="draft")
    parser.add_argument("--spp", type=int, default=32, help="rays a pixel of the scored pictures")
    parser.add_argument(
        "--draw-spp", type=int, default=64, help="rays a pixel of the photographs that are drawn; test pictures have twice as many"
    )
    parser.add_argument("--every", type=int, default=1, help="of the scene's views, draw one in so many")
    parser.add_argument("--side", type=int, help="of the pictures that are drawn [pixels]")
    parser.add_argument("--device", choices=["auto", "cpu", "cuda"], default="auto")
    given = parser.parse_args(arguments)
    for scene in given.scenes:
        open_scene(scene)  # complain before the first build
    given.out.mkdir(parents=True, exist_ok=True)
    drawing = Drawing(given.draw_spp, every=given.every, side=given.side)
    wanted = [*([PLAIN] if set(given.ways) & set(WAYS) else []), *(way for way in WAYS if way in given.ways)]
    wanted += [DRAWN, TURNED] if TURNED in given.ways else []
    for scene in given.scenes:
        for way in wanted:
            row(scene, way, given.out, given.preset, given.spp, given.device, drawing)
    table = main_table(read_rows(given.out))
    (given.out / "table.md").write_text(table + "\n")
    print(table, file=sys.stderr)


def row(scene: Path, way: str, out: Path, preset: str, samples_per_pixel: int, device: str, drawing: Drawing) -> dict:
    """Its figures, kept or made.

    Raises:
        ValueError: it was kept with other settings.
    """
    key = {"scene": scene.name, "way": way}
    asked = {"preset": preset, "spp": samples_per_pixel}
    asked |= {"drawing": vars(drawing)} if way in (DRAWN, TURNED) else {}
    kept = next((kept for kept in read_rows(out) if all(kept[name] == value for name, value in key.items())), None)
    if kept is not None:
        if {name: kept.get(name) for name in asked} != asked:
            raise ValueError(f"{out} holds a row of {scene.name}, {way}, made otherwise than {json.dumps(asked)}; choose another folder")
        return kept
    work = out / scene.name / way
    capture, truth = capture_of(scene, way, out, drawing)
    command = cli_command(capture, work / "asset", preset, device=device)
    command += ["--light", "camera" if way == TURNED else "object"]
    build = built_asset(command, work, key | asked)
    figures = evaluate(work / "asset", truth, work / "renders", samples_per_pixel, device)
    made = key | asked | {"commit": commit(), "build": build, "figures": figures}
    with (out / "rows.jsonl").open("a") as file:
        file.write(json.dumps(made) + "\n")
    return made


def capture_of(scene: Path, way: str, out: Path, drawing: Drawing) -> tuple[Path, Path]:
    """What is built and what scores it; made in out/SCENE/captures unless it is there."""
    if way == PLAIN:
        return scene, truth_of(scene, out)
    capture = out / scene.name / "captures" / way
    if not capture.exists():
        making = capture.with_name(f"{way}.making")
        shutil.rmtree(making, ignore_errors=True)
        if way == DRAWN:
            opened = open_scene(scene)
            light, new_light = (scene / "env" / f"{name}.exr" for name in (opened.training_light, opened.new_lights[0]))
            draw_scene(scene, making, None, light, new_light, drawing)
        elif way == TURNED:
            plain, _ = capture_of(scene, DRAWN, out, drawing)
            turn_light(scene, plain, making, replace(drawing, turned=True))
        else:
            retake_photographs(scene, making, way)  # type: ignore[arg-type]  # one of WAYS
        making.rename(capture)
    return capture, (capture if way in (DRAWN, TURNED) else truth_of(scene, out))


def truth_of(scene: Path, out: Path) -> Path:
    """A folder that scores builds of the scene as it is and under new lights, not deformed: that asks nothing more of a capture, and takes as long."""
    folder = out / scene.name / "truth"
    folder.mkdir(parents=True, exist_ok=True)
    for name in ("transforms_test.json", "test", "relight", "env", "scene.json"):
        if (scene / name).exists() and not (folder / name).exists():
            (folder / name).symlink_to((scene / name).resolve())
    return folder


def turn_light(scene: Path, plain: Path, out: Path, drawing: Drawing) -> None:
    """The drawn capture `plain` of the scene once more, with light that stands still with the camera: all but photographs and test views is the same."""
    shutil.copytree(plain, out)
    opened = open_scene(scene)
    tracer, (photographs, tests) = build_tracer(read_true_mesh(opened)), drawn_cameras(opened, drawing)
    draw_photographs(tracer, photographs, tests, scene / "env" / f"{opened.training_light}.exr", out, drawing)


def main_table(rows: list[dict]) -> str:
    """Markdown: figures, and differences to the plain row of the same kind."""
    found = {(made["scene"], made["way"]): _figures(made) for made in rows}
    lines = []
    for (scene, way), figures in found.items():
        line: dict[str, object] = {"scene": scene, "taken": way}
        line |= {"views dB": f"{figures['views']:.2f}", "SSIM": f"{figures['ssim']:.3f}", "normals °": f"{figures['normals']:.2f}"}
        line |= {"relit, scaled dB": ", ".join(f"{value:.2f}" for value in figures["relit"])}
        line |= {
            "metallic": f"{figures['metallic']:.3f}",
            "roughness": f"{figures['roughness']:.3f}",
            "light dB": f"{figures['light']:.1f}",
        }
        plain = found.get((scene, DRAWN if way == TURNED else PLAIN))
        if plain is not None and plain is not figures and way != DRAWN:
            lost = (plain["views"] - figures["views"], float(np.mean(plain["relit"]) - np.mean(figures["relit"])))
            for title, value, most in zip(("views against plain", "relit"), lost, (MOST_VIEWS_LOST, MOST_RELIT_LOST), strict=True):
                line[title] = f"{-value:+.2f}" + (" (missed)" if value > most else "")
        lines.append(line)
    titles = ("views dB", "SSIM", "normals °", "relit, scaled dB", "metallic", "roughness", "light dB", "views against plain", "relit")
    return markdown_table(lines, ["scene", "taken", *titles])


def _figures(made: dict) -> dict:
    figures = made["figures"]
    maps = figures["maps"]
    return {
        "views": figures["views"]["psnr"],
        "ssim": figures["views"]["ssim"],
        "normals": maps["normal_mae"],
        "relit": [light["psnr_scaled"] for _, light in sorted(figures["relight"].items())],
        "metallic": maps["metallic_rmse"],
        "roughness": maps["roughness_rmse"],
        "light": maps["env_psnr"],
    }
