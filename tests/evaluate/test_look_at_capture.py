"""What can be seen of a capture before a build: cameras as they stand, points and a box where the object is, bounded however large the capture."""

import json
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest
from PIL import Image

from drgs.evaluate import look_at_capture as looking
from drgs.evaluate.look_at_capture import look_at_capture
from tests.reconstruct.tiny_capture import FX, SPHERE_CENTER, SPHERE_RADIUS, VIEWS, WIDTH, camera_positions, write_nerf_synthetic


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_nerf_synthetic(tmp_path_factory.mktemp("look") / "capture")


@pytest.mark.slow
def test_cameras_points_and_box_of_a_ball_are_where_they_are(capture: Path, tmp_path: Path) -> None:
    look = look_at_capture(capture, tmp_path / "sheet.jpg", "Ball")
    json.dumps(look, allow_nan=False)
    assert look["ok"] and look["camera_count"] == len(look["cameras"]) == VIEWS
    places = np.array([camera["world_from_camera"] for camera in look["cameras"]])[:, :3, 3]
    assert np.allclose(places, camera_positions(VIEWS), atol=1e-4)
    first = look["cameras"][0]
    assert first["left"] == pytest.approx(-WIDTH / 2 / FX) and first["right"] == pytest.approx(WIDTH / 2 / FX)
    assert look["box_origin"] == "masks"
    # Pictures are 72 pixels wide: a pixel is 0.033 at the ball.
    assert np.allclose(look["box_low"], SPHERE_CENTER - SPHERE_RADIUS, atol=0.05)
    assert np.allclose(look["box_high"], SPHERE_CENTER + SPHERE_RADIUS, atol=0.05)
    outermost = np.array(look["outermost"]).reshape(-1, 3)
    assert (outermost.min(0).tolist(), outermost.max(0).tolist()) == (look["box_low"], look["box_high"])
    # In any other direction they are as far apart as the ball is wide, too.
    directions = np.random.default_rng(0).normal(size=(3, 50))
    assert np.ptp(outermost @ (directions / np.linalg.norm(directions, axis=0)), axis=0) == pytest.approx(2 * SPHERE_RADIUS, abs=0.12)
    points = np.array(look["points"]).reshape(-1, 3)
    assert 500 < len(points) <= looking.MOST_POINTS and len(look["colors"]) == len(look["points"])
    assert np.linalg.norm(points - SPHERE_CENTER, axis=1) == pytest.approx(SPHERE_RADIUS, abs=0.1)
    with Image.open(tmp_path / "sheet.jpg") as sheet:
        assert look["has_sheet"] and sheet.format == "JPEG" and min(sheet.size) > 200
        check_tiles(np.asarray(sheet.convert("RGB"), float), look["sheet"])


def check_tiles(sheet: np.ndarray, layout: dict) -> None:
    """Each tile begins and ends where the layout says: on the ground of the sheet, and with a picture in it."""
    height, width, _ = sheet.shape
    assert layout["count"] == VIEWS
    for number in (0, layout["columns"] - 1, VIEWS - 1):
        row, column = divmod(number, layout["columns"])
        left, top = width * (layout["left"] + column * layout["across"]), height * (layout["top"] + row * layout["down"])
        right, bottom = left + width * layout["width"], top + height * layout["down"]
        assert (right - left) / (bottom - top) == pytest.approx(layout["aspect"], rel=0.02)
        tile, gap = (
            sheet[round(top) : round(bottom), round(left) : round(right)],
            sheet[round(top) : round(bottom), round(left) - 3 : round(left) - 1],
        )
        assert tile.max() > 150 and gap.max() < 60, number


@pytest.mark.slow
def test_of_very_many_cameras_and_points_some_are_told(capture: Path, tmp_path: Path) -> None:
    with patch.multiple(looking, MOST_CAMERAS=7, MOST_POINTS=50):
        look = look_at_capture(capture, tmp_path / "sheet.jpg", "Ball")
    assert look["camera_count"] == VIEWS and len(look["cameras"]) == 7 and len(look["points"]) == 150
    assert len({camera["name"] for camera in look["cameras"]}) == 7


def test_what_cannot_be_read_has_findings_and_its_pictures(capture: Path, tmp_path: Path) -> None:
    broken = tmp_path / "broken"
    broken.mkdir()
    (broken / "transforms_train.json").write_text("{")
    Image.new("RGB", (40, 30), "red").save(broken / "a.png")
    look = look_at_capture(broken, tmp_path / "sheet.jpg", "Broken")
    assert not look["ok"] and look["findings"][0]["level"] == "error" and look["has_sheet"]
    assert (look["camera_count"], look["cameras"], look["box_low"], look["points"]) == (0, [], None, [])
    assert look["findings"][0]["sentence"].startswith("transforms_train.json: ") and str(tmp_path) not in json.dumps(look)
    (broken / "a.png").unlink()
    assert look_at_capture(broken, tmp_path / "none.jpg", "Broken")["has_sheet"] is False


def test_a_capture_is_called_by_its_name(tmp_path: Path) -> None:
    few = tmp_path / "c0ffee"
    few.mkdir()
    Image.new("RGB", (40, 30), "red").save(few / "a.png")
    with patch.object(looking, "contact_sheet", side_effect=ValueError) as drawn:
        look = look_at_capture(few, tmp_path / "sheet.jpg", 'Mug "blue"')
    assert look["findings"][0]["sentence"].startswith('Mug "blue": 1 pictures') and look["sheet"] is None
    assert drawn.call_args.args[1]["findings"] == look["findings"], "the sheet says the same"


def test_pictures_without_poses_have_a_sheet_and_no_cameras(tmp_path: Path) -> None:
    photographs = tmp_path / "photographs"
    photographs.mkdir()
    random = np.random.default_rng(0)
    for number in range(12):
        Image.fromarray(random.integers(0, 255, (60, 80, 3), np.uint8)).save(photographs / f"{number}.jpg")
    look = look_at_capture(photographs, tmp_path / "sheet.jpg", "Photographs")
    assert look["ok"] and look["has_sheet"] and look["camera_count"] == 0 and look["box_low"] is None
