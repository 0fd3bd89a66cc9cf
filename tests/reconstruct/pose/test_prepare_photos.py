"""Pictures are turned upright, alpha becomes a mask, and damaged ones are left out with a reason."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageFilter

from drgs.reconstruct.pose.explain_failure import blurred_photos, check_readable
from drgs.reconstruct.pose.list_photos import list_photos
from drgs.reconstruct.pose.prepare_photos import PreparedPhoto, prepare_photos
from drgs.reconstruct.progress import BuildStopped

ORIENTATION, EXIF_FOLDER, FOCAL_35MM = 0x0112, 0x8769, 0xA405


def grain(seed: int) -> Image.Image:
    return Image.fromarray(np.random.default_rng(seed).integers(0, 255, (60, 80, 3), np.uint8))


def prepare(folder: Path) -> tuple[dict[str, PreparedPhoto], dict[str, str]]:
    prepared, left_out = prepare_photos(list_photos(folder), folder.parent / "work", lambda done: None, lambda: False)
    return {photo.name: photo for photo in prepared}, left_out


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    folder = tmp_path / "photos"
    folder.mkdir()
    for number in range(8):
        grain(number).save(folder / f"{number}.png")
    return folder


def test_pictures_are_turned_as_exif_says_and_keep_their_focal_length(photos: Path):
    exif = Image.Exif()
    exif[ORIENTATION] = 6  # a quarter turn clockwise
    exif.get_ifd(EXIF_FOLDER)[FOCAL_35MM] = 50
    grain(9).save(photos / "turned.jpg", quality=95, exif=exif)
    photo = prepare(photos)[0]["turned"]
    assert (photo.width, photo.height) == (60, 80)
    assert photo.focal_pixels == pytest.approx(50 / 43.2666 * 100)
    with Image.open(photos.parent / "work" / "images" / photo.file) as upright, Image.open(photos / "turned.jpg") as as_stored:
        assert upright.size == (60, 80) and upright.getexif().get(ORIENTATION, 1) == 1
        difference = np.asarray(upright).astype(int) - np.rot90(np.asarray(as_stored), -1)
    assert np.abs(difference).mean() < 3


def test_alpha_is_a_mask_unless_it_is_opaque_everywhere(photos: Path):
    opaque = grain(9).convert("RGBA")
    opaque.save(photos / "opaque.png")
    cut = np.asarray(opaque).copy()
    cut[:, :40, 3] = 0
    Image.fromarray(cut).save(photos / "cut.png")
    prepared, _ = prepare(photos)
    assert prepared["cut"].has_mask and not prepared["opaque"].has_mask
    with Image.open(photos.parent / "work" / "masks" / "cut.png.png") as mask:
        assert (np.asarray(mask)[:, :40] == 0).all() and (np.asarray(mask)[:, 40:] == 255).all()
    with pytest.raises(ValueError, match="9 of 10 pictures have neither transparency nor a mask"):
        check_readable(photos, list(prepared.values()), {})


def test_damaged_pictures_and_copies_are_left_out_with_a_reason(photos: Path):
    (photos / "empty.jpg").touch()
    (photos / "torn.png").write_bytes((photos / "0.png").read_bytes()[:3000])
    (photos / "copy.png").write_bytes((photos / "3.png").read_bytes())
    (photos / "text.jpg").write_text("hello")
    prepared, left_out = prepare(photos)
    assert len(prepared) == 8
    assert left_out["copy"] == "the same file as 3" or left_out["3"] == "the same file as copy"
    assert "truncated" in left_out["torn"] and "not a readable" in left_out["empty"] and "not a readable" in left_out["text"]
    half = list(prepared.values())[:4]
    with pytest.raises(ValueError, match=r"4 of 8 pictures can be used, expected at least 8 \(.*not a readable"):
        check_readable(photos, half, left_out)


def test_a_mask_of_another_size_is_a_reason(photos: Path):
    (photos / "masks").mkdir()
    for number in range(8):
        Image.new("L", (80, 60) if number else (60, 80), 255).save(photos / "masks" / f"{number}.png")
    assert prepare(photos)[1] == {"0": "its mask 0.png is 60x80, the upright picture 80x60 pixels"}


def test_blurred_pictures_are_named(photos: Path):
    grain(9).filter(ImageFilter.GaussianBlur(2)).save(photos / "soft.png")
    assert blurred_photos(list(prepare(photos)[0].values())) == ["soft"]


def test_preparing_stops_when_asked(photos: Path):
    with pytest.raises(BuildStopped):
        prepare_photos(list_photos(photos), photos.parent / "work", lambda done: None, lambda: True)
