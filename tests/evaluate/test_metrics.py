"""The figures have closed forms on pictures made for them."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from drgs.evaluate.metrics import environment_psnr, light_scale, normal_error_degrees, picture_figures, psnr, score_renders, ssim
from drgs.exchange.exr import encode_exr

SIZE = 16


def picture(value: float, alpha: float = 1.0) -> np.ndarray:
    return np.concatenate([np.full((SIZE, SIZE, 3), value), np.full((SIZE, SIZE, 1), alpha)], -1)


def test_psnr_of_a_constant_error_of_a_tenth_is_twenty_decibels():
    assert psnr(np.full(7, 0.3), np.full(7, 0.4)) == pytest.approx(20.0)


def test_psnr_of_equal_pictures_is_finite():
    assert psnr(np.zeros(3), np.zeros(3)) == pytest.approx(120.0)


def test_ssim_of_constant_pictures_is_the_luminance_term():
    # Without variance only (2ab + C1) / (a^2 + b^2 + C1) with C1 = 0.01^2 is left.
    expected = (2 * 0.5 * 0.7 + 1e-4) / (0.5**2 + 0.7**2 + 1e-4)
    assert ssim(np.full((SIZE, SIZE, 3), 0.5), np.full((SIZE, SIZE, 3), 0.7)) == pytest.approx(expected)


def test_pictures_are_compared_on_white():
    # Half-covered black is grey 0.5 on white, whatever colour hides under alpha 0.
    figures = picture_figures([(picture(0.0, alpha=0.5), picture(0.5)), (picture(0.1, alpha=0.0), picture(0.9, alpha=0.0))])
    assert figures["psnr"] == pytest.approx(120.0)


def test_psnr_is_the_mean_over_pictures_not_of_their_errors():
    figures = picture_figures([(picture(0.5), picture(0.6)), (picture(0.5), picture(0.51))])
    assert figures["psnr"] == pytest.approx((20 + 40) / 2)


def test_light_scale_undoes_a_factor_on_linear_colour():
    rng = np.random.default_rng(0)
    linear = rng.uniform(0.05, 0.3, (SIZE, SIZE, 3))
    as_srgb = lambda x: np.concatenate([1.055 * x ** (1 / 2.4) - 0.055, np.ones((SIZE, SIZE, 1))], -1)  # noqa: E731
    factors = np.array([0.5, 1.0, 2.0])
    pairs = [(as_srgb(linear), as_srgb(linear * factors))]
    np.testing.assert_allclose(light_scale(pairs), factors, rtol=1e-9)
    assert picture_figures(pairs, new_light=True)["psnr_scaled"] == pytest.approx(120.0)


def test_clipped_truth_does_not_pull_the_light_scale():
    rendered, true = picture(0.5), picture(0.5)
    true[: SIZE // 2, :, 0] = 1.0
    np.testing.assert_allclose(light_scale([(rendered, true)]), 1.0)


def test_normal_error_is_the_angle_and_ignores_length():
    angle = np.radians(30)
    rendered = np.array([[0.0, 0.0, 5.0], [0.0, 3 * np.sin(angle), 3 * np.cos(angle)]])
    np.testing.assert_allclose(normal_error_degrees(rendered, np.array([[0.0, 0.0, 1.0]] * 2)), [0.0, 30.0], atol=1e-6)


def test_environment_psnr_ignores_one_factor_a_channel_and_the_table_size():
    rng = np.random.default_rng(1)
    table = rng.uniform(0.1, 4.0, (64, 128, 3))
    larger = np.repeat(np.repeat(table, 2, axis=0), 2, axis=1) * [0.3, 2.0, 5.0]
    assert environment_psnr(larger, table) > 100
    assert environment_psnr(np.ones((64, 128, 3)), table) < 40


def capture_with_truth(folder: Path) -> Path:
    """A capture of one test view, one other light and one deformation, all of one grey."""
    names = ["r_000"]
    (folder / "test").mkdir(parents=True)
    frames = [{"file_path": f"./test/{name}", "transform_matrix": np.eye(4).tolist()} for name in names]
    (folder / "transforms_test.json").write_text(json.dumps({"camera_angle_x": 0.5, "frames": frames}))
    (folder / "scene.json").write_text(
        json.dumps({"name": "grey", "train_env": "day", "relight": ["night"], "deform": {"bend": {"type": "bend", "curvature": 0.5}}})
    )
    aov = np.zeros((SIZE, SIZE, 10), np.float16)
    aov[..., :3], aov[..., 5], aov[..., 6], aov[..., 7], aov[..., 9] = 0.5, 1, 4, 0.5, 1
    aov[: SIZE // 2, :, 9] = 0  # the upper half is background: nothing there may count
    np.savez(folder / "test" / "r_000_aov.npz", aov=aov)
    for part in ("test", "relight/night", "deform/bend/day", "deform/bend/night"):
        write_picture(folder / part, 0.5)
    return folder


def write_picture(folder: Path, value: float) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    Image.fromarray((picture(value) * 255).round().astype(np.uint8)).save(folder / "r_000.png")


def test_a_folder_of_renders_gets_every_figure_its_truth_allows(tmp_path: Path):
    capture, renders = capture_with_truth(tmp_path / "capture"), tmp_path / "renders"
    for part in ("test", "relight/night", "deform/bend/day", "deform/bend/night"):
        write_picture(renders / part, 0.5)
    maps = {name: np.zeros((SIZE, SIZE), np.float32) for name in ("normal.X", "normal.Y", "metallic.Y")}
    maps |= {"normal.Z": np.ones((SIZE, SIZE), np.float32), "roughness.Y": np.full((SIZE, SIZE), 0.7, np.float32)}
    maps |= {f"albedo.{c}": np.full((SIZE, SIZE), 0.25, np.float32) for c in "RGB"}
    maps["depth.Z"] = np.full((SIZE, SIZE), 4.5, np.float32)
    maps["depth.Z"][: SIZE // 2] = np.inf
    (renders / "test" / "r_000.exr").write_bytes(encode_exr(maps))

    figures = score_renders(capture, renders)

    assert figures["scene"] == "grey"
    assert figures["views"] == pytest.approx({"images": 1, "psnr": 120.0, "ssim": 1.0})
    assert figures["maps"]["normal_mae"] == pytest.approx(0.0)
    assert figures["maps"]["albedo_scale"] == [2.0, 2.0, 2.0]
    assert figures["maps"]["albedo_psnr"] == pytest.approx(120.0)
    assert figures["maps"]["roughness_rmse"] == pytest.approx(0.2)
    assert figures["maps"]["depth_mae"] == pytest.approx(0.5)
    assert set(figures["relight"]) == {"night"}
    assert "psnr_scaled" in figures["deform"]["bend/night"]
    assert "psnr_scaled" not in figures["deform"]["bend/day"], "under the training light nothing is scaled"


def test_a_missing_picture_is_an_error_and_not_a_smaller_mean(tmp_path: Path):
    capture = capture_with_truth(tmp_path / "capture")
    (tmp_path / "renders" / "test").mkdir(parents=True)
    with pytest.raises(ValueError, match=r"test/r_000.png is missing"):
        score_renders(capture, tmp_path / "renders")


def test_a_picture_of_another_size_is_an_error_that_names_both(tmp_path: Path):
    capture = capture_with_truth(tmp_path / "capture")
    (tmp_path / "renders" / "test").mkdir(parents=True)
    Image.new("RGBA", (8, 4)).save(tmp_path / "renders" / "test" / "r_000.png")
    with pytest.raises(ValueError, match="is 8x4, but its truth is 16x16"):
        score_renders(capture, tmp_path / "renders")
