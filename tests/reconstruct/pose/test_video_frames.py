"""Of a film: the sharpest frame of each slot, none in which the camera has not moved, and one sentence for what is no film."""

from pathlib import Path

import av
import numpy as np
import pytest
from PIL import Image
from scipy import ndimage

from drgs.reconstruct.pose.video_frames import chosen_frames, is_video, upright, video_frames

WIDTH, HEIGHT = 96, 64
PATTERN = ndimage.gaussian_filter(np.random.default_rng(0).uniform(0, 255, (HEIGHT, 4 * WIDTH, 3)), (1, 1, 0))
PATTERN = ((PATTERN - PATTERN.min()) / np.ptp(PATTERN) * 255).astype(np.uint8)


def film(path: Path, pictures: list[np.ndarray], transfer: int | None = None) -> Path:
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=25, options={"crf": "12"})
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        if transfer is not None:
            stream.codec_context.color_trc = transfer
        for picture in pictures:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode())
    return path


def panned(step: int, blurred: bool = False) -> np.ndarray:
    picture = PATTERN[:, 4 * step : 4 * step + WIDTH]
    return np.ascontiguousarray(ndimage.gaussian_filter(picture, (2.5, 2.5, 0)) if blurred else picture)


def test_the_sharp_frame_of_each_slot_is_taken(tmp_path: Path) -> None:
    path = film(tmp_path / "walk.mp4", [panned(step, blurred=step % 4 != 2) for step in range(48)])
    told: list[float] = []
    taken = video_frames(path, tmp_path / "frames", slots=12, advance=told.append)
    assert taken is not None
    assert [int(picture.stem.split("_")[1]) for picture in taken.pictures] == list(range(2, 48, 4))
    assert (taken.frames, taken.slots, taken.unmoved) == (48, 12, 0)
    assert told == sorted(told) and told[-1] == 1.0
    for picture in taken.pictures:
        with Image.open(picture) as image:
            difference = np.abs(np.asarray(image, float) - panned(int(picture.stem.split("_")[1])))
        assert difference.mean() < 12  # of colours at half resolution


def test_a_camera_that_stands_still_is_seen_once(tmp_path: Path) -> None:
    path = film(tmp_path / "pause.mov", [panned(min(step, 20)) for step in range(60)])
    taken = video_frames(path, tmp_path / "frames", slots=30)
    assert taken is not None
    assert taken.slots == 30 and taken.unmoved == 19 and len(taken.pictures) == 11


def test_frames_that_are_equally_sharp_are_taken_in_order() -> None:
    chosen, unmoved = chosen_frames(np.ones(5), 100.0 * np.arange(5)[:, None], 120)
    assert chosen == [0, 1, 2, 3, 4] and unmoved == 0


def test_a_film_taken_upright_stands_upright() -> None:
    picture = np.zeros((2, 3, 3), np.uint8)
    picture[0, 0] = 255
    # A phone held upright writes lying frames and -90: players turn them clockwise.
    assert upright(picture, -90).shape == (3, 2, 3) and upright(picture, -90)[0, 1, 0] == 255
    assert upright(picture, 180)[1, 2, 0] == 255 and upright(picture, 0)[0, 0, 0] == 255


def test_what_is_no_film_gets_a_sentence(tmp_path: Path) -> None:
    (tmp_path / "noise.mp4").write_bytes(b"no film" * 100)
    with pytest.raises(ValueError, match=r"noise\.mp4: not a readable video"):
        video_frames(tmp_path / "noise.mp4", tmp_path / "frames")
    still = film(tmp_path / "still.mp4", [panned(0)] * 30)
    with pytest.raises(ValueError, match=r"still\.mp4: 30 frames of which 1 differ, expected at least 8"):
        video_frames(still, tmp_path / "frames")
    with pytest.raises(ValueError, match=r"an HDR film, HLG, expected standard range"):
        video_frames(film(tmp_path / "hdr.mp4", [panned(step) for step in range(4)], transfer=18), tmp_path / "frames")
    assert is_video(still) and not is_video(tmp_path / "frames") and not is_video(tmp_path / "none.mp4")


def test_reading_stops_when_asked(tmp_path: Path) -> None:
    path = film(tmp_path / "walk.mp4", [panned(step) for step in range(20)])
    assert video_frames(path, tmp_path / "frames", should_stop=lambda: True) is None
    assert not (tmp_path / "frames").exists()
