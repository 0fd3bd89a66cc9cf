"""A sheet shows every picture once, what its mask says, and which of them the doctor complains about."""

import math
import weakref
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from drgs.cli import app
from drgs.evaluate.contact_sheet import BAD, GOOD, GUESSED, MOST_BYTES, NARROWEST, WIDTH, contact_sheet, grid_for
from drgs.reconstruct.capture.small_picture import PictureFile, SmallPicture, small_picture
from tests.evaluate import painted_balls as balls


def report_on(*sentences: str, source: str = "nerf-synthetic", **marks: list[str]) -> dict:
    findings = [{"level": "warning", "sentence": sentence, "advice": ""} for sentence in sentences]
    return {"summary": "Pictures.", "source": source, "findings": findings, "marks": marks}


def pixels_of(path: Path) -> np.ndarray:
    with Image.open(path) as sheet:
        return np.asarray(sheet.convert("RGB"))


def places_of(pixels: np.ndarray, ink: tuple[int, int, int]) -> np.ndarray:
    return np.argwhere((pixels == ink).all(-1))


def tile_corners(pixels: np.ndarray, count: int) -> list[tuple[int, int]]:
    """Row and column of each picture's corner: the grid ends where the sheet ends."""
    grid = grid_for(count)
    top = pixels.shape[0] - grid.rows * grid.tile_height
    return [(top + number // grid.columns * grid.tile_height, 4 + number % grid.columns * (grid.side + 4)) for number in range(count)]


@pytest.mark.parametrize("count", [9, 24, 69, 120, 200])
def test_tiles_fill_the_sheets_width_and_stay_large_enough_for_a_name(count: int) -> None:
    grid = grid_for(count)
    assert grid.columns * grid.rows >= count > grid.columns * (grid.rows - 1)
    assert grid.side >= NARROWEST and grid.letter >= 11
    assert grid.columns * (grid.side + 4) <= WIDTH + 4
    assert 0.9 < grid.columns * grid.side / (grid.rows * grid.tile_height) < 2.2


def test_outlines_are_drawn_and_what_is_outside_is_dimmed(tmp_path: Path) -> None:
    taken = balls.pictures(balls.camera_positions(9))
    folder = balls.write_masks(balls.write_capture(tmp_path / "capture", taken))
    for path in (folder / "train").glob("*.png"):
        pixels = np.array(Image.open(path))
        pixels[:6, :6] = 200  # something beside the object
        Image.fromarray(pixels).save(path)
    contact_sheet(folder, report_on(), tmp_path / "sheet.png")
    pixels = pixels_of(tmp_path / "sheet.png")
    side = balls.SIDE
    for (row, column), picture in zip(tile_corners(pixels, 9), taken, strict=True):
        start = column + (grid_for(9).side - side) // 2, row + (grid_for(9).side - side) // 2
        shown = pixels[start[1] : start[1] + side, start[0] : start[0] + side]
        mask = picture.rgba[..., 3] > 0
        outline = (shown == GOOD).all(-1)
        assert outline.sum() > 0.5 * math.sqrt(4 * math.pi * mask.sum()) and not (outline & mask).any()
        assert np.array_equal(shown[mask], picture.rgba[..., :3][mask])
        assert (shown[:4, :4] == 60).all()


def test_marked_pictures_stand_out_and_the_others_do_not(tmp_path: Path) -> None:
    folder = balls.write_capture(tmp_path / "capture")
    contact_sheet(folder, report_on("Two are bad.", r_003=["blurred"], r_017=["mask differs", "copy"]), tmp_path / "sheet.png")
    pixels = pixels_of(tmp_path / "sheet.png")
    side = grid_for(balls.VIEWS).side
    marked = [
        number
        for number, (row, column) in enumerate(tile_corners(pixels, balls.VIEWS))
        if len(places_of(pixels[row : row + side, column : column + side], BAD)) > 4 * side
    ]
    assert marked == [3, 17]


def test_a_picture_that_cannot_be_read_is_crossed_out(tmp_path: Path) -> None:
    folder = balls.write_capture(tmp_path / "capture")
    (folder / "train" / "r_004.png").write_bytes((folder / "train" / "r_004.png").read_bytes()[:200])
    contact_sheet(folder, report_on(), tmp_path / "sheet.png")
    pixels = pixels_of(tmp_path / "sheet.png")
    row, column = tile_corners(pixels, balls.VIEWS)[4]
    side = grid_for(balls.VIEWS).side
    assert (pixels[row + side // 2 - 3 : row + side // 2 + 3, column + side // 2] == BAD).all(-1).any()


def test_a_plain_backdrop_is_outlined_as_a_guess(tmp_path: Path) -> None:
    folder = tmp_path / "photos"
    folder.mkdir()
    for number in range(8):
        y, x = np.mgrid[:240, :320]
        picture = np.where((np.hypot(x - 160, y - 120 - number) < 60)[..., None], [150, 60, 40], [225, 225, 220]).astype(np.uint8)
        Image.fromarray(picture).save(folder / f"{number}.png")
    contact_sheet(folder, report_on(source="photographs"), tmp_path / "sheet.png")
    pixels = pixels_of(tmp_path / "sheet.png")
    side = grid_for(8).side
    for row, column in tile_corners(pixels, 8):
        assert len(places_of(pixels[row : row + side, column : column + side], GUESSED)) > 200
    assert len(places_of(pixels, GOOD)) == 0


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_two_hundred_pictures_make_a_small_file_one_at_a_time(suffix: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    alive: weakref.WeakSet[SmallPicture] = weakref.WeakSet()
    most = 0

    def watched(file: PictureFile, side: int) -> SmallPicture:
        nonlocal most
        picture = small_picture(file, side)
        alive.add(picture)
        most = max(most, len(alive))
        return picture

    monkeypatch.setattr("drgs.evaluate.contact_sheet.small_picture", watched)
    random = np.random.default_rng(0)
    grain = Image.fromarray(random.integers(0, 255, (100, 133, 3), np.uint8)).resize((1200, 900))  # hard to compress, as photographs are
    (tmp_path / "photos").mkdir()
    grain.save(tmp_path / "photos" / "000.jpg")
    for number in range(1, 200):
        (tmp_path / "photos" / f"{number:03d}.jpg").hardlink_to(tmp_path / "photos" / "000.jpg")
    out = tmp_path / f"sheet{suffix}"
    contact_sheet(tmp_path / "photos", report_on(), out)
    assert out.stat().st_size <= MOST_BYTES and most <= 2
    with Image.open(out) as sheet:
        assert sheet.format == {".png": "PNG", ".jpg": "JPEG"}[suffix] and sheet.width > 1500


def test_the_command_draws_the_sheet_of_a_capture_that_is_refused_too(tmp_path: Path) -> None:
    folder = balls.write_capture(tmp_path / "capture")
    (folder / "train" / "r_004.png").write_bytes(b"")
    result = CliRunner().invoke(app, ["doctor", str(folder), "--sheet", str(tmp_path / "sheet.jpg")])
    assert result.exit_code == 1 and "the file is empty). Copy it from the camera once more" in result.stderr
    assert Image.open(tmp_path / "sheet.jpg").width > 1000
    result = CliRunner().invoke(app, ["doctor", str(folder), "--sheet", str(tmp_path / "sheet.webp")])
    assert result.exit_code == 2 and "expected a file that ends with .png or .jpg" in result.stderr
    (tmp_path / "film.mp4").write_bytes(b"\0" * 100)
    result = CliRunner().invoke(app, ["doctor", str(tmp_path / "film.mp4"), "--sheet", str(tmp_path / "film.png")])
    assert result.exit_code == 1 and "of a film, find poses first" in result.stderr
