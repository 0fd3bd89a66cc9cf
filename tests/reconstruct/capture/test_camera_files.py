"""HEIC and RAW are read as any other photograph; where their readers are missing, a sentence says how to install them."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from drgs.evaluate.contact_sheet import contact_sheet
from drgs.evaluate.doctor import doctor
from drgs.exchange.pictures import exif_number, read_exif
from drgs.reconstruct.capture import camera_files
from drgs.reconstruct.capture.camera_files import opened_photograph, without_developed
from drgs.reconstruct.capture.small_picture import PictureFile, small_picture
from drgs.reconstruct.pose.list_photos import FEWEST_PHOTOS, any_photo, list_photos
from drgs.reconstruct.pose.prepare_photos import EXIF_FOCAL_35MM, EXIF_FOLDER, prepare_photos
from tests.reconstruct.capture.raw_file import write_dng

HEIGHT, WIDTH = 120, 160


def landscape(shift: float = 0.0) -> np.ndarray:
    """(height, width, 3) sRGB 0..1: soft, since a mosaic shows no more, and of other colours on all four sides."""
    down, across = np.meshgrid(np.linspace(0, 1, HEIGHT), np.linspace(0, 1, WIDTH), indexing="ij")
    return np.stack([0.2 + 0.6 * across, 0.2 + 0.5 * down, 0.5 + 0.3 * np.sin(6 * across + shift)], -1)


def linear_of(srgb: np.ndarray) -> np.ndarray:
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def test_a_raw_file_is_developed_to_the_colours_that_were_seen(tmp_path: Path) -> None:
    pytest.importorskip("rawpy")
    seen = landscape()
    write_dng(tmp_path / "a.DNG", linear_of(seen))
    write_dng(tmp_path / "dim.dng", linear_of(seen) / 4)
    write_dng(tmp_path / "turned.dng", linear_of(seen), orientation=6)
    with opened_photograph(tmp_path / "a.DNG") as picture, opened_photograph(tmp_path / "turned.dng") as turned:
        found, upright = (np.asarray(image, float) / 255 for image in (picture, turned))
    inner = slice(4, -4), slice(4, -4)
    assert found.shape == (HEIGHT, WIDTH, 3)
    assert np.abs(found[inner] - seen[inner]).mean() < 0.01 and np.abs(found[inner] - seen[inner]).max() < 0.04
    # LibRaw turns what the camera was turned, and nobody does so again.
    assert upright.shape == (WIDTH, HEIGHT, 3) and np.abs(np.rot90(upright)[inner] - seen[inner]).max() < 0.04
    with opened_photograph(tmp_path / "dim.dng") as picture:
        dim = linear_of(np.asarray(picture, float) / 255)
    assert np.median(dim[inner] / linear_of(seen)[inner]) == pytest.approx(0.25, rel=0.05), "no picture is brightened by itself"


def test_a_small_raw_picture_is_developed_small(tmp_path: Path) -> None:
    pytest.importorskip("rawpy")
    write_dng(tmp_path / "a.dng", linear_of(landscape()))
    with opened_photograph(tmp_path / "a.dng", 80) as half, opened_photograph(tmp_path / "a.dng", 81) as whole:
        assert (half.size, whole.size) == ((WIDTH // 2, HEIGHT // 2), (WIDTH, HEIGHT))
    small = small_picture(PictureFile("a", tmp_path / "a.dng", turned_by_exif=True), 40).color_srgb
    assert small.shape == (30, 40, 3) and np.abs(small[2:-2, 2:-2] / 255 - landscape()[1::4, 1::4][2:-2, 2:-2]).max() < 0.05


def test_a_damaged_raw_file_is_named(tmp_path: Path) -> None:
    pytest.importorskip("rawpy")
    (tmp_path / "a.dng").write_bytes(b"II*\0" + bytes(100))
    with pytest.raises(ValueError, match=r"a\.dng: not a readable RAW file"), opened_photograph(tmp_path / "a.dng"):
        pass


def test_a_telephones_pictures_are_read_with_their_focal_length(tmp_path: Path) -> None:
    pillow_heif = pytest.importorskip("pillow_heif")
    pillow_heif.register_heif_opener()
    picture = Image.fromarray((255 * landscape()).round().astype(np.uint8))
    exif = Image.Exif()
    exif.get_ifd(EXIF_FOLDER)[EXIF_FOCAL_35MM] = 26
    picture.save(tmp_path / "IMG_1.HEIC", "HEIF", exif=exif.tobytes(), quality=95)
    with opened_photograph(tmp_path / "IMG_1.HEIC") as image:
        assert np.abs(np.asarray(image.convert("RGB"), float) / 255 - landscape()).mean() < 0.02
        assert exif_number(read_exif(image, EXIF_FOLDER), EXIF_FOCAL_35MM) == 26


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["heic", "dng"])
def test_a_folder_of_such_pictures_is_one_of_photographs(tmp_path: Path, kind: str) -> None:
    pillow_heif = pytest.importorskip("pillow_heif") if kind == "heic" else pytest.importorskip("rawpy")
    photos = tmp_path / "photos"
    photos.mkdir()
    for number in range(FEWEST_PHOTOS):
        if kind == "dng":
            write_dng(photos / f"{number}.dng", linear_of(landscape(number)))
        else:
            pillow_heif.register_heif_opener()
            Image.fromarray((255 * landscape(number)).round().astype(np.uint8)).save(photos / f"{number}.heic", "HEIF")
    listed = list_photos(photos)
    prepared, left_out = prepare_photos(listed, tmp_path / "work", lambda done: None, lambda: False)
    assert (len(prepared), left_out) == (FEWEST_PHOTOS, {})
    assert all((photo.width, photo.height, photo.file[-4:]) == (WIDTH, HEIGHT, ".jpg") for photo in prepared)
    report = doctor(photos)
    contact_sheet(photos, report, tmp_path / "sheet.png")
    assert report["ok"] and Image.open(tmp_path / "sheet.png").width > 300


def test_of_a_picture_that_was_developed_already_the_raw_file_is_left_aside(tmp_path: Path) -> None:
    names = ["a.CR2", "a.JPG", "b.nef", "left/b.jpg", "left/b.RAF", "c.heic"]
    kept = without_developed([tmp_path / name for name in names])
    assert [str(path.relative_to(tmp_path)) for path in kept] == ["a.JPG", "b.nef", "left/b.jpg", "c.heic"]


def test_without_their_reader_a_sentence_says_how_to_install_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(camera_files, "find_spec", lambda name: None)
    assert not any_photo(tmp_path)
    for number in range(FEWEST_PHOTOS):
        Image.new("RGB", (8, 6), (number, 0, 0)).save(tmp_path / f"{number}.jpg")
    (tmp_path / "0.nef").touch()  # the JPEG is there
    assert len(list_photos(tmp_path)) == FEWEST_PHOTOS
    (tmp_path / "IMG_9.NEF").touch()
    with pytest.raises(
        ValueError, match=r"IMG_9\.NEF: 1 pictures are RAW, expected PNG, JPEG or WebP; .* or install rawpy with: .*\[raw\]"
    ):
        list_photos(tmp_path)
    (tmp_path / "IMG_9.NEF").rename(tmp_path / "IMG_9.HEIC")
    with pytest.raises(ValueError, match=r"IMG_9\.HEIC: 1 pictures are HEIC, .* or install pillow-heif with: .*\[heic\]"):
        list_photos(tmp_path)
    assert any_photo(tmp_path)
