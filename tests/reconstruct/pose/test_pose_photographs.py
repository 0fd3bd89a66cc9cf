"""Poses of pictures whose true ones are known; stopping, going on, and what is said when none are found."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image, ImageFilter

from drgs.reconstruct.capture.load_views import load_views
from drgs.reconstruct.pose import colmap_process
from drgs.reconstruct.pose.pose_photographs import PoseSettings
from drgs.reconstruct.pose.pose_photographs import pose_photographs as pose
from drgs.reconstruct.pose.posed_capture import PosedCapture, read_posed_capture
from drgs.reconstruct.progress import BuildStopped, Progress
from tests.reconstruct.pose.textured_scene import DISTORTION, FOCAL, PLAIN_SIZE, SIZE, orbit, picture, write_photographs

pytest.importorskip("pycolmap")

QUICK = PoseSettings(most_features=800)
VIEWS, MASKED_VIEWS = 12, 14
"""All around; without the ground, steps must be smaller."""
FEW, AROUND = 8, 24
"""The fewest that are posed, and how many would go all round at their distance from each other: where nothing is asked of the way round."""


@pytest.fixture(scope="module")
def photographs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_photographs(tmp_path_factory.mktemp("plain") / "photos", orbit(VIEWS), size=PLAIN_SIZE)


@pytest.fixture(scope="module")
def few_photographs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_photographs(tmp_path_factory.mktemp("few") / "photos", orbit(AROUND)[:FEW], size=PLAIN_SIZE)


@pytest.fixture(scope="module")
def posed(photographs: Path) -> PosedCapture:
    return pose(photographs, photographs.parent / "posed", QUICK)


@pytest.fixture(scope="module")
def masked(tmp_path_factory: pytest.TempPathFactory) -> PosedCapture:
    folder = tmp_path_factory.mktemp("masked")
    return pose(write_photographs(folder / "photos", orbit(MASKED_VIEWS), masks=True), folder / "posed", QUICK)


def count_of(capture: PosedCapture) -> int:
    """Of the pictures that were taken."""
    return MASKED_VIEWS if capture.masked else VIEWS


def true_from_found(capture: PosedCapture, around: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """True and found world-from-camera (OpenGL) of the placed pictures, the found ones moved by the best similarity, and its scale.

    Args:
        around: of pictures at their distance from each other.
    """
    transforms = json.loads((Path(capture.folder) / "transforms.json").read_text())
    found = np.array([frame["transform_matrix"] for frame in transforms["frames"]])
    true = orbit(around)[[int(name) for name in capture.placed]] @ np.diag([1.0, -1.0, -1.0, 1.0])
    p, q = found[:, :3, 3], true[:, :3, 3]
    u, sizes, vt = np.linalg.svd((q - q.mean(0)).T @ (p - p.mean(0)))
    sign = np.array([1, 1, np.linalg.det(u @ vt)])
    rotation = u * sign @ vt
    scale = float((sizes * sign).sum() / ((p - p.mean(0)) ** 2).sum())
    moved = found.copy()
    moved[:, :3, :3] = rotation @ found[:, :3, :3]
    moved[:, :3, 3] = scale * (p - p.mean(0)) @ rotation.T + q.mean(0)
    return true, moved, rotation, scale


@pytest.mark.slow
@pytest.mark.parametrize("which", ["posed", "masked"])
def test_poses_are_those_from_which_the_pictures_were_taken(which: str, request: pytest.FixtureRequest):
    capture: PosedCapture = request.getfixturevalue(which)
    assert len(capture.placed) == count_of(capture) and capture.left_out == {} and capture.masked == (which == "masked")
    assert capture.reprojection_error < 0.5
    true, moved, rotation, scale = true_from_found(capture, count_of(capture))
    turned = np.einsum("nji,njk->nik", true[:, :3, :3], moved[:, :3, :3])
    degrees = np.degrees(np.arccos(np.clip((np.trace(turned, axis1=1, axis2=2) - 1) / 2, -1, 1)))
    distance = np.linalg.norm(true[:, :3, 3], axis=1)
    assert degrees.max() < 0.5
    assert (np.linalg.norm(moved[:, :3, 3] - true[:, :3, 3], axis=1) < 0.01 * distance).all()
    assert capture.up_from == "circle" and np.degrees(np.arccos(rotation[2, 2])) < 0.5, "z is up"
    assert scale * 4.0 == pytest.approx(distance.mean(), rel=0.05), "cameras are 4 units away on average"


@pytest.mark.slow
def test_the_capture_is_read_with_undistorted_pictures_and_masks(posed: PosedCapture, masked: PosedCapture):
    (camera,) = posed.cameras.values()
    calibration = dict(zip(camera["parameter_names"], camera["parameters"], strict=True))
    assert calibration["f"] == pytest.approx(FOCAL / SIZE * PLAIN_SIZE, rel=0.02) and calibration["k"] == pytest.approx(
        DISTORTION, abs=0.02
    )
    true, _, _, _ = true_from_found(posed, VIEWS)
    views = load_views(Path(posed.folder))
    assert not views.has_masks and views.points_world is not None and len(views.points_world) == posed.points > 500
    shown = views.images_srgb[3].numpy().astype(int)
    size, focal = shown.shape[0], float(views.cameras[3].intrinsics[0, 0])
    drawn = picture(true[3] @ np.diag([1.0, -1.0, -1.0, 1.0]), focal, 0.0, size)[0].astype(int)
    beside = np.abs(shown - np.roll(drawn, 2, axis=1)).mean()
    assert np.abs(shown - drawn).mean() < 0.3 * beside, "it is the pinhole picture from there, and not two pixels off"
    with_masks = load_views(Path(masked.folder))
    assert with_masks.has_masks
    inside = with_masks.coverage[0] > 250
    assert 0.1 < inside.float().mean() < 0.5
    assert with_masks.images_srgb[0][inside].float().mean() < 200, "the background is white, and outside"
    assert torch.isfinite(views.points_world).all()


@pytest.mark.slow
def test_what_was_stopped_goes_on_and_comes_out_the_same(photographs: Path, posed: PosedCapture, tmp_path: Path):
    reported: list[Progress] = []
    asked = lambda: bool(reported) and reported[-1].stage == "matches"  # noqa: E731
    out = tmp_path / "posed"
    with pytest.raises(BuildStopped):
        pose(photographs, out, QUICK, reported.append, asked)
    assert not (out / "transforms.json").exists() and (out / ".pose" / "features.done").exists()
    with pytest.raises(ValueError, match="other pictures or settings; start anew without --resume"):
        pose(photographs, out, replace(QUICK, resume=True, seed=1))
    later: list[Progress] = []
    again = pose(photographs, out, replace(QUICK, resume=True), later.append)
    assert "features" not in {progress.stage for progress in later}, "they are not looked for again"
    assert [progress.fraction for progress in later] == sorted(progress.fraction for progress in later) and later[-1].fraction == 1
    assert not (out / ".pose").exists()
    assert (out / "transforms.json").read_text() == (Path(posed.folder) / "transforms.json").read_text(), "same seed, same poses"
    assert (out / "sparse.ply").read_bytes() == (Path(posed.folder) / "sparse.ply").read_bytes()
    assert pose(photographs, out, replace(QUICK, resume=True)) == again == read_posed_capture(out)


@pytest.mark.slow
def test_what_only_looks_like_a_backdrop_is_asked_too(few_photographs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """A table of one colour that has what features there are; and the search that was in vain is not repeated on resume."""
    calls = []

    def all_backdrop(prepared, work, should_stop):
        calls.append(len(prepared))
        for photo in prepared:
            mask = np.zeros((photo.height, photo.width), np.uint8)
            mask[120:138, 120:138] = 255
            Image.fromarray(mask).save(work / "masks" / f"{photo.file}.png")
        return [replace(photo, has_mask=True) for photo in prepared], {}

    monkeypatch.setattr("drgs.reconstruct.pose.pose_photographs.with_backdrop_masks", all_backdrop)
    found = pose(few_photographs, tmp_path / "posed", QUICK)
    assert calls == [FEW] and found.masks_from == "none" and not found.masked and len(found.placed) == FEW
    assert not load_views(Path(found.folder)).has_masks
    assert pose(few_photographs, tmp_path / "posed", replace(QUICK, resume=True)) == found


@pytest.mark.slow
def test_a_search_that_broke_off_is_not_taken_for_one_in_vain(photographs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """It goes on with --resume: what it finished stays, though a backdrop was found."""

    def ended(job: Path, told, should_stop):
        (job.parent / "features.done").write_text('{"seconds": 1}')
        raise ValueError("pycolmap was ended by signal 9 (too little memory?)")

    def all_object(prepared, work, should_stop):
        return [replace(photo, has_mask=True) for photo in prepared], {}

    monkeypatch.setattr("drgs.reconstruct.pose.pose_photographs.with_backdrop_masks", all_object)
    monkeypatch.setattr("drgs.reconstruct.pose.pose_photographs.colmap_process", ended)
    with pytest.raises(ValueError, match="ended by signal 9"):
        pose(photographs, tmp_path / "posed", QUICK)
    assert (tmp_path / "posed" / ".pose" / "features.done").exists()


AT_ONCE = """
import runpy, sys
import pycolmap
pycolmap.incremental_mapping = lambda *given, **named: {}
sys.argv = sys.argv[1:]
runpy.run_path(sys.argv[0], run_name="__main__")
"""


@pytest.mark.slow
def test_pictures_that_one_after_the_other_have_no_place_are_placed_at_once(few_photographs: Path, tmp_path: Path):
    reported: list[Progress] = []
    with pytest.raises(BuildStopped):
        pose(few_photographs, tmp_path / "posed", QUICK, reported.append, lambda: bool(reported) and reported[-1].stage == "poses")
    work = tmp_path / "posed" / ".pose"
    for late in ("poses.done", "undistort.done"):
        (work / late).unlink(missing_ok=True)
    with subprocess.Popen([sys.executable, "-c", AT_ONCE, colmap_process.PROGRAM, work / "job.json"], stdin=subprocess.PIPE) as program:
        assert program.wait(timeout=300) == 0
    found = pose(few_photographs, tmp_path / "posed", replace(QUICK, resume=True))
    assert len(found.placed) == FEW and found.reprojection_error < 1
    true, moved, _, _ = true_from_found(found, AROUND)
    turned = np.einsum("nji,njk->nik", true[:, :3, :3], moved[:, :3, :3])
    assert np.degrees(np.arccos(np.clip((np.trace(turned, axis1=1, axis2=2) - 1) / 2, -1, 1))).max() < 1


def grain(seed: int, size: int = 160) -> Image.Image:
    return Image.fromarray(np.random.default_rng(seed).integers(0, 255, (size, size, 3), np.uint8))


@pytest.mark.slow
def test_pictures_without_texture_are_named(tmp_path: Path):
    (tmp_path / "photos").mkdir()
    for number in range(8):
        Image.new("RGB", (160, 120), (90 + number, 90, 90)).save(tmp_path / "photos" / f"{number}.png")
    with pytest.raises(
        ValueError, match=r"8 of 8 pictures have fewer than \d+ features \(0, 1, 2, 3, 4, 5 and 2 more\): blurred, or of something without"
    ):
        pose(tmp_path / "photos", tmp_path / "posed", QUICK)
    assert not (tmp_path / "posed" / "transforms.json").exists()


@pytest.mark.slow
def test_pictures_from_one_place_are_told_to_be_so(tmp_path: Path):
    (tmp_path / "photos").mkdir()
    scene = grain(0, 40).resize((240, 240), Image.Resampling.BICUBIC)
    for number in range(8):
        Image.blend(scene, grain(number + 1, 240).filter(ImageFilter.GaussianBlur(1)), 0.1).save(tmp_path / "photos" / f"{number}.png")
    with pytest.raises(
        ValueError, match=r"moves by 0.* % of their width from one to another, expected several: they are taken from one place"
    ):
        pose(tmp_path / "photos", tmp_path / "posed", QUICK)


def test_without_pycolmap_the_sentence_says_how_to_get_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("drgs.reconstruct.pose.pose_photographs.find_spec", lambda name: None)
    with pytest.raises(ValueError, match=r"finding the poses of pictures needs the package pycolmap; install it with: .*\[sfm\]"):
        pose(tmp_path, tmp_path / "posed", QUICK)


def test_a_capture_is_not_written_among_the_pictures_or_over_what_is_there(tmp_path: Path):
    (tmp_path / "photos").mkdir()
    for out in (tmp_path / "photos", tmp_path / "photos" / "posed", tmp_path):
        with pytest.raises(ValueError, match="one of the two folders lies in the other"):
            pose(tmp_path / "photos", out, QUICK)
    (tmp_path / "mine" / "images").mkdir(parents=True)
    with pytest.raises(ValueError, match="mine/images: there already, and not written by an earlier search"):
        pose(tmp_path / "photos", tmp_path / "mine", QUICK)
