"""Captures that were taken otherwise are read as what they are, and the table says what builds lose by them."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.ndimage import map_coordinates

from benchmarks.reconstruct import captures
from benchmarks.scenes.bench_scene import read_rgba
from benchmarks.scenes.retake_photographs import MOST_STOPS, WAYS, Way, premultiplied, retake_photographs, through_lens
from drgs.reconstruct.capture.load_views import load_views, read_capture
from drgs.reconstruct.capture.load_views.read_pictures import read_pictures
from drgs.reconstruct.capture.sharpen_masks import sharpen_masks
from drgs.scene.lens import pixels_from_plane
from drgs.scene.views import Views
from tests.benchmarks.reconstruct.test_draw_scene_benchmark import small_scene

SIDE = 96


def photographed(folder: Path) -> Path:
    """A soft checkerboard, cut out as a disc, from three cameras at one place."""
    scene = small_scene(folder)
    x, y = np.meshgrid(*[(np.arange(SIDE) + 0.5) / SIDE * 2 - 1] * 2)
    grey = 0.4 + 0.3 * np.sin(9 * x) * np.sin(9 * y)
    rgba = np.stack([grey, 0.8 * grey, 0.6 * grey, np.clip((0.7 - np.hypot(x, y)) * 30, 0, 1)], -1)
    (scene / "train").mkdir()
    for k in range(3):
        Image.fromarray((255 * rgba + 0.5).astype(np.uint8)).save(scene / "train" / f"r_00{k}.png")
    document = json.loads((scene / "transforms_train.json").read_text())
    del document["w"], document["h"]
    (scene / "transforms_train.json").write_text(json.dumps(document))
    return scene


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return photographed(tmp_path_factory.mktemp("captures") / "scene")


def taken(scene: Path, way: Way, folder: Path) -> Path:
    retake_photographs(scene, folder / way, way)
    return folder / way


def test_the_lens_shows_each_direction_where_it_bends_it_to(scene: Path, tmp_path: Path) -> None:
    views = load_views(taken(scene, "lens", tmp_path))
    lens = views.lenses[0]
    assert lens is not None and lens.coefficients[:2] == (-0.2, 0.05)
    light = premultiplied(read_rgba(scene / "train" / "r_000.png"))
    bent, _ = through_lens(light, 0.55)
    plane = np.stack(np.meshgrid(*[np.linspace(-0.13, 0.13, 41)] * 2), -1)
    straight = plane * lens.focal_lengths + np.array(lens.principal_point)
    shown = pixels_from_plane(lens, plane)

    def sampled(picture: np.ndarray, places: np.ndarray) -> np.ndarray:
        return map_coordinates(picture[..., 0], [places[..., 1] - 0.5, places[..., 0] - 0.5], order=3)

    right, unmoved = (np.abs(sampled(bent, places) - sampled(light, straight)).mean() for places in (shown, straight))
    assert right < 0.1 * unmoved


def test_sizes_are_mixed_and_what_they_show_stays(scene: Path, tmp_path: Path) -> None:
    views = load_views(taken(scene, "sizes", tmp_path))
    assert [camera.width for camera in views.cameras] == [96, 72, 48]
    means = [float(image[mask == 255].float().mean()) for image, mask in zip(views.images_srgb, views.coverage, strict=True)]
    assert max(means) - min(means) < 2


def test_exposures_differ_by_a_stop_at_most_and_in_linear_light(scene: Path, tmp_path: Path) -> None:
    def mean_light(path: Path) -> float:
        rgba = np.asarray(Image.open(path), np.float64) / 255
        return float((rgba[rgba[..., 3] == 1][:, :3] ** 2.2).mean())

    out = taken(scene, "exposures", tmp_path)
    stops = [np.log2(mean_light(out / "train" / f"r_00{k}.png") / mean_light(scene / "train" / f"r_00{k}.png")) for k in range(3)]
    assert max(np.abs(stops)) < MOST_STOPS + 0.1 and max(stops) - min(stops) > 0.2


def test_white_balances_change_red_and_blue_by_a_factor_a_picture(scene: Path, tmp_path: Path) -> None:
    out, factors = taken(scene, "white", tmp_path), []
    for k in range(3):
        plain, taken_so = (premultiplied(read_rgba(folder / "train" / f"r_00{k}.png")) for folder in (scene, out))
        inside = plain[..., 3] == 1
        ratio = taken_so[inside][:, :3] / plain[inside][:, :3]
        assert np.abs(ratio / np.median(ratio, 0) - 1).max() < 0.1
        factors.append(np.median(ratio, 0))
    logs = np.log(factors)
    assert np.abs(logs[:, 1]).max() < 1e-3 and 0.01 < np.abs(logs[:, [0, 2]]).max() < 0.3 and np.ptp(logs[:, 0]) > 0.01


def test_all_ways_are_captures_of_the_same_cameras(scene: Path, tmp_path: Path) -> None:
    first = load_views(scene).cameras
    for way in WAYS:
        cameras = load_views(taken(scene, way, tmp_path)).cameras
        assert [camera.name for camera in cameras] == [camera.name for camera in first]
        off = max(
            float((camera.camera_from_world - known.camera_from_world).abs().max()) for camera, known in zip(cameras, first, strict=True)
        )
        assert 1e-5 < off < 0.01 if way == "poses" else off < 1e-6


def test_grain_is_of_the_light_and_leaves_the_mask(scene: Path, tmp_path: Path) -> None:
    plain, noisy = (read_rgba(folder / "train" / "r_000.png") for folder in (scene, taken(scene, "grain", tmp_path)))
    assert (plain[..., 3] == noisy[..., 3]).all()
    inside = plain[..., 3] == 1
    assert 0.003 < np.abs(plain - noisy)[inside][:, :3].mean() < 0.02 and abs((plain - noisy)[inside].mean()) < 0.002


def test_rough_masks_are_wider_and_show_the_room_there(scene: Path, tmp_path: Path) -> None:
    plain, rough = (read_rgba(folder / "train" / "r_000.png") for folder in (scene, taken(scene, "masks", tmp_path)))
    before, after = plain[..., 3] > 0.5, rough[..., 3] > 0.5
    outline = np.sqrt(4 * np.pi * before.sum())
    assert 0.3 < (after.sum() - before.sum()) / outline < 1.1
    assert rough[after & ~before][:, :3].min() > 0.25
    assert np.abs(plain - rough)[plain[..., 3] == 1][rough[plain[..., 3] == 1][:, 3] == 1].max() < 0.005
    assert rough[~after & ~before][:, :3].min() > 0.35
    cut = read_rgba(taken(scene, "cutouts", tmp_path) / "train" / "r_000.png")
    assert (cut[after] == rough[after]).all() and cut[~after].max() == 0


def test_rough_masks_can_be_moved_to_where_the_object_ends_but_not_those_of_cutouts(scene: Path, tmp_path: Path) -> None:
    true, given, cut = load_views(scene), load_views(taken(scene, "masks", tmp_path)), load_views(taken(scene, "cutouts", tmp_path))
    moved = sharpen_masks(given)

    def off(views: Views) -> float:
        pairs = zip(views.coverage, true.coverage, strict=True)
        return float(np.mean([(mask.float() - right.float()).abs().mean() for mask, right in pairs]))

    assert off(moved) < 0.5 * off(given) and 0.6 < moved.masks_moved < 2
    assert sharpen_masks(cut) is cut and sharpen_masks(true) is true
    capture = read_capture(tmp_path / "masks")
    smaller, plain = (read_pictures(capture, SIDE // 2, sharpen) for sharpen in (True, False))
    assert smaller.masks_moved == moved.masks_moved, "before they are shrunk: what is beyond a mask is lost then"
    exact = read_pictures(read_capture(scene), SIDE // 2, True)
    assert exact.masks_moved == 0
    errors = [
        np.mean([(mask.float() - right.float()).abs().mean() for mask, right in zip(views.coverage, exact.coverage, strict=True)])
        for views in (smaller, plain)
    ]
    assert errors[0] < 0.5 * errors[1]


def figures_of(views: float, relit: float) -> dict:
    maps = {"normal_mae": 5.0, "metallic_rmse": 0.1, "roughness_rmse": 0.1, "env_psnr": 20.0}
    return {"views": {"psnr": views, "ssim": 0.9}, "maps": maps, "relight": {"sky": {"psnr_scaled": relit}}}


def test_each_row_stands_beside_its_plain_one_and_misses_are_marked() -> None:
    rows = [
        {"scene": "ball", "way": way, "figures": figures_of(views, relit)}
        for way, views, relit in (("plain", 30.0, 28.0), ("lens", 29.8, 27.4), ("drawn", 31.0, 29.0), ("turned", 30.6, 29.5))
    ]
    lines = captures.main_table(rows).splitlines()
    assert "-0.20 |" in lines[3] and "-0.60 (missed)" in lines[3]
    assert "-0.40 (missed)" in lines[5] and "+0.50 |" in lines[5]
    assert lines[2].count("–") == 2 and lines[4].count("–") == 2


def test_what_was_made_with_other_settings_is_refused_and_the_same_is_kept(scene: Path, tmp_path: Path) -> None:
    made = {"scene": scene.name, "way": "lens", "preset": "draft", "spp": 8, "figures": figures_of(30.0, 28.0)}
    (tmp_path / "rows.jsonl").write_text(json.dumps(made) + "\n")
    assert captures.row(scene, "lens", tmp_path, "draft", 8, "cpu", captures.Drawing()) == made
    with pytest.raises(ValueError, match="made otherwise"):
        captures.row(scene, "lens", tmp_path, "draft", 16, "cpu", captures.Drawing())


def test_the_turned_capture_differs_from_the_drawn_one_in_photographs_and_test_views_alone(tmp_path: Path) -> None:
    scene = small_scene(tmp_path / "scene")
    (scene / "env").mkdir()
    for name in ("lamp", "sky"):
        (scene / f"{name}.exr").rename(scene / "env" / f"{name}.exr")
    (scene / "scene.json").write_text(json.dumps({"name": "ball", "train_env": "lamp"}))
    (scene / "relight" / "sky").mkdir(parents=True)
    drawing = captures.Drawing(2)
    turned, truth = captures.capture_of(scene, "turned", tmp_path / "out", drawing)
    drawn, _ = captures.capture_of(scene, "drawn", tmp_path / "out", drawing)
    assert truth == turned
    names = {path.relative_to(drawn) for path in drawn.rglob("*") if path.is_file()}
    assert names == {path.relative_to(turned) for path in turned.rglob("*") if path.is_file()}
    assert captures.capture_of(scene, "turned", tmp_path / "out", drawing)[0] == turned
