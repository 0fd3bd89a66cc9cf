"""What a long list of edits has made comes back from a file, to the bit, and never instead of something else."""

from pathlib import Path

import pytest
import torch
from test_pose_scene import detailed_plate, material, plate_asset, twist

from drgs.deform import pose_scene as pose_module
from drgs.deform.keep_pose import recall_pose, save_pose
from drgs.deform.pose_scene import pose_scene
from drgs.scene.edits import Edit, parse_edits


def edits(count: int) -> list[Edit]:
    return parse_edits([edit for k in range(count) for edit in (twist(1e-3 * k), material({"all": True}, roughness=k / count))])


@pytest.fixture
def kept(tmp_path: Path) -> Path:
    asset, path = plate_asset(), tmp_path / "pose.safetensors"
    pose_scene(asset, edits(20))
    assert save_pose(asset, edits(20), path)
    return path


def test_who_opens_a_list_again_applies_only_what_came_since(kept: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    longer = [*edits(20), *parse_edits([twist(0.2), material({"all": True}, metallic=0.5)])]
    whole, again = pose_scene(plate_asset(), longer), plate_asset()
    assert recall_pose(again, longer, kept) == 40
    applied, evaluate = [], pose_module.evaluate_map
    monkeypatch.setattr(pose_module, "evaluate_map", lambda *given: applied.append(1) or evaluate(*given))
    found = pose_scene(again, longer)
    assert len(applied) == 2, "one twist, of vertices and of surfels"
    assert found.surfels is not None and whole.surfels is not None
    for a, b in ((found.mesh, whole.mesh), (found.surfels.materials, whole.surfels.materials)):
        assert all(torch.equal(getattr(a, name), getattr(b, name)) for name in ("albedo", "roughness", "metallic"))
    for name in ("centers", "tangents"):
        assert torch.equal(getattr(found.surfels, name), getattr(whole.surfels, name))
    assert torch.equal(found.mesh.vertices, whole.mesh.vertices) and torch.equal(found.mesh.normals, whole.mesh.normals)


def test_a_file_of_other_edits_or_another_object_is_as_good_as_none(kept: Path) -> None:
    other = edits(20)
    other[3] = parse_edits([material({"all": True}, roughness=0.99)])[0]
    assert recall_pose(plate_asset(), other, kept) == 0
    assert recall_pose(plate_asset(), edits(20)[:-1], kept) == 0, "fewer edits than it holds"
    smaller = plate_asset()
    object.__setattr__(smaller, "gaussians", None)
    assert recall_pose(smaller, edits(20), kept) == 0


@pytest.mark.parametrize("damage", [b"", b"\x00" * 64, b"\xff" * 64])
def test_a_damaged_or_missing_file_is_as_good_as_none(kept: Path, damage: bytes) -> None:
    data = kept.read_bytes()
    kept.write_bytes(damage + data[len(damage) : -8])
    assert recall_pose(plate_asset(), edits(20), kept) == 0
    kept.unlink()
    assert recall_pose(plate_asset(), edits(20), kept) == 0


def test_what_is_no_longer_remembered_is_not_written(tmp_path: Path) -> None:
    assert not save_pose(plate_asset(), edits(3), tmp_path / "pose.safetensors")
    assert not (tmp_path / "pose.safetensors").exists()


def test_what_is_left_of_a_pattern_comes_back_too(tmp_path: Path) -> None:
    half = {"box": {"minimum": [0, -1, 0], "maximum": [1, 1, 1]}}
    list_of_edits = parse_edits([material(half, albedo=[0.1, 0.2, 0.3]), twist(0.1)])
    asset, path = detailed_plate(), tmp_path / "pose.safetensors"
    whole = pose_scene(asset, list_of_edits)
    assert save_pose(asset, list_of_edits, path)
    again = detailed_plate()
    assert recall_pose(again, list_of_edits, path) == 2
    found = pose_scene(again, list_of_edits)
    assert whole.mesh.detail is not None and found.mesh.detail is not None and whole.mesh.detail.share is not None
    assert 0 < int((whole.mesh.detail.share == 0).sum()) < len(whole.mesh.vertices)
    assert torch.equal(found.mesh.detail.share, whole.mesh.detail.share)
