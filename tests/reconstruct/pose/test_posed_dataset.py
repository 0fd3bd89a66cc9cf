"""What a build takes as it is and what it poses first; and that a build of plain pictures says how its cameras were found."""

from dataclasses import replace
from pathlib import Path

import av
import numpy as np
import pytest
from PIL import Image

from drgs.evaluate.doctor import doctor
from drgs.reconstruct.build_asset import BuildSettings, BuildStopped, build_asset
from drgs.reconstruct.pose.pose_photographs import PoseSettings
from drgs.reconstruct.pose.posed_dataset import film_of, needs_poses, pose_source
from drgs.reconstruct.pose.prepare_photos import PreparedPhoto, with_backdrop_masks
from drgs.reconstruct.presets import PRESETS
from drgs.reconstruct.progress import Progress
from tests.reconstruct import tiny_capture
from tests.reconstruct.pose.textured_scene import PLAIN_SIZE, orbit, write_photographs
from tests.reconstruct.test_build_asset import WITHOUT_HOLLOWS


def test_only_pictures_without_cameras_and_films_need_poses(tmp_path: Path) -> None:
    assert not needs_poses(tiny_capture.write_nerf_synthetic(tmp_path / "synthetic"))
    assert not needs_poses(tiny_capture.write_colmap(tmp_path / "colmap", binary=True))
    assert not needs_poses(tmp_path / "nothing") and not needs_poses(tmp_path)
    photos = tmp_path / "photos"
    (photos / "masks").mkdir(parents=True)
    Image.new("RGB", (8, 8)).save(photos / "masks" / "a.png")
    assert not needs_poses(photos)  # masks alone are no photographs
    Image.new("RGB", (8, 8)).save(photos / "a.JPG")
    assert needs_poses(photos)
    (tmp_path / "film.MP4").write_bytes(b"")
    assert needs_poses(tmp_path / "film.MP4")
    (tmp_path / "sent").mkdir()
    (tmp_path / "sent" / "film.mov").write_bytes(b"")
    assert film_of(tmp_path / "sent") == tmp_path / "sent" / "film.mov" and needs_poses(tmp_path / "sent")
    (tmp_path / "sent" / "another.mov").write_bytes(b"")
    assert film_of(tmp_path / "sent") is None and not needs_poses(tmp_path / "sent")


def test_what_is_neither_is_refused(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("")
    with pytest.raises(ValueError, match=r"notes\.txt: a file, expected a folder of pictures or a film \(\.mp4"):
        pose_source(tmp_path / "notes.txt", tmp_path / "out", PoseSettings())


def test_frames_are_not_written_over_what_is_somebody_elses(tmp_path: Path) -> None:
    (tmp_path / "film.mp4").write_bytes(b"no film")
    kept = tmp_path / "out.frames" / "holiday.jpg"
    kept.parent.mkdir()
    kept.write_bytes(b"dear")
    (kept.parent / "frame_000001.jpg").write_bytes(b"of a film")
    with pytest.raises(ValueError, match=r"holiday\.jpg: not a frame of a film"):
        pose_source(tmp_path / "film.mp4", tmp_path / "out", PoseSettings())
    assert len(list(kept.parent.iterdir())) == 2
    kept.unlink()
    with pytest.raises(ValueError, match="not a readable video"):
        pose_source(tmp_path / "film.mp4", tmp_path / "out", PoseSettings())
    assert list(kept.parent.iterdir()) == []


@pytest.mark.slow
def test_a_build_of_a_film_chooses_frames_poses_them_and_tells_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(PRESETS, "tiny", WITHOUT_HOLLOWS)
    pictures = sorted((write_photographs(tmp_path / "photos", orbit(24)[:8], size=PLAIN_SIZE)).iterdir())
    film = tmp_path / "film.mp4"
    with av.open(str(film), "w") as container, Image.open(pictures[0]) as first:
        stream = container.add_stream("libx264", rate=10, options={"crf": "8"})
        stream.width, stream.height, stream.pix_fmt = first.width, first.height, "yuv420p"
        for path in pictures:
            with Image.open(path) as picture:
                container.mux(stream.encode(av.VideoFrame.from_image(picture.convert("RGB"))))
        container.mux(stream.encode())
    assert doctor(film)["ok"]
    told: list[Progress] = []
    with pytest.raises(BuildStopped):  # the build itself is tested elsewhere: stopped once the capture is read
        build_asset(film, tmp_path / "asset", BuildSettings(preset="tiny", device="cpu"), told.append, lambda: "masks" in told[-1].message)
    messages = " ".join(progress.message for progress in told)
    assert "choosing frames" in messages and "placing pictures" in messages and "looking for what the object stands on" in messages
    fractions = [progress.fraction for progress in told]
    assert fractions == sorted(fractions)
    posed = tmp_path / "asset.build" / "posed"
    assert (posed / "transforms.json").is_file() and len(list((tmp_path / "asset.build" / "posed.frames").iterdir())) == len(pictures)


def test_pictures_before_a_plain_backdrop_get_masks_and_others_none(tmp_path: Path) -> None:
    (tmp_path / "images").mkdir()
    (tmp_path / "masks").mkdir()
    prepared = []
    for number in range(12):
        pixels = np.full((60, 80, 3), 230, np.uint8)
        pixels[15:45, 20 + number : 55 + number] = (150, 60, 20)
        if number == 7:
            pixels[:, :] = np.random.default_rng(0).integers(0, 255, (6, 8, 3)).repeat(10, 0).repeat(10, 1)
        Image.fromarray(pixels).save(tmp_path / "images" / f"{number}.png")
        prepared.append(PreparedPhoto(str(number), f"{number}.png", False, 80, 60, None, 1.0, str(number)))
    masked, others = with_backdrop_masks(prepared, tmp_path, lambda: False)
    assert list(others) == ["7"] and "plain" in others["7"]
    assert [photo.name for photo in masked] == [str(number) for number in range(12) if number != 7]
    for photo in masked:
        assert photo.has_mask
        mask = np.asarray(Image.open(tmp_path / "masks" / f"{photo.file}.png")) > 127
        start = 20 + int(photo.name)
        assert mask[17:43, start + 2 : start + 33].all() and mask.sum() < 1.15 * 30 * 35
    rooms = [replace(prepared[7], name=name) for name in "abc"]
    same, none = with_backdrop_masks([*prepared, *rooms], tmp_path, lambda: False)
    assert none == {} and not any(photo.has_mask for photo in same)
    with pytest.raises(BuildStopped):
        with_backdrop_masks(prepared, tmp_path, lambda: True)
