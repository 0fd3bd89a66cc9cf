"""The character photographed, and the figure of its dance: what is drawn beside what, and what is drawn again after a kill."""

import json
from argparse import Namespace
from dataclasses import replace
from pathlib import Path

import av
import numpy as np
import pytest
from PIL import Image

from benchmarks.paper import dances
from benchmarks.paper.cells import CellFolder
from benchmarks.paper.character import rigged_glb
from benchmarks.paper.character.dance import FPS
from benchmarks.paper.character.photograph import FILE, CaptureSettings, photograph
from benchmarks.paper.character.rigged_glb import CLIP
from benchmarks.paper.command import asset_of, scene_folder
from benchmarks.paper.figures import figure_cells
from benchmarks.paper.harmonics import BakeSettings
from benchmarks.paper.tables import EvidenceSettings, SceneEvidence
from benchmarks.paper.variants import VARIANTS
from benchmarks.scenes.bench_scene import open_scene
from drgs.convert.import_mesh import import_mesh
from drgs.reconstruct.capture.load_views import load_views
from drgs.reconstruct.geometry.face_surfels import surfels_on_faces_of
from drgs.scene.asset import save_asset
from drgs.scene.camera import Camera, opengl_from_camera
from drgs.scene.mesh import TriangleMesh
from drgs.scene.posed_scene import PosedScene

CELL = 0.028


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small capture of a coarse character, which dances for a quarter of a second."""
    folder = tmp_path_factory.mktemp("scenes") / "character"
    folder.mkdir()
    (folder / "of another run").touch()
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(rigged_glb, "DURATION", 6 / FPS)
        photograph(folder, CaptureSettings(side=48, samples=8, cell=CELL, views=3))
    return folder


@pytest.mark.slow
def test_the_capture_is_one_that_builds_read_and_holds_its_rig(scene: Path):
    views = load_views(scene, 48)
    assert len(views.cameras) == 3 and views.has_masks
    assert sorted(entry.name for entry in scene.parent.iterdir()) == ["character"], "nothing half made stays"
    assert not (scene / "of another run").exists()
    facts = json.loads((scene / "scene.json").read_text())
    assert facts["rig"] == {"file": FILE, "clip": CLIP, "light": facts["relight"][0], "renderer": "ours"}
    opened = open_scene(scene)
    assert opened.name == "character" and opened.new_lights == (facts["relight"][0],)
    first = opengl_from_camera(opened.cameras[0]).numpy()
    assert first[:3, 3] @ [0, -1, 0] > 3.5, "the first test camera looks into its face"
    alpha = np.asarray(Image.open(scene / "test" / "r_000.png"))[..., 3]
    assert 0.03 < (alpha > 128).mean() < 0.3 and not alpha[[0, -1]].any() and not alpha[:, [0, -1]].any()


@pytest.fixture(scope="module")
def evidence(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> SceneEvidence:
    """Of an asset that is the truth itself, under its own materials."""
    folder = tmp_path_factory.mktemp("evidence")
    save_asset(import_mesh(scene / FILE), folder / "asset")
    return SceneEvidence(open_scene(scene), folder / "asset", CellFolder(folder / "out", "command"), EvidenceSettings(samples_per_pixel=64))


@pytest.mark.slow
def test_a_true_asset_dances_as_the_truth_and_only_lost_frames_are_drawn_again(evidence: SceneEvidence, monkeypatch: pytest.MonkeyPatch):
    document = figure_cells(evidence, [], ["dance", "strip", "laws"])
    assert set(document) == {"dance"}, "what needs a deformed truth is left out"
    figures = document["dance"]["figures"]
    assert figures["vertices off the true surface, in per cent of its height, at rest"] < 1e-4
    assert figures["largest"] < 0.02, "an asset made of the rig follows it exactly, but for rounding"
    assert figures["PSNR, mean of all frames"] > 30 and figures["SSIM, mean of all frames"] > 0.9
    assert len(document["dance"]["psnr"]) == 6
    out = evidence.cells.folder
    with av.open(str(out / document["dance"]["film"])) as film:
        shown = [frame.to_ndarray(format="rgb24") for frame in film.decode(video=0)]
    assert len(shown) == 6, "a clip goes there, not back"
    assert "<svg" in (out / document["dance"]["curve"]).read_text()[:5]

    drawn = []
    real = dances.posed_pair

    def counted(shown: dances.Dance, kind: dances.Kind, place: int) -> tuple[PosedScene, PosedScene]:
        drawn.append((kind, place))
        return real(shown, kind, place)

    monkeypatch.setattr(dances, "posed_pair", counted)
    (out / "cells" / "character-figure-dance.json").unlink()  # killed while frames were drawn
    (out / "cells" / f"character-{CLIP}-004.json").unlink()
    (out / "pictures" / "character" / "dancing" / "truth" / "002.png").unlink()
    again = figure_cells(evidence, [], ["dance"])
    assert drawn == [("dancing", 2), ("dancing", 4)]
    assert again["dance"]["psnr"] == document["dance"]["psnr"]


@pytest.mark.slow
def test_other_ways_dance_with_the_skeleton_and_only_lost_ones_are_drawn_again(evidence: SceneEvidence, monkeypatch: pytest.MonkeyPatch):
    """In the picture each is where the truth is."""
    ways = [VARIANTS["sugar"], VARIANTS["gsp"], VARIANTS["ours_mesh"]]
    gaussians, binding = surfels_on_faces_of(evidence.subject.asset.mesh)
    few = replace(evidence.settings, budget=3000, bake=BakeSettings(rounds=0), dance_every=4)
    clothed = replace(evidence.subject.asset, gaussians=gaussians, binding=binding, primary="mesh")
    save_asset(clothed, evidence.asset_path.parent / "clothed")
    quick = SceneEvidence(evidence.scene, evidence.asset_path.parent / "clothed", evidence.cells, few)
    told = figure_cells(quick, ways, ["dance_ways"])["dance_ways"]
    assert [row["way"] for row in told["rows"]] == ["SuGaR", "GSP", "ours (M)"]
    assert float(told["rows"][-1]["PSNR"]) > max(float(row["PSNR"]) for row in told["rows"][:-1])
    facts = dances.rig_facts(quick)
    assert facts is not None
    shown = dances.Dance(quick, facts)
    for way in ("sugar", "gsp"):
        drawn, truth = (picture[..., 3] > 0.5 for picture in shown.read_pair("dancing", 0, way))
        # Limbs are three pixels wide here, and Gaussians reach a part of one farther.
        assert (drawn & truth).sum() > 0.7 * (drawn | truth).sum()
    monkeypatch.setattr(VARIANTS["gsp"], "pose", None)
    (quick.cells.folder / "cells" / "character-figure-dance_ways.json").unlink()  # killed while it was made
    shown.picture_path("dancing", "sugar", 0).unlink()
    assert figure_cells(quick, ways, ["dance_ways"])["dance_ways"]["rows"] == told["rows"]
    assert shown.picture_path("dancing", "sugar", 0).is_file()


@pytest.mark.slow
def test_who_took_the_photographs_draws_the_truth(evidence: SceneEvidence, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    asked = []

    def witness(mesh: TriangleMesh, light: np.ndarray, camera: Camera, samples: int, bounces: int, degrees: float) -> np.ndarray:
        asked.append((samples, degrees))
        return np.full((camera.height, camera.width, 4), 0.5)

    monkeypatch.setattr(dances, "mitsuba_picture", witness)
    facts = dances.rig_facts(evidence)
    assert facts is not None
    shown = dances.Dance(evidence, replace(facts, renderer="mitsuba"))
    _, truth = dances.posed_pair(shown, "dancing", 3)
    dances.draw_truth(shown, truth, 256, tmp_path / "003.png")
    assert asked == [(256, 180.0)] and np.asarray(Image.open(tmp_path / "003.png")).max() == 128


@pytest.mark.slow
def test_the_light_turns_once_and_the_truth_moves_with_the_clip(evidence: SceneEvidence):
    facts = dances.rig_facts(evidence)
    assert facts is not None
    shown = dances.Dance(evidence, facts)
    ours, truth = dances.posed_pair(shown, "dancing", 3)
    assert ours.environment_rotation_degrees == truth.environment_rotation_degrees == 180
    assert np.array_equal(ours.environment.radiance.numpy(), truth.environment.radiance.numpy())
    assert np.abs(ours.mesh.vertices.numpy() - truth.mesh.vertices.numpy()).max() < 1e-4
    assert np.abs(truth.mesh.vertices.numpy() - shown.true_mesh.vertices.numpy()).max() > 1e-3
    standing, _ = dances.posed_pair(shown, "standing", 3)
    assert standing.mesh.vertices is shown.evidence.subject.asset.mesh.vertices


def test_the_name_of_the_character_is_a_scene_that_is_made_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    made = []

    def draw(folder: Path, settings: CaptureSettings) -> None:
        made.append(folder)
        folder.mkdir(parents=True)
        (folder / "scene.json").write_text("{}")

    monkeypatch.setattr("benchmarks.paper.command.photograph", draw)
    cells, settings = CellFolder(tmp_path, "command"), CaptureSettings()
    with pytest.raises(ValueError, match="expected a finished capture of the character"):
        scene_folder(Path("character"), replace(cells, finished_only=True), settings)
    assert [scene_folder(Path("character"), cells, settings) for _ in range(2)] == 2 * [tmp_path / "scenes" / "character"]
    assert made == [tmp_path / "scenes" / "character"]
    assert scene_folder(tmp_path / "character", cells, settings) == tmp_path / "character", "a folder of that name is itself"


@pytest.mark.parametrize(
    ("name", "quick", "chosen", "preset"),
    [
        ("character", False, None, "fast"), ("bunny", False, None, "full"), ("character", True, None, "draft"), ("character", True, "full", "full"),
    ],
)  # fmt: skip
def test_the_character_is_built_fast_unless_told_otherwise(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, quick: bool, chosen: str | None, preset: str
):
    built = []
    monkeypatch.setattr("benchmarks.paper.command.built_asset", lambda command, work, what: built.append((work, what)))
    given = Namespace(assets=None, out=tmp_path, finished=False, quick=quick, preset=chosen, device="cpu")
    assert asset_of(given, tmp_path, name) == tmp_path / "assets" / name / "asset"
    assert built == [(tmp_path / "assets" / name, {"preset": preset, "seed": 0})]
