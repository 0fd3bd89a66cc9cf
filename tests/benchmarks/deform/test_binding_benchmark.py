"""The benchmark of bindings: every row is there, and the drivers differ where they must."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from benchmarks.deform import binding
from drgs.reconstruct.presets import PRESETS
from tests.deform.test_pose_scene import plate_asset
from tests.reconstruct.test_build_asset import TINY
from tests.reconstruct.tiny_capture import sphere_views, write_nerf_synthetic


@pytest.mark.slow
def test_the_static_table_has_a_row_for_the_fit_the_rebuilding_and_each_ablation(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
):
    monkeypatch.setitem(PRESETS, "draft", replace(TINY, points=300, fit=replace(TINY.fit, iterations=2)))
    capture = write_nerf_synthetic(tmp_path / "capture", sphere_views(6, square=True))
    frames = json.loads((capture / "transforms_train.json").read_text())
    frames["frames"] = frames["frames"][:2]
    (capture / "transforms_test.json").write_text(json.dumps(frames).replace("train/", "test/"))
    shutil.copytree(capture / "train", capture / "test")
    binding.main([str(capture), "--preset", "draft", "--iterations", "1", "--spp", "0", "--out", str(tmp_path / "kept"), "--json"])
    result = json.loads(capsys.readouterr().out)
    assert set(result["static"]) == {"particles", "mesh", "mesh_without_offset", "mesh_without_opacity", "mesh_paper"}
    assert all(row["psnr"] > 3 and row["surfels"] > 100 for row in result["static"].values()) and "deform" not in result
    # Its checkpoints are a build's: what is kept is not made again.
    assert {path.name for path in (tmp_path / "kept" / "mesh.build").iterdir()} == {"stage1.safetensors", "mesh.safetensors"}


def test_each_driver_moves_the_same_vertices_and_the_printed_rule_moves_surfels_otherwise(tmp_path: Path):
    asset = plate_asset()
    scenes = {name: binding.driven(asset, {"type": "bend", "curvature": 0.5}, name, [], tmp_path) for name in binding.DRIVERS}
    assert torch.equal(scenes["map"].mesh.vertices, scenes["vertices"].mesh.vertices)
    assert torch.equal(scenes["vertices"].mesh.vertices, scenes["vertices_paper"].mesh.vertices)
    surfels = {name: scene.surfels for name, scene in scenes.items()}
    assert torch.allclose(surfels["map"].centers, surfels["vertices"].centers, atol=5e-3)  # the plate's cells are coarse
    assert not torch.allclose(surfels["vertices"].centers, surfels["vertices_paper"].centers, atol=1e-4)


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [(["nowhere", "--dataset", "nowhere"], "holds no stage1.safetensors"), (["out"], "--dataset is missing")],
)
def test_a_source_that_is_neither_capture_nor_build_is_refused(tmp_path: Path, monkeypatch, arguments: list[str], sentence: str):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "out.build").mkdir()
    (tmp_path / "out.build" / "stage1.safetensors").write_bytes(b"")
    with pytest.raises(ValueError, match=sentence):
        binding.main(arguments)
