"""An asset whose own renders are the truth gets perfect figures: every light and deformation is rendered as the capture asks."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
import trimesh

from drgs.deform.pose_scene import pose_scene
from drgs.evaluate.evaluate_asset import EvaluationSettings, evaluate_asset
from drgs.exchange.exr import encode_environment
from drgs.reconstruct.capture.load_views import load_cameras
from drgs.render.records import RenderSettings
from drgs.render.render_cameras import render_cameras
from drgs.scene.asset import Asset
from drgs.scene.edits import parse_edits
from drgs.scene.environment import Environment
from drgs.scene.mesh import TriangleMesh, vertex_normals

SETTINGS = EvaluationSettings(samples_per_pixel=16)
TWIST = {"type": "twist", "rate": 1.0}


def box_asset() -> Asset:
    """A brown box under light that is brighter from +x."""
    box = trimesh.creation.box((1.2, 0.8, 0.9)).subdivide().subdivide()
    vertices, faces = torch.tensor(box.vertices, dtype=torch.float32), torch.tensor(box.faces, dtype=torch.int32)
    ones = torch.ones(len(vertices))
    mesh = TriangleMesh(
        vertices, faces, vertex_normals(vertices, faces), ones[:, None] * torch.tensor([0.5, 0.3, 0.1]), 0.5 * ones, 0 * ones
    )
    return Asset(None, mesh, None, sky(0.4, 1.2))


def sky(low: float, high: float) -> Environment:
    ramp = torch.linspace(low, high, 32)
    return Environment(torch.cat([ramp, ramp.flip(0)])[None, :, None].expand(32, 64, 3).contiguous())


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Truth that the asset itself rendered: a test view, one under another light, two deformed."""
    folder = tmp_path_factory.mktemp("capture")
    look_from_minus_y = [[1, 0, 0, 0], [0, 0, -1, -4], [0, 1, 0, 0], [0, 0, 0, 1]]
    frames = [{"file_path": "./test/r_000", "transform_matrix": look_from_minus_y}]
    (folder / "transforms_test.json").write_text(json.dumps({"camera_angle_x": 0.6, "w": 48, "h": 48, "frames": frames}))
    facts = {"name": "box", "train_env": "day", "relight": ["night"], "deform": {"twist": TWIST}}
    (folder / "scene.json").write_text(json.dumps(facts))
    (folder / "env").mkdir()
    (folder / "env" / "day.exr").write_bytes(encode_environment(sky(0.4, 1.2).radiance.numpy()))
    (folder / "env" / "night.exr").write_bytes(encode_environment(sky(0.05, 0.3).radiance.numpy()))
    night = {"op": "environment", "file": str(folder / "env" / "night.exr")}
    twist = {"op": "deform", "map": TWIST}
    asset, cameras = box_asset(), load_cameras(folder / "transforms_test.json")
    for part, edits in {"test": [], "relight/night": [night], "deform/twist/day": [twist], "deform/twist/night": [twist, night]}.items():
        render_cameras(
            pose_scene(asset, parse_edits(edits)), cameras, folder / part, RenderSettings(samples_per_pixel=SETTINGS.samples_per_pixel)
        )
    return folder


def test_an_asset_that_is_the_truth_scores_perfectly(capture: Path, tmp_path: Path):
    finished: list[str] = []
    figures = evaluate_asset(box_asset(), capture, tmp_path, SETTINGS, finished.append)
    parts = [figures["views"], figures["relight"]["night"], figures["deform"]["twist/day"], figures["deform"]["twist/night"]]
    assert [part["psnr"] for part in parts] == pytest.approx([120.0] * 4)
    assert figures["maps"]["env_psnr"] > 100
    assert (tmp_path / "test" / "r_000.exr").exists()
    assert finished == ["test/r_000", "relight/night/r_000", "deform/twist/day/r_000", "deform/twist/night/r_000"]


def test_a_wrong_albedo_is_seen_and_scaled_away_under_a_new_light(capture: Path):
    asset = box_asset()
    asset.mesh.albedo.mul_(0.8)
    figures = evaluate_asset(asset, capture, None, SETTINGS)
    night = figures["relight"]["night"]
    assert figures["views"]["psnr"] < 35
    assert night["psnr_scaled"] > night["psnr"] + 3


def test_a_capture_without_test_views_is_one_sentence(tmp_path: Path):
    with pytest.raises(ValueError, match=r"has no transforms_test.json"):
        evaluate_asset(box_asset(), tmp_path)


def test_an_asset_of_a_turned_world_is_refused(capture: Path):
    turned = replace(box_asset(), provenance={"up": [0.0, 1.0, 0.0]})
    with pytest.raises(ValueError, match="turned"):
        evaluate_asset(turned, capture)
