"""Undistorted pictures: what a pinhole would have seen, nothing blank, masks and colour in step."""

import numpy as np
import pytest

from drgs.reconstruct.capture.load_views.capture import Pinhole
from drgs.reconstruct.capture.load_views.undistort import optics_of, undistort, undistorted_pinhole
from drgs.scene.lens import PARAMETER_NAMES, Lens, pixels_from_plane
from tests.reconstruct.tiny_capture import plane_from_pixels

COEFFICIENTS = {
    "SIMPLE_RADIAL": (-0.12,),
    "RADIAL": (-0.12, 0.03),
    "OPENCV": (-0.12, 0.03, 0.004, -0.003),
    "OPENCV_FISHEYE": (-0.05, 0.02, -0.006, 0.001),
    "FULL_OPENCV": (0.3, -0.1, 0.004, -0.003, 0.02, 0.25, -0.04, 0.01),
    "FOV": (0.9,),
    "SIMPLE_RADIAL_FISHEYE": (-0.06,),
    "RADIAL_FISHEYE": (-0.06, 0.01),
    "THIN_PRISM_FISHEYE": (-0.05, 0.02, 0.004, -0.003, -0.006, 0.001, 0.005, -0.002),
    "RAD_TAN_THIN_PRISM_FISHEYE": (0.1, -0.05, 0.02, -0.01, 0.003, -0.0005, 0.004, -0.003, 0.002, -0.001, 0.003, -0.0007),
    "SIMPLE_DIVISION": (-0.15,),
    "DIVISION": (0.1,),
    "SIMPLE_FISHEYE": (),
    "FISHEYE": (),
    "EUCM": (0.6, 1.1),
}
"""Of moderate lenses; DIVISION and FULL_OPENCV bend outwards (pincushion)."""


def lens_of(model: str, coefficients: tuple[float, ...] | None = None, focal: float = 500.0, size: tuple[int, int] = (640, 480)) -> Lens:
    """A little off its picture's middle."""
    focals = (focal,) if PARAMETER_NAMES[model][0] == "f" else (focal, 0.96 * focal)
    middle = (0.5 * size[0] - 10, 0.5 * size[1] + 10)
    return Lens(model, (*focals, *middle, *(COEFFICIENTS[model] if coefficients is None else coefficients)), *size)


def plane_of(pinhole: Pinhole) -> np.ndarray:
    """(height, width, 2) directions (x, y, 1) through the pixels' centres."""
    x, y = np.meshgrid(np.arange(pinhole.width) + 0.5, np.arange(pinhole.height) + 0.5)
    return np.stack([(x - pinhole.cx) / pinhole.fx, (y - pinhole.cy) / pinhole.fy], -1)


def plane_of_lens(lens: Lens) -> np.ndarray:
    """(height, width, 2), the same of the picture as it was taken."""
    return plane_from_pixels(lens, np.stack(np.meshgrid(np.arange(lens.width) + 0.5, np.arange(lens.height) + 0.5), -1))


@pytest.mark.parametrize("model", COEFFICIENTS)
def test_no_pixel_lies_outside_the_picture_and_little_of_it_is_lost(model: str) -> None:
    lens = lens_of(model)
    pinhole = undistorted_pinhole(lens, "capture")
    places = pixels_from_plane(lens, plane_of(pinhole))
    assert (places >= 0).all() and (places <= (lens.width, lens.height)).all()
    covered = places.max((0, 1)) - places.min((0, 1))
    assert (covered > 0.93 * np.array([lens.width, lens.height])).all()


@pytest.mark.parametrize("model", COEFFICIENTS)
def test_the_middle_keeps_its_magnification(model: str) -> None:
    lens = lens_of(model)
    pinhole = undistorted_pinhole(lens, "capture")
    step = np.array([[1e-3, 0], [0, 1e-3]])
    np.testing.assert_allclose(pixels_from_plane(lens, step) - lens.principal_point, np.diag([pinhole.fx, pinhole.fy]) * 1e-3, atol=1e-4)


def smooth_pattern(plane: np.ndarray, focal: float) -> np.ndarray:
    """8-bit sRGB of waves some 50 pixels long."""
    x, y = np.moveaxis(plane, -1, 0) * focal / 500
    waves = np.stack([np.sin(60 * x + 20 * y), np.sin(55 * y), np.cos(40 * (x - y))], -1)
    return np.round(127.5 + 90 * waves).astype(np.uint8)


@pytest.mark.slow
@pytest.mark.parametrize("model", COEFFICIENTS)
def test_a_pattern_seen_through_a_lens_becomes_the_one_seen_through_the_pinhole(model: str) -> None:
    focal = 275.0
    lens = lens_of(model, focal=focal, size=(352, 264))
    pinhole = undistorted_pinhole(lens, "capture")
    seen = smooth_pattern(plane_of_lens(lens), focal)
    color, alpha = undistort(seen, np.full(seen.shape[:2], 255, np.uint8), lens, pinhole)
    error = np.abs(color.astype(int) - smooth_pattern(plane_of(pinhole), focal))
    assert (alpha == 255).all()
    assert error.mean() < 0.7 and error.max() <= 4  # of 255: rounding twice, and bilinear interpolation of the waves


@pytest.mark.slow
@pytest.mark.parametrize("model", ["OPENCV", "FOV", "DIVISION", "THIN_PRISM_FISHEYE"])
def test_masks_stay_aligned_to_a_fraction_of_a_pixel(model: str) -> None:
    lens = lens_of(model)
    pinhole = undistorted_pinhole(lens, "capture")
    radius, around = 0.4, plane_of_lens(lens)
    # Shares of pixels that the disc covers, from its distance: the mask's edge is one pixel wide.
    slope = np.hypot(*np.gradient(np.hypot(*np.moveaxis(around, -1, 0))))
    mask = np.clip(0.5 + (radius - np.hypot(*np.moveaxis(around, -1, 0))) / slope, 0, 1)
    _, alpha = undistort(np.zeros((*mask.shape, 3), np.uint8), np.round(mask * 255).astype(np.uint8), lens, pinhole)
    rows = np.arange(int(pinhole.cy - 0.6 * radius * pinhole.fy), int(pinhole.cy + 0.6 * radius * pinhole.fy))
    half = np.sqrt(radius**2 - ((rows + 0.5 - pinhole.cy) / pinhole.fy) ** 2) * pinhole.fx
    middle = int(pinhole.cx)
    left, right = alpha[rows, :middle].sum(1) / 255, alpha[rows, middle:].sum(1) / 255
    for error in (left - (middle - (pinhole.cx - half)), right - (pinhole.cx + half - middle)):
        assert abs(error.mean()) < 0.02
        assert np.abs(error).max() < 0.12  # of single rows, whose edge is two pixels of 8 bits


def test_the_backgrounds_color_does_not_bleed_into_the_object() -> None:
    lens = lens_of("OPENCV")
    color, alpha = np.full((480, 640, 3), (0, 255, 0), np.uint8), np.zeros((480, 640), np.uint8)
    color[100:300, 200:400], alpha[100:300, 200:400] = 200, 255
    color, alpha = undistort(color, alpha, lens, undistorted_pinhole(lens, "capture"))
    assert ((alpha > 0) & (alpha < 255)).any()
    assert (color[alpha > 8] == 200).all()


def test_light_is_averaged_not_its_code() -> None:
    lens = lens_of("SIMPLE_RADIAL")
    color = np.zeros((480, 640, 3), np.uint8)
    color[:, ::2] = 255
    color, _ = undistort(color, np.full((480, 640), 255, np.uint8), lens, undistorted_pinhole(lens, "capture"))
    # Stripes a pixel wide keep their mean light, 0.5, which sRGB writes as 188.
    light = np.where(color <= 0.04045 * 255, color / 255 / 12.92, ((color / 255 + 0.055) / 1.055) ** 2.4)
    assert light.mean() == pytest.approx(0.5, abs=0.01)


@pytest.mark.parametrize(("width", "height", "degrees"), [(640, 480, 180), (640, 640, 200), (800, 600, 230)])
def test_a_fisheye_of_half_the_world_becomes_a_picture_of_bounded_size_and_angle(width: int, height: int, degrees: float) -> None:
    lens = lens_of("SIMPLE_FISHEYE", focal=width / np.radians(degrees), size=(width, height))
    pinhole = undistorted_pinhole(lens, "capture")
    assert pinhole.width <= 2 * width and pinhole.height <= 2 * height
    corners = plane_of(pinhole)[[0, 0, -1, -1], [0, -1, 0, -1]]
    angles = np.degrees(np.arctan(np.hypot(*corners.T)))
    assert (angles < 70).all() and angles.max() > 60
    places = pixels_from_plane(lens, plane_of(pinhole))
    assert (places >= 0).all() and (places <= (width, height)).all()


def test_a_picture_that_would_grow_too_much_is_made_smaller() -> None:
    lens = lens_of("FOV", (2.6,), focal=200.0)
    pinhole = undistorted_pinhole(lens, "capture")
    assert max(pinhole.width / lens.width, pinhole.height / lens.height) == pytest.approx(2, abs=0.01)
    assert pinhole.fy / pinhole.fx == pytest.approx(0.96, rel=1e-6)


@pytest.mark.parametrize("coefficients", [(-0.9, 0.0, 0.0, 0.0), (0.0, 0.0, 3.0, 0.0), (0.3, -1.2, 0.0, 0.0), (-1e30, 0.0, 0.0, 0.0)])
def test_a_lens_that_folds_its_picture_is_refused(coefficients: tuple[float, ...]) -> None:
    with pytest.raises(ValueError, match=r"cup/cameras\.txt: lens OPENCV \(k1 = .* folds the 640x480 image over itself, expected one"):
        undistorted_pinhole(lens_of("OPENCV", coefficients), "cup/cameras.txt")


def test_a_fold_beyond_the_pictures_edge_does_not_matter() -> None:
    # It turns back at a distance of 1.05; the picture's corners are at 0.8.
    assert undistorted_pinhole(lens_of("SIMPLE_RADIAL", (-0.3,), focal=650.0), "capture").width > 640


@pytest.mark.parametrize(
    ("lens", "sentence"),
    [
        (lens_of("OPENCV", (float("nan"), 0.0, 0.0, 0.0)), "k1 = nan.*finite"),
        (lens_of("OPENCV", (0.1, 0.0, float("inf"), 0.0)), "p1 = inf.*finite"),
        (lens_of("FISHEYE", focal=3.0), "focal length fx = 3 pixels"),
        (Lens("SIMPLE_FISHEYE", (500.0, -1.0, 240.0), 640, 480), r"principal point \(-1, 240\) lies outside the 640x480 image"),
        (lens_of("DIVISION", (4.0,)), "DIVISION .* folds"),
        (lens_of("EUCM", (0.1, -5.0)), "EUCM .* folds"),
    ],
)
def test_a_lens_that_cannot_be_is_refused_in_one_sentence(lens: Lens, sentence: str) -> None:
    with pytest.raises(ValueError, match=f"^capture: .*{sentence}") as refusal:
        undistorted_pinhole(lens, "capture")
    assert "\n" not in str(refusal.value)


def test_a_lens_without_distortion_is_a_pinhole_of_the_same_picture() -> None:
    assert optics_of(lens_of("OPENCV", (0.0,) * 4), "capture") == (Pinhole(500.0, 480.0, 310.0, 250.0, 640, 480), None)
    assert optics_of(Lens("SIMPLE_PINHOLE", (500.0, 310.0, 250.0), 640, 480), "capture")[1] is None
    assert optics_of(lens_of("FISHEYE"), "capture")[1] == lens_of("FISHEYE")
