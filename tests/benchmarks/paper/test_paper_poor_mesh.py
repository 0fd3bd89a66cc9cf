"""Gaussians on a mesh made poor: what is learned has a row, and the mesh is as poor as it says."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from PIL import Image

from benchmarks.deform.binding import prepare
from benchmarks.paper import poor_mesh
from benchmarks.paper.cells import CellFolder
from benchmarks.paper.figures import figure_cells
from benchmarks.paper.tables import EvidenceSettings, SceneEvidence
from benchmarks.scenes.bench_scene import open_scene
from drgs.reconstruct.presets import PRESETS
from drgs.scene.asset import Asset, save_asset
from drgs.scene.mesh import TriangleMesh
from tests.benchmarks.reconstruct.test_quality_benchmark import sphere_shape
from tests.reconstruct.test_build_asset import TINY
from tests.reconstruct.tiny_capture import sphere_views, write_nerf_synthetic
from tests.render.closed_form_scenes import constant_sky, mesh_of


def test_vertices_move_along_their_normals_by_so_many_radii():
    ball = mesh_of(sphere_shape(2.0), 0.5, 0.5, 0.0)
    poor = poor_mesh.spoiled(ball, 2.0)
    moved = poor.vertices - ball.vertices
    along = (moved * torch.nn.functional.normalize(ball.vertices, dim=-1)).sum(-1)
    assert moved.norm(dim=-1) == pytest.approx(along.abs(), abs=0.01)
    assert float(along.std()) == pytest.approx(2.0 * poor_mesh.ROUGHNESS, rel=0.15)
    assert isinstance(poor, TriangleMesh) and torch.equal(poor.vertices, poor_mesh.spoiled(ball, 2.0).vertices)


@pytest.mark.slow
def test_the_figure_has_a_row_for_each_and_is_left_out_where_no_build_left_its_checkpoints(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(PRESETS, "draft", replace(TINY, points=300, fit=replace(TINY.fit, iterations=2)))
    monkeypatch.setattr(poor_mesh, "ITERATIONS", 1)
    (tmp_path / "mesh.build").mkdir()
    capture = write_nerf_synthetic(tmp_path / "capture", sphere_views(6, square=True))
    frames = json.loads((capture / "transforms_train.json").read_text())
    frames["frames"] = frames["frames"][:2]
    (capture / "transforms_test.json").write_text(json.dumps(frames).replace("train/", "test/"))
    shutil.copytree(capture / "train", capture / "test")
    prepare(capture, tmp_path, "draft", "cpu")
    save_asset(Asset(None, mesh_of(sphere_shape(0.5), 0.5, 0.5, 0.0), None, constant_sky(1.0), primary="mesh"), tmp_path / "particles")
    evidence = SceneEvidence(open_scene(capture), tmp_path / "particles", CellFolder(tmp_path / "out", "command"), EvidenceSettings())
    told = figure_cells(evidence, [], ["poor_mesh"])["poor_mesh"]
    assert [row["on a poor mesh"] for row in told["rows"]] == list(poor_mesh.LEARNED.values())
    assert all(float(row["PSNR"]) > 3 for row in told["rows"])
    assert Image.open(tmp_path / "out" / told["picture"]).size[0] > 100
    (tmp_path / "particles.build" / "stage1.safetensors").unlink()
    assert not figure_cells(evidence, [], ["poor_mesh"])
