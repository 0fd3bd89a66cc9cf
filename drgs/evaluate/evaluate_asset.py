"""Render an asset's test views, under every light and deformation the capture has truth for, and score them.

In: an asset and a capture with transforms_test.json. Out: the figures of drgs/evaluate/metrics.py. It does by itself what `drgs render` and
`drgs export --format env` do by hand, with the same steps and defaults, so that both ways end in the same figures.
"""

import json
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from drgs.convert.export_asset import export_asset
from drgs.deform.pose_scene import pose_scene
from drgs.evaluate.metrics import score_renders, truth_folders
from drgs.maths.constants import STILL_BOUNCES
from drgs.reconstruct.capture.load_views import load_cameras
from drgs.render.records import RenderSettings
from drgs.render.render_cameras import render_cameras
from drgs.scene.asset import Asset, light_from_world
from drgs.scene.camera import Camera
from drgs.scene.edits import Edit, parse_edits


@dataclass(frozen=True)
class EvaluationSettings:
    samples_per_pixel: int = 256
    bounces: int = STILL_BOUNCES
    seed: int = 0


def evaluate_asset(
    asset: Asset,
    capture: Path,
    out: Path | None = None,
    settings: EvaluationSettings | None = None,
    done: Callable[[str], None] = lambda name: None,
) -> dict:
    """Figures of drgs.evaluate.metrics.score_renders.

    Args:
        out: keeps the renders in this folder, which may be given to another scorer; by default they are thrown away.
        done: called with the name of each finished picture.

    Raises:
        ValueError: the capture has no test views.
    """
    settings = settings or EvaluationSettings()
    cameras_path = capture / "transforms_test.json"
    if not cameras_path.exists():
        raise ValueError(f"{capture} has no transforms_test.json; eval expects a capture with test cameras and pictures")
    if "up" in asset.provenance:
        raise ValueError(
            f"this asset's world is {capture}'s turned (up {asset.provenance['up']}), and its test cameras and lights are those of the unturned one; "
            "evaluate a build without --up"
        )
    if "box" in asset.provenance:
        raise ValueError(
            f"this asset holds what of {capture} lies in the box {asset.provenance['box']}, and its test pictures show all of it; evaluate a build "
            "without --box"
        )
    with tempfile.TemporaryDirectory() as temporary:
        renders = out or Path(temporary)
        _render_all(asset, capture, renders, load_cameras(cameras_path), settings, done)
        return score_renders(capture, renders)


def _render_all(
    asset: Asset, capture: Path, renders: Path, cameras: list[Camera], settings: EvaluationSettings, done: Callable[[str], None]
) -> None:
    """Write the test, relight and deform folders and the recovered light."""
    render_settings = RenderSettings(samples_per_pixel=settings.samples_per_pixel, bounces=settings.bounces, seed=settings.seed)

    def render(folder: Path, edits: list[Edit], aov: bool = False) -> None:
        """The cameras that have a truth picture in the capture's folder of the same name, under the light of the photographs unless edits give another."""
        wanted = [camera for camera in cameras if (capture / folder / f"{camera.name}.png").exists()]
        scene = pose_scene(asset, edits, capture)
        turns = light_from_world(asset, edits)
        render_cameras(scene, wanted, renders / folder, render_settings, aov, lambda name: done(f"{folder}/{name}"), turns)

    render(Path("test"), [], aov=True)
    export_asset(asset, renders / "env.exr", "env")
    for truth in truth_folders(capture, "relight/*"):
        render(truth.relative_to(capture), _light(capture, truth.name))
    facts_path = capture / "scene.json"
    facts = json.loads(facts_path.read_text()) if facts_path.exists() else {}
    for truth in truth_folders(capture, "deform/*/*"):
        bent = parse_edits([{"op": "deform", "map": facts["deform"][truth.parent.name]}])
        # Under the training light, which the asset has recovered, the file's true one would be a hint.
        light = [] if truth.name == facts["train_env"] else _light(capture, truth.name)
        render(truth.relative_to(capture), [*bent, *light])


def _light(capture: Path, name: str) -> list[Edit]:
    return parse_edits([{"op": "environment", "file": str((capture / "env" / f"{name}.exr").resolve())}])
