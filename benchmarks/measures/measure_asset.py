"""One asset on one scene: every part of the protocol, those left out named with what is missing.

Parts share what is costly: test views are rendered once, and kept in the work folder for the next call.
"""

import json
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.measures.error_regions import TestView, region_figures
from benchmarks.measures.light_energy import light_figures
from benchmarks.measures.mesh_accuracy import COUNT, mesh_figures
from benchmarks.measures.outline_distance import mesh_coverages, outline_figures, surfel_coverages
from benchmarks.measures.swap_parts import Subject, swap_rows
from benchmarks.scenes.bench_scene import (
    BenchScene,
    has_true_maps,
    has_true_materials,
    has_true_mesh,
    read_light,
    read_rgba,
    read_true_maps,
    read_true_mesh,
    training_cameras,
)
from drgs.deform.pose_scene import pose_scene
from drgs.evaluate.evaluate_asset import EvaluationSettings, evaluate_asset
from drgs.evaluate.metrics import picture_figures
from drgs.maths.constants import STILL_BOUNCES
from drgs.reconstruct.capture.load_views import load_views
from drgs.reconstruct.capture.visual_hull import visual_hull
from drgs.render.render_cameras import render_cameras
from drgs.render.render_frame import RenderSettings
from drgs.scene.asset import Asset
from drgs.scene.posed_scene import PRIMARY_SURFACES


@dataclass(frozen=True)
class QualitySettings:
    """How much is measured."""

    parts: tuple[str, ...] = ()
    """Of PARTS; empty: all."""
    samples_per_pixel: int = 256
    """Of the scored pictures."""
    views: int = 4
    """Test views of the parts that render pictures of their own."""
    swap_samples: int = 128
    """Rays a pixel of the pictures of swaps."""
    swap_bounces: int = STILL_BOUNCES
    mesh_samples: int = COUNT
    """Points on each surface whose distance from the other is measured."""


class Measurement:
    """One asset on one scene: what the parts share, each computed when it is first asked for. Final."""

    def __init__(self, scene: BenchScene, asset: Asset, work: Path, settings: QualitySettings) -> None:
        self.scene, self.asset, self.work, self.settings = scene, asset, work, settings
        self.posed = pose_scene(asset, [], scene.folder)
        self.few = evenly(scene.cameras, settings.views)

    def figures(self) -> dict:
        """drgs eval; its pictures are what the regions are of."""
        kept = self.work / "figures.json"
        if kept.is_file():
            return json.loads(kept.read_text())
        seconds: dict[str, float] = {}
        clock = time.perf_counter()

        def done(name: str) -> None:
            nonlocal clock
            folder, now = str(Path(name).parent), time.perf_counter()
            seconds[folder] = round(seconds.get(folder, 0.0) + now - clock, 2)
            clock = now

        settings = EvaluationSettings(samples_per_pixel=self.settings.samples_per_pixel)
        figures = evaluate_asset(self.asset, self.scene.folder, self.work / "renders", settings, done) | {"seconds": seconds}
        kept.write_text(json.dumps(figures))
        return figures

    def test_renders(self) -> Path:
        """The folder with the pictures of all test views."""
        folder = self.work / "renders" / "test"
        missing = [camera for camera in self.scene.cameras if not (folder / f"{camera.name}.png").is_file()]
        if missing:
            settings = RenderSettings(samples_per_pixel=self.settings.samples_per_pixel, bounces=STILL_BOUNCES)
            render_cameras(self.posed, missing, folder, settings)
        return folder

    def mesh(self) -> dict:
        if not has_true_mesh(self.scene):
            raise LeftOutError(f"{self.scene.name} has no gt_mesh.ply")
        return mesh_figures(read_true_mesh(self.scene), self.asset.mesh, training_cameras(self.scene), self.settings.mesh_samples)

    def outlines(self) -> dict:
        masks = [read_rgba(self.scene.folder / "test" / f"{camera.name}.png")[..., 3] for camera in self.scene.cameras]
        found = {"mesh": mesh_coverages(self.asset.mesh, self.scene.cameras)}
        if self.posed.surfels is not None:
            found["gaussians"] = surfel_coverages(self.posed.surfels, self.scene.cameras)
        return {name: outline_figures(list(zip(coverages, masks, strict=True))) for name, coverages in found.items()}

    def regions(self) -> dict:
        if not has_true_maps(self.scene):
            raise LeftOutError(f"{self.scene.name} has no true maps (test/*_aov.npz)")
        hull = visual_hull(load_views(self.scene.folder))
        if hull is None:
            raise LeftOutError(f"the masks of {self.scene.name} have no common shape")
        renders = self.test_renders()
        views = [
            TestView(
                camera,
                read_rgba(renders / f"{camera.name}.png"),
                read_rgba(self.scene.folder / "test" / f"{camera.name}.png"),
                read_true_maps(self.scene, camera),
            )
            for camera in self.scene.cameras
        ]
        return region_figures(views, hull)

    def primary(self) -> dict:
        if self.posed.surfels is None:
            raise LeftOutError("the asset has no Gaussians")
        truth = self.scene.folder / "test"
        psnr = {}
        for name in PRIMARY_SURFACES:
            settings = RenderSettings(samples_per_pixel=self.settings.samples_per_pixel, bounces=STILL_BOUNCES, primary=name)
            folder = self.work / "renders" / f"{name}_primary"
            render_cameras(self.posed, [c for c in self.few if not (folder / f"{c.name}.png").is_file()], folder, settings)
            pairs = [(read_rgba(folder / f"{c.name}.png"), read_rgba(truth / f"{c.name}.png")) for c in self.few]
            psnr[name] = picture_figures(pairs)["psnr"]
        return {"views": len(self.few), "psnr": psnr, "gaussians_minus_mesh": psnr["gaussians"] - psnr["mesh"]}

    def light(self) -> dict:
        if self.scene.training_light is None:
            raise LeftOutError(f"{self.scene.name} has no true light")
        return light_figures(self.asset.environment, read_light(self.scene, self.scene.training_light))

    def swaps(self) -> dict:
        scene = self.scene
        if not has_true_materials(scene) or scene.training_light is None or not scene.new_lights:
            raise LeftOutError(f"{scene.name} lacks a true mesh, its materials, the true light or another light")
        new = scene.new_lights[0]
        folder = scene.folder / "relight" / new
        cameras = evenly(tuple(camera for camera in scene.cameras if (folder / f"{camera.name}.png").is_file()), self.settings.views)
        lights = {
            column: (read_light(scene, name), [read_rgba(truth / f"{camera.name}.png") for camera in cameras])
            for column, name, truth in (("training", scene.training_light, scene.folder / "test"), ("new", new, folder))
        }
        subject = Subject(self.asset.mesh, read_true_mesh(scene))
        samples, bounces = self.settings.swap_samples, self.settings.swap_bounces

        def done(name: str) -> None:
            print(f"quality: {scene.name}: swaps: {name}", file=sys.stderr)

        rows = swap_rows(subject, cameras, lights, self.asset.environment, samples, bounces, done)
        return {"views": len(cameras), "new_light": new, "samples": samples, "bounces": bounces, "rows": rows}


class LeftOutError(Exception):
    """A part that this scene has no truth for; the sentence says what is missing."""


PARTS: dict[str, Callable[[Measurement], dict]] = {
    "figures": Measurement.figures,
    "mesh": Measurement.mesh,
    "outlines": Measurement.outlines,
    "regions": Measurement.regions,
    "primary": Measurement.primary,
    "light": Measurement.light,
    "swaps": Measurement.swaps,
}


def measure_asset(scene: BenchScene, asset: Asset, work: Path, settings: QualitySettings) -> dict:
    """{"scene", "asset", part: figures, ..., "seconds": {part: seconds}, "left_out": {part: why}}.

    Args:
        work: keeps the pictures; those of another asset in it are thrown away.
    """
    work.mkdir(parents=True, exist_ok=True)
    document: dict = {"scene": scene.name, "asset": asset_facts(asset)}
    forget_other_pictures(work, asset, settings)
    measurement = Measurement(scene, asset, work, settings)
    seconds: dict[str, float] = {}
    left_out: dict[str, str] = {}
    for name in (name for name in PARTS if not settings.parts or name in settings.parts):  # in this order: later parts use earlier pictures
        started = time.perf_counter()
        try:
            document[name] = PARTS[name](measurement)
        except LeftOutError as error:
            left_out[name] = str(error)
        seconds[name] = round(time.perf_counter() - started, 2)
        print(f"quality: {scene.name}: {name} took {seconds[name]} s", file=sys.stderr)
    return document | {"seconds": seconds, "left_out": left_out}


def asset_facts(asset: Asset) -> dict:
    keys = ("preset", "binding", "seed", "seconds")
    facts = {key: asset.provenance[key] for key in keys if key in asset.provenance}
    surfels = 0 if asset.gaussians is None else len(asset.gaussians.centers)
    return facts | {"surfels": surfels, "vertices": len(asset.mesh.vertices), "faces": len(asset.mesh.faces)}


def forget_other_pictures(work: Path, asset: Asset, settings: QualitySettings) -> None:
    """Pictures and figures in `work` are used again only if they are of this asset, with as many rays."""
    kept, key = work / "pictures_of.json", pictures_key(asset, settings.samples_per_pixel)
    if kept.is_file() and kept.read_text() == key:
        return
    (work / "figures.json").unlink(missing_ok=True)
    for picture in (work / "renders").rglob("*.png"):
        picture.unlink()
    kept.write_text(key)


def pictures_key(asset: Asset, samples: int) -> str:
    """Differs where pictures of the asset may."""
    sums = {name: float(getattr(asset.mesh, name).double().abs().sum()) for name in ("vertices", "albedo", "roughness", "metallic")}
    sums["light"] = float(asset.environment.radiance.double().sum())
    if asset.gaussians is not None:
        sums["gaussians"] = float(asset.gaussians.centers.double().abs().sum())
    return json.dumps({"samples": samples} | sums)


def evenly(items: tuple, count: int) -> tuple:
    """`count` of the items, evenly spread; all where there are fewer."""
    chosen = np.unique(np.linspace(0, len(items) - 1, min(count, len(items))).round().astype(int))
    return tuple(items[index] for index in chosen)
