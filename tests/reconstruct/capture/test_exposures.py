"""Exposures: found by points, by a fit and in files; and that they are taken out of what fits are compared with."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor

from drgs.maths.color import linear_from_srgb, srgb_from_linear
from drgs.reconstruct.capture.exposure_gains import gains_of_files, spread
from drgs.reconstruct.capture.exposures import with_gains, with_gains_of_fit, with_gains_of_points
from drgs.reconstruct.capture.initial_points import initial_points
from drgs.reconstruct.capture.load_views import load_views
from drgs.reconstruct.fit.losses import display_image
from drgs.reconstruct.fit.view_targets import ViewTarget, view_targets
from drgs.scene.views import Views
from tests.reconstruct import tiny_capture as tiny

CPU = torch.device("cpu")
EXIF, TIME, SENSITIVITY, F_NUMBER = 0x8769, 33434, 34855, 33437


@pytest.fixture(scope="module")
def even(tmp_path_factory: pytest.TempPathFactory) -> Views:
    return load_views(tiny.write_nerf_synthetic(tmp_path_factory.mktemp("even")))


def exposed(views: Views, stops: np.ndarray) -> Views:
    """As a camera would have stored them that many stops brighter."""
    images = []
    for image, stop in zip(views.images_srgb, stops, strict=True):
        linear = linear_from_srgb(image.double() / 255) * 2.0**stop
        images.append((255 * srgb_from_linear(linear).clamp(0, 1)).round().to(torch.uint8))
    return replace(views, images_srgb=tuple(images))


def some_stops(count: int, seed: int = 0) -> np.ndarray:
    stops = np.random.default_rng(seed).uniform(-1, 1, count)
    return stops - stops.mean()


@pytest.mark.slow
def test_exposures_are_found_by_points_and_even_pictures_are_left_alone(even: Views) -> None:
    points = initial_points(even, 1500, seed=0)
    assert with_gains_of_points(even, points) is even
    stops = some_stops(len(even.cameras))
    varied = exposed(even, stops)
    found = with_gains_of_points(varied, initial_points(varied, 1500, seed=0))
    assert found.gains is not None
    assert float(np.abs(np.log2(found.gains) - stops).max()) < 0.25
    assert abs(float(np.log2(found.gains).mean())) < 1e-9


def true_picture(even: Views, seen: ViewTarget) -> tuple[Tensor, Tensor]:
    """What a perfect fit would draw."""
    target = next(target for target in view_targets(even, 0.5, CPU) if target.camera.name == seen.camera.name)
    return linear_from_srgb(target.saturation), target.mask


@pytest.mark.slow
def test_a_fit_tells_exposures_to_a_hundredth_of_a_stop(even: Views) -> None:
    stops = some_stops(len(even.cameras), seed=1)
    varied = exposed(even, stops)
    rough = with_gains(varied, stops + 0.2 * np.sin(np.arange(len(stops))))
    for views in (varied, rough):
        found = with_gains_of_fit(views, lambda target: true_picture(even, target))
        assert found.gains is not None
        assert float(np.abs(np.log2(found.gains) - stops).max()) < 0.02
    assert with_gains_of_fit(even, lambda target: true_picture(even, target)) is even


def balanced(views: Views, tints: np.ndarray) -> Views:
    """As a camera would have stored them whose white balance keeps that much more of each channel."""
    images = []
    for image, tint in zip(views.images_srgb, tints, strict=True):
        linear = linear_from_srgb(image.double() / 255) * torch.from_numpy(tint)
        images.append((255 * srgb_from_linear(linear).clamp(0, 1)).round().to(torch.uint8))
    return replace(views, images_srgb=tuple(images))


@pytest.mark.slow
def test_a_fit_tells_white_balances_and_fits_see_pictures_of_one(even: Views) -> None:
    random = np.random.default_rng(2)
    logs = random.normal(scale=0.1, size=(len(even.cameras), 3)) * [1, 0, 1]
    tints = np.exp(logs - logs.mean(0))
    varied = balanced(even, tints)
    found = with_gains_of_fit(varied, lambda target: true_picture(even, target))
    assert found.gains is None and found.tints is not None
    assert float(np.abs(np.log(found.tints) - np.log(tints)).max()) < 0.02
    again = with_gains_of_fit(found, lambda target: true_picture(even, target))
    assert again.tints is not None and float(np.abs(np.log(again.tints) - np.log(tints)).max()) < 0.01
    for target, true in zip(view_targets(again, 1.0, CPU), view_targets(even, 1.0, CPU), strict=True):
        inside = (true.mask > 0.99)[..., None] & (true.saturation < 0.85)
        assert float((target.saturation - true.saturation)[inside.expand_as(true.saturation)].abs().max()) < 0.02
        assert float(target.saturation.max()) <= target.ceiling <= 1.2


def test_a_channel_that_is_cut_off_bounds_all(even: Views) -> None:
    image = torch.full_like(even.images_srgb[0], 255)
    white = replace(even, images_srgb=(image,) * len(even.cameras), tints=((1.2, 1.0, 0.8),) * len(even.cameras))
    target = view_targets(white, 1.0, CPU)[0]
    assert target.ceiling == pytest.approx(float(srgb_from_linear(torch.tensor(1 / 1.2))))
    assert torch.equal(target.saturation, torch.full_like(target.saturation, target.ceiling))


def test_what_cannot_be_compared_has_the_mean_exposure(even: Views) -> None:
    varied = exposed(even, some_stops(len(even.cameras)))

    def nothing(target: ViewTarget) -> tuple[Tensor, Tensor]:
        radiance, mask = true_picture(even, target)
        return radiance, mask * (target.camera.name != even.cameras[3].name)

    found = with_gains_of_fit(varied, nothing)
    assert found.gains is not None and found.gains[3] == 1.0
    assert spread([float("nan")] * 4) == 0.0
    assert with_gains(even, [float("nan")] * len(even.cameras)).gains == (1.0,) * len(even.cameras)


def test_targets_of_one_exposure_are_the_photographs_but_for_what_was_clipped(even: Views) -> None:
    stops = some_stops(len(even.cameras), seed=2)
    for target, same in zip(view_targets(with_gains(exposed(even, stops), stops), 1.0, CPU), view_targets(even, 1.0, CPU), strict=True):
        clipped = target.saturation >= 0.98 * target.ceiling
        difference = (target.saturation - same.saturation).abs()
        # Eight bits of a picture a stop darker are steps of two to four.
        assert float(difference[~clipped].max()) < 0.02
        # What the sensor clipped says only that it was as bright at least: no picture that is brighter is held against it.
        shown = display_image(linear_from_srgb(same.saturation), torch.ones_like(same.mask), target.saturation, target.ceiling)
        assert float((shown - target.saturation)[clipped].abs().max() if clipped.any() else 0.0) < 0.02


def _write_exif(path: Path, seconds: float, sensitivity: int, f_number: float) -> None:
    with Image.open(path) as image:
        exif = Image.Exif()
        exif[EXIF] = {TIME: seconds, SENSITIVITY: sensitivity, F_NUMBER: f_number}
        image.save(path, exif=exif)


def test_what_cameras_wrote_is_read(tmp_path: Path) -> None:
    folder = tiny.write_nerf_synthetic(tmp_path)
    pictures = sorted((folder / "train").glob("*.png"))
    for number, path in enumerate(pictures):
        _write_exif(path, 0.01 * (1 + number % 2), 100 if number % 3 else 200, 2.0)
    views = load_views(folder)
    assert views.gains is not None
    expected = np.array([number % 2 + (0 if number % 3 else 1) for number in range(len(pictures))], float)
    np.testing.assert_allclose(np.log2(views.gains), expected - expected.mean(), atol=1e-6)
    _write_exif(pictures[0], 0.0, 100, 2.0)
    assert load_views(folder).gains is None


def test_files_that_agree_or_say_nothing_give_no_gains() -> None:
    assert gains_of_files([None, 1.0]) is None and gains_of_files([]) is None
    assert gains_of_files([1.0, 1.01, 0.99]) is None
    assert gains_of_files([1.0, 4.0]) == pytest.approx((0.5, 2.0))
