"""The frames of a video that are worth posing: of each slot of time the sharpest, but for those in which the camera has not moved.

In: a video file. Out: pictures in a folder, named by their place in the film, upright. Sharpness is the
laplacian_variance of brightness. The film is decoded twice, since a chosen frame is known only when its slot is over and full frames are large.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray
from PIL import Image

from drgs.installation import missing_package
from drgs.reconstruct.capture.laplacian_variance import laplacian_variance

VIDEO_SUFFIXES = (".mp4", ".mov", ".m4v", ".webm", ".mkv", ".avi")
FRAMES = 120
"""Slots that a film is divided into by default."""
FEWEST_FRAMES = 8
SHARPNESS_WIDTH = 480
"""Of the frame in which sharpness is measured [pixels]."""
THUMBNAIL = (32, 24)
SAME_SHADES = 1.0
"""Mean difference of two thumbnails [of 255] below which the camera has not moved."""
HDR_TRANSFERS = {16: "PQ (HDR10, Dolby Vision)", 18: "HLG"}
"""Transfer characteristics (ITU-T H.273) of films whose values are not sRGB's."""
QUALITY = 97


@dataclass(frozen=True)
class VideoFrames:
    """What was taken."""

    pictures: tuple[Path, ...]
    frames: int
    """Of the film."""
    slots: int
    unmoved: int
    """Slots that were left out since the camera had not moved."""


def is_video(path: Path) -> bool:
    """By its suffix."""
    return path.suffix.lower() in VIDEO_SUFFIXES and path.is_file()


def video_frames(
    video: Path,
    folder: Path,
    slots: int = FRAMES,
    advance: Callable[[float], None] = lambda share: None,
    should_stop: Callable[[], bool] = lambda: False,
) -> VideoFrames | None:
    """Write the chosen frames into `folder` as JPEG, made where it is not there; None when should_stop() said so.

    Args:
        advance: is told the share that is done.

    Raises:
        ValueError: one sentence: no film, an HDR film, too short, or a camera that does not move.
    """
    if find_spec("av") is None:
        raise ValueError(missing_package("reading videos", "av", "serve"))
    looked = _looked_at(video, lambda share: advance(share / 2), should_stop)
    if looked is None:
        return None
    chosen, unmoved = chosen_frames(*looked, slots)
    if len(chosen) < FEWEST_FRAMES:
        raise ValueError(
            f"{video}: {len(looked[0])} frames of which {len(chosen)} differ, expected at least {FEWEST_FRAMES}; film for half a minute or more while you "
            "walk around the object."
        )
    folder.mkdir(parents=True, exist_ok=True)
    wanted, written = set(chosen), []
    for index, frame in enumerate(_frames(video)):
        if should_stop():
            return None
        if index in wanted:
            path = folder / f"frame_{index:06d}.jpg"
            Image.fromarray(upright(frame.to_ndarray(format="rgb24"), frame.rotation)).save(path, quality=QUALITY, subsampling=0)
            written.append(path)
            advance(0.5 + len(written) / len(chosen) / 2)
    return VideoFrames(tuple(written), len(looked[0]), min(slots, len(looked[0])), unmoved)


def chosen_frames(sharpness: Float[ndarray, "frame"], thumbnails: Float[ndarray, "frame pixel"], slots: int) -> tuple[list[int], int]:
    """Indices of the sharpest frame of each of `slots` even parts of the film, and how many parts were left out as unmoved."""
    chosen: list[int] = []
    unmoved = 0
    for part in np.array_split(np.arange(len(sharpness)), min(slots, len(sharpness))):
        best = int(part[np.argmax(sharpness[part])])
        if chosen and float(np.abs(thumbnails[best] - thumbnails[chosen[-1]]).mean()) < SAME_SHADES:
            unmoved += 1
        else:
            chosen.append(best)
    return chosen, unmoved


def upright(pixels: UInt8[ndarray, "_height _width 3"], rotation: int) -> UInt8[ndarray, "_rows _columns 3"]:
    """As a player shows it; rotation: of the film's display matrix [degrees, counter-clockwise], in quarter turns."""
    return np.ascontiguousarray(np.rot90(pixels, round(rotation / 90)))


def _looked_at(
    video: Path, advance: Callable[[float], None], should_stop: Callable[[], bool]
) -> tuple[Float[ndarray, "frame"], Float[ndarray, "frame pixel"]] | None:
    sharpness, thumbnails = [], []
    for index, frame in enumerate(_frames(video)):
        if should_stop():
            return None
        if index == 0 and int(frame.color_trc) in HDR_TRANSFERS:
            raise ValueError(
                f"{video}: an HDR film, {HDR_TRANSFERS[int(frame.color_trc)]}, expected standard range; switch HDR video off in the camera, or "
                "convert the film to SDR (BT.709)."
            )
        scale = min(1.0, SHARPNESS_WIDTH / frame.width)
        gray = frame.reformat(max(3, round(frame.width * scale)), max(3, round(frame.height * scale)), format="gray").to_ndarray()
        sharpness.append(laplacian_variance(gray.astype(np.float32)))
        thumbnails.append(np.asarray(Image.fromarray(gray).resize(THUMBNAIL, Image.Resampling.BOX), np.float32).ravel())
        advance(1 - 1 / (1 + index / FRAMES))  # how long the film is, files often do not say
    return np.array(sharpness), np.array(thumbnails).reshape(len(sharpness), -1)


def _frames(video: Path) -> Iterator[Any]:
    """PyAV's decoded frames, in the order in which they are shown."""
    import av

    try:
        with av.open(str(video)) as container:
            if not container.streams.video:
                raise ValueError(f"{video}: holds no pictures, expected a video.")
            container.streams.video[0].thread_type = "AUTO"
            yield from container.decode(video=0)
    except av.FFmpegError as error:
        raise ValueError(f"{video}: not a readable video ({error.strerror}).") from error
