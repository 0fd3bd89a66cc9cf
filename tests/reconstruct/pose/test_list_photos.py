"""Which files of a folder are photographs, and which are refused in a sentence."""

from pathlib import Path

import pytest
from PIL import Image

from drgs.reconstruct.capture import camera_files
from drgs.reconstruct.pose.list_photos import FEWEST_PHOTOS, list_photos


def write_pictures(folder: Path, count: int = FEWEST_PHOTOS, suffix: str = ".jpg") -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for number in range(count):
        Image.new("RGB", (8, 6), (number, 0, 0)).save(folder / f"{number:02d}{suffix}")


def test_pictures_of_folders_in_folders_have_names_of_their_own(tmp_path: Path):
    write_pictures(tmp_path / "left")
    write_pictures(tmp_path / "right", 1)
    write_pictures(tmp_path, 1)
    write_pictures(tmp_path, 1, ".png")
    write_pictures(tmp_path / ".thumbnails", 3)
    write_pictures(tmp_path / "__MACOSX", 3)
    (tmp_path / "notes.txt").write_text("of the day")
    names = [photo.name for photo in list_photos(tmp_path)]
    assert names == ["00_jpg", "00_png", *(f"left_{number:02d}" for number in range(FEWEST_PHOTOS)), "right_00"]


@pytest.mark.parametrize(("images", "masks"), [(".", "masks"), ("images", "masks"), ("images", "images/masks")])
def test_masks_lie_inside_or_beside_the_folder_images(tmp_path: Path, images: str, masks: str):
    write_pictures(tmp_path / images)
    write_pictures(tmp_path / masks, suffix=".png")
    for folder in {tmp_path / images, tmp_path} if masks == "masks" else {tmp_path / images}:
        photos = list_photos(folder)
        assert [photo.mask for photo in photos] == [tmp_path / masks / f"{number:02d}.png" for number in range(FEWEST_PHOTOS)]


def test_a_picture_without_its_mask_is_named(tmp_path: Path):
    write_pictures(tmp_path)
    write_pictures(tmp_path / "masks", FEWEST_PHOTOS - 1)
    with pytest.raises(ValueError, match=r"masks/07\.png: no such mask \(1 of 8 images have none\)"):
        list_photos(tmp_path)


def test_too_few_pictures_and_what_is_there_instead(tmp_path: Path):
    with pytest.raises(ValueError, match="nothing: no such folder, expected one with photographs"):
        list_photos(tmp_path / "nothing")
    write_pictures(tmp_path, 2)
    (tmp_path / "a.TIF").touch()
    (tmp_path / "b.tif").touch()
    with pytest.raises(ValueError, match=r"2 pictures \(and 2 \.tif files\), expected at least 8 PNG"):
        list_photos(tmp_path)


def test_heic_needs_its_reader(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    write_pictures(tmp_path)
    (tmp_path / "IMG_1.HEIC").touch()
    monkeypatch.setattr(camera_files, "find_spec", lambda name: None)
    with pytest.raises(ValueError, match=r"IMG_1\.HEIC: 1 pictures are HEIC, expected PNG, JPEG or WebP; export them as JPEG"):
        list_photos(tmp_path)


@pytest.mark.parametrize("camera_file", ["transforms.json", "transforms_train.json", "sparse/0/cameras.bin", "000-camera.pkl"])
@pytest.mark.parametrize("given", [".", "images"])
def test_pictures_of_a_posed_capture_are_not_posed_again(tmp_path: Path, camera_file: str, given: str):
    write_pictures(tmp_path / "images")
    (tmp_path / camera_file).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / camera_file).touch()
    with pytest.raises(ValueError, match="the pictures are part of a posed capture; build from"):
        list_photos(tmp_path / given)
