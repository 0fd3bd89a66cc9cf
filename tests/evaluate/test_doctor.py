"""The doctor names what is wrong with a capture, and nothing when nothing is."""

import json
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from drgs.cli import app
from drgs.evaluate.doctor import doctor
from drgs.evaluate.doctor.places import _ranks
from drgs.scene.lens import Lens
from tests.reconstruct import tiny_capture as tiny


def _sentences(report: dict, level: str = "warning") -> str:
    return " | ".join(finding["sentence"] for finding in report["findings"] if finding["level"] == level)


def test_equal_brightness_shares_the_mean_of_its_ranks() -> None:
    assert _ranks(np.array([0.5, 0.1, 0.5, 0.2, 0.5])).tolist() == [4, 1, 4, 2, 4]


@pytest.mark.parametrize("found", [[], [{"level": "info", "sentence": "It is small."}]])
def test_the_command_says_so_when_nothing_was_found(found: list, monkeypatch: pytest.MonkeyPatch) -> None:
    report = {"ok": True, "views": 3, "findings": found, "advice": []}
    monkeypatch.setattr(import_module("drgs.evaluate.doctor.doctor"), "examine", lambda dataset: SimpleNamespace(report=report, views=None))
    said = CliRunner().invoke(app, ["doctor", "."]).output
    assert said.endswith("info: It is small.\n" if found else "Nothing was found that would hurt a build.\n")


@pytest.mark.slow
def test_a_good_capture_is_reported_without_warnings(tmp_path: Path) -> None:
    report = doctor(tiny.write_nerf_synthetic(tmp_path))
    assert json.loads(json.dumps(report)) == report
    assert report["ok"]
    assert _sentences(report) == "" and report["advice"] == []
    assert report["summary"].startswith(f"{tiny.VIEWS} pictures of {tiny.WIDTH}x{tiny.HEIGHT} with masks; the object fills ")
    assert (report["source"], report["views"], report["size"]) == ("nerf-synthetic", tiny.VIEWS, [tiny.WIDTH, tiny.HEIGHT])
    assert report["intrinsics"]["field_of_view_degrees"] == pytest.approx(np.degrees(2 * np.arctan(0.5 * tiny.WIDTH / tiny.FX)), abs=0.01)
    assert report["scale"]["camera_distance"] == pytest.approx([3 - 0.27, 3 + 0.27], abs=0.1)
    assert report["scale"]["bounds_radius"] == pytest.approx(tiny.SPHERE_RADIUS, rel=0.25)
    assert report["masks"]["agreement"] > 0.9
    assert report["initial_points"]["origin"] == "hull"


@pytest.mark.slow
def test_a_capture_with_lens_distortion_is_reported_as_it_will_be_built(tmp_path: Path) -> None:
    lens = Lens("SIMPLE_RADIAL", (tiny.FX, tiny.CX, tiny.CY, -0.3), tiny.WIDTH, tiny.HEIGHT)
    report = doctor(tiny.write_colmap(tmp_path, binary=True, lens=lens))
    assert report["ok"] and _sentences(report) == ""
    assert "24 pictures are undistorted before anything else (SIMPLE_RADIAL)." in _sentences(report, "info")
    assert report["intrinsics"]["undistorted_pictures"] == tiny.VIEWS
    assert report["masks"]["agreement"] > 0.9


@pytest.mark.slow
def test_lengths_of_a_tiny_world_keep_their_digits(tmp_path: Path) -> None:
    views = tiny.at_scale(tiny.sphere_views(square=True), 1e-6)
    scale = doctor(tiny.write_nerf_synthetic(tmp_path, views))["scale"]
    assert scale["camera_distance"] == pytest.approx([2.73e-6, 3.27e-6], rel=0.04)
    assert scale["bounds_radius"] == pytest.approx(1e-6 * tiny.SPHERE_RADIUS, rel=0.25)


def test_a_folder_that_cannot_be_read_is_a_finding(tmp_path: Path) -> None:
    report = doctor(tmp_path / "nowhere")
    assert not report["ok"]
    assert "no such folder" in _sentences(report, "error")
    assert "transforms.json" in report["findings"][0]["advice"] == report["advice"][0]
    folder = tiny.write_nerf_synthetic(tmp_path / "capture")
    (folder / "train" / "r_003.png").unlink()
    assert "r_003.png (or .jpg, .webp): no such image" in _sentences(doctor(folder), "error")


@pytest.mark.slow
def test_views_from_one_side_leave_a_gap_that_is_named(tmp_path: Path) -> None:
    views = [view for view in tiny.sphere_views(40, square=True) if np.linalg.inv(view.camera_from_world)[0, 3] > 0]
    report = doctor(tiny.write_nerf_synthetic(tmp_path, views))
    assert report["directions"]["widest_azimuth_gap_degrees"] > 150
    assert abs(abs(report["directions"]["widest_azimuth_gap_at_degrees"]) - 180) < 30
    assert "No view from azimuths" in _sentences(report)


@pytest.mark.slow
def test_a_mask_that_contradicts_the_others_is_named(tmp_path: Path) -> None:
    folder = tiny.write_nerf_synthetic(tmp_path)
    path = folder / "train" / "r_009.png"
    rgba = np.array(Image.open(path))
    Image.fromarray(np.roll(rgba, 12, axis=1)).save(path)
    report = doctor(folder)
    assert report["masks"]["disagreeing"] == ["r_009"]
    assert "r_009" in _sentences(report)


@pytest.mark.slow
def test_an_object_at_the_border_is_named(tmp_path: Path) -> None:
    folder = tiny.write_nerf_synthetic(tmp_path)
    path = folder / "train" / "r_002.png"
    rgba = np.array(Image.open(path))
    rgba[: tiny.HEIGHT // 2, tiny.WIDTH // 2, :] = 255
    Image.fromarray(rgba).save(path)
    assert doctor(folder)["masks"]["touching_border"] == ["r_002"]


@pytest.mark.slow
def test_over_exposure_and_changing_exposure_are_told(tmp_path: Path) -> None:
    folder = tiny.write_nerf_synthetic(tmp_path)
    for index, path in enumerate(sorted((folder / "train").glob("*.png"))):
        rgba = np.array(Image.open(path))
        gain = 2.2 if index % 2 else 0.5
        rgba[..., :3] = np.clip(rgba[..., :3] * gain, 0, 255)
        Image.fromarray(rgba).save(path)
    report = doctor(folder)
    assert report["exposure"]["clipped_share"] > 0.1
    assert "over-exposed" in _sentences(report) and "stops between views" in _sentences(report)


@pytest.mark.slow
def test_a_world_that_lies_on_its_side_is_told(tmp_path: Path) -> None:
    turn = np.eye(4)
    turn[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]  # z up becomes -y up, as COLMAP's worlds often are
    views = [tiny.TinyView(view.name, view.rgba, view.camera_from_world @ turn) for view in tiny.sphere_views(square=True)]
    report = doctor(tiny.write_nerf_synthetic(tmp_path, views))
    assert report["scale"]["up_tilt_degrees"] == pytest.approx(90, abs=10)
    assert "z axis" in _sentences(report)


def test_missing_masks_are_told(tmp_path: Path) -> None:
    views = [
        tiny.TinyView(view.name, view.rgba | np.array([0, 0, 0, 255], np.uint8), view.camera_from_world)
        for view in tiny.sphere_views(square=True)
    ]
    report = doctor(tiny.write_nerf_synthetic(tmp_path, views))
    assert not report["masks"]["present"]
    assert report["initial_points"]["origin"] == "random"
    assert "no masks" in _sentences(report)


def test_a_path_that_no_disk_has_is_a_finding() -> None:
    report = doctor(Path("/" + "x" * 5000))
    assert not report["ok"] and "no such folder" in _sentences(report, "error")


@pytest.mark.slow
def test_what_a_capture_holds_beside_what_is_used_is_counted(tmp_path: Path) -> None:
    folder = tiny.write_nerf_synthetic(tmp_path)
    (folder / "masks").mkdir()
    for path in sorted((folder / "train").glob("*.png")):
        Image.open(path).getchannel("A").save(folder / "masks" / path.name)
    for place in ("train", "masks"):
        Image.new("L", (4, 4)).save(folder / place / "spare.png")
    report = doctor(folder)
    assert report["files"] == {"pictures_used": tiny.VIEWS, "masks_used": tiny.VIEWS, "pictures_unused": 1, "masks_unused": 1}
    assert "1 pictures beside those that are used are not used (spare.png)" in _sentences(report, "info")
    assert "1 masks are not used (spare.png)" in _sentences(report, "info")
