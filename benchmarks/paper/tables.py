"""The cells of the tables: every way bound to every scene, drawn at rest and deformed, and scored against the truth.

In: scenes with truth and what is asked. Out: documents with figures by way, and pictures in OUT/pictures/SCENE/WAY/. A scene's asset and photographs
are read when the first cell wants them.
"""

import hashlib
import json
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
import safetensors.torch
import torch
from PIL import Image
from torch import Tensor

from benchmarks.measures.lpips import LpipsNetwork
from benchmarks.measures.peak_memory import measured
from benchmarks.paper.cells import CellFolder, write_tensors
from benchmarks.paper.fields import at_rest, field_of_map
from benchmarks.paper.harmonics import BakeSettings
from benchmarks.paper.variant import AbstractVariant, Draw, Subject
from benchmarks.scenes.bench_scene import BenchScene, read_light, read_rgba
from drgs.evaluate.metrics import picture_figures, truth_folders
from drgs.reconstruct.capture.load_views import load_views
from drgs.scene.asset import load_asset
from drgs.scene.camera import Camera


@dataclass(frozen=True)
class EvidenceSettings:
    """How much is spent on each cell."""

    samples_per_pixel: int = 256
    """Of pictures whose rays are traced."""
    budget: int = 60_000
    """Gaussians of ways that put them on faces of their own."""
    bake: BakeSettings = field(default_factory=BakeSettings)
    test_every: int = 1
    """Only every so many-th test view is drawn at rest."""
    dance_every: int = 1
    """Only every so many-th frame of a dance is drawn; a divisor of dances.HELD_EVERY."""


@dataclass(frozen=True, eq=False)
class SceneEvidence:
    """One scene: its truth, its asset, and where its cells are."""

    scene: BenchScene
    asset_path: Path
    cells: CellFolder
    settings: EvidenceSettings
    lpips: LpipsNetwork | None = None
    """None: not asked for. What is drawn does not depend on it."""

    @cached_property
    def subject(self) -> Subject:
        """Read once, when the first cell is to be made."""
        settings = self.settings
        views = load_views(self.scene.folder)
        return Subject(load_asset(self.asset_path), views, settings.budget, settings.bake, settings.samples_per_pixel)

    @cached_property
    def asked(self) -> dict:
        """What every cell of this scene depends on."""
        asset = hashlib.sha256((self.asset_path / "asset.json").read_bytes()).hexdigest()[:16]
        return {"scene": self.scene.name, "asset": asset, **asdict(self.settings)}

    @cached_property
    def deformations(self) -> dict[str, dict]:
        """Maps by name."""
        return json.loads((self.scene.folder / "scene.json").read_text()).get("deform", {})

    def truths(self) -> list[tuple[Path, bool]]:
        """Folders of deformed truth, relative to the scene, and whether each is under a new light."""
        found = truth_folders(self.scene.folder, "deform/*/*")
        return [(folder.relative_to(self.scene.folder), folder.name != self.scene.training_light) for folder in found]

    def pictures(self, variant: AbstractVariant) -> Path:
        """Folder of a way's pictures."""
        return self.cells.folder / "pictures" / self.scene.name / variant.name


def bound_tensors(evidence: SceneEvidence, variant: AbstractVariant) -> tuple[dict, dict[str, Tensor] | None]:
    """The cell of binding and baking; and the tensors, None while nobody has read them."""
    name = f"{evidence.scene.name}-{variant.name}-bind"
    path = evidence.cells.folder / "bound" / f"{name}.safetensors"
    made: dict[str, Tensor] | None = None

    def make() -> dict:
        nonlocal made
        subject = evidence.subject  # reading it is not the step's cost
        with torch.no_grad():
            found, cost = measured(lambda: variant.bind(subject))
        write_tensors(path, found)
        made = found
        count = len(found["centers"]) if "centers" in found else 0
        return {"cost": asdict(cost), "gaussians": count}

    return evidence.cells.cell(name, evidence.asked, make, [path]), made


def read_bound(evidence: SceneEvidence, variant: AbstractVariant) -> dict[str, Tensor]:
    """What binding made."""
    _, made = bound_tensors(evidence, variant)
    path = evidence.cells.folder / "bound" / f"{evidence.scene.name}-{variant.name}-bind.safetensors"
    return made if made is not None else safetensors.torch.load_file(path)


def static_cell(evidence: SceneEvidence, variant: AbstractVariant) -> dict:
    """Test views under the light of the photographs: {"figures": {"psnr", "ssim", ...}, "cost"}."""

    def make() -> dict:
        bound, subject = read_bound(evidence, variant), evidence.subject
        cameras = drawn_cameras(evidence, Path("test"))

        def run() -> dict:
            drawn = variant.pose(subject, bound, at_rest, None)
            return picture_figures(draw_and_read(drawn, cameras, evidence.pictures(variant) / "test", evidence.scene.folder / "test"))

        with torch.no_grad():
            figures, cost = measured(run)
        return {"figures": figures, "cost": asdict(cost), "seconds_a_picture": round(cost.seconds / len(cameras), 3)}

    return evidence.cells.cell(f"{evidence.scene.name}-{variant.name}-static", evidence.asked, make)


def deformed_cell(evidence: SceneEvidence, variant: AbstractVariant) -> dict:
    """The deformed truth's views, under the light of the photographs and a new one: {"figures": {"map/light": {...}}, "cost"}."""

    def make() -> dict:
        bound, subject, scene = read_bound(evidence, variant), evidence.subject, evidence.scene
        count = 0

        def run() -> dict:
            nonlocal count
            figures = {}
            for folder, new_light in evidence.truths():
                moved_by = field_of_map(evidence.deformations[folder.parent.name])
                drawn = variant.pose(subject, bound, moved_by, read_light(scene, folder.name) if new_light else None)
                cameras = drawn_cameras(evidence, folder)
                pairs = draw_and_read(drawn, cameras, evidence.pictures(variant) / folder, scene.folder / folder)
                figures[f"{folder.parent.name}/{folder.name}"] = picture_figures(pairs, new_light) | {"new_light": new_light}
                count += len(cameras)
            return figures

        with torch.no_grad():
            figures, cost = measured(run)
        return {"figures": figures, "cost": asdict(cost), "seconds_a_picture": round(cost.seconds / max(count, 1), 3)}

    return evidence.cells.cell(f"{evidence.scene.name}-{variant.name}-deformed", evidence.asked, make)


def drawn_cameras(evidence: SceneEvidence, folder: Path) -> list[Camera]:
    """Test cameras whose pictures are compared with the scene's folder of truth."""
    scene = evidence.scene
    if folder == Path("test"):
        return list(scene.cameras[:: evidence.settings.test_every])
    return [camera for camera in scene.cameras if (scene.folder / folder / f"{camera.name}.png").is_file()]


def draw_and_read(drawn: Draw, cameras: list[Camera], out: Path, truth: Path) -> list[tuple[np.ndarray, np.ndarray]]:
    """Pictures as their 8-bit files hold them, each with its truth, (height, width, 4)."""
    out.mkdir(parents=True, exist_ok=True)
    pairs = []
    for camera in cameras:
        path = out / f"{camera.name}.png"
        write_picture(drawn(camera), path)
        pairs.append((read_rgba(path), read_rgba(truth / f"{camera.name}.png")))
    return pairs


def write_picture(rgba: Tensor, path: Path) -> None:
    """8-bit RGBA, straight alpha, sRGB, of (height, width, 4) in 0..1."""
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray((rgba.clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy()).save(path)
