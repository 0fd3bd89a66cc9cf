"""What a build is given becomes a capture with cameras: a folder of pictures or a film is posed first, anything else is taken as it is.

In: a path. Out: the path of a capture that load_views reads. What was found stays beside the build's checkpoints, and is not looked for again on resume.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

from drgs.reconstruct.capture.load_views import has_cameras
from drgs.reconstruct.capture.load_views.checks import is_file, is_folder
from drgs.reconstruct.pose.list_photos import any_photo
from drgs.reconstruct.pose.pose_photographs import PoseSettings, pose_photographs
from drgs.reconstruct.pose.posed_capture import PosedCapture
from drgs.reconstruct.pose.video_frames import VIDEO_SUFFIXES, VideoFrames, is_video, video_frames
from drgs.reconstruct.progress import BuildStopped, Progress

FRAMES_SHARE = 0.2
"""Of the time, where a film is read first."""


@dataclass(frozen=True)
class PosedSource:
    """A capture that was made of pictures or of a film."""

    capture: PosedCapture
    video: VideoFrames | None


def provenance_of(source: PosedSource) -> dict[str, Any]:
    """What an asset tells of its poses: how many pictures have one, and how pictures were calibrated before they were undistorted."""
    found = source.capture
    told: dict[str, Any] = {
        "given": found.given, "placed": len(found.placed), "left_out": found.left_out, "pixels_off": round(found.reprojection_error, 3),
        "masks_from": found.masks_from, "cameras": list(found.cameras.values()),
    }  # fmt: skip
    if source.video is not None:
        told["film"] = {"frames": source.video.frames, "slots": source.video.slots, "unmoved": source.video.unmoved}
    return told


def needs_poses(source: Path) -> bool:
    """Whether it is a film, or a folder of pictures without cameras or of a film alone."""
    return film_of(source) is not None or (is_folder(source) and not has_cameras(source) and any_photo(source))


def film_of(source: Path) -> Path | None:
    """The film that the source is, or that is the one thing to look at in that folder; None where there is none, or several."""
    if is_video(source):
        return source
    if not is_folder(source) or has_cameras(source) or any_photo(source):
        return None
    films = [path for path in sorted(source.iterdir()) if is_video(path) and not path.name.startswith(".")]
    return films[0] if len(films) == 1 else None


def pose_source(
    source: Path,
    out: Path,
    settings: PoseSettings,
    frames: int | None = None,
    progress: Callable[[Progress], None] | None = None,
    should_stop: Callable[[], bool] | None = None,
) -> PosedSource:
    """Write the posed capture of a film or of a folder of pictures into `out`; a film's frames into `out`.frames.

    Args:
        frames: of a film, how many slots of time one is taken from; None: video_frames' own number.

    Raises:
        ValueError: as pose_photographs and video_frames do, or `out`.frames holds something else than frames.
        BuildStopped: as asked.
    """
    should_stop = should_stop or (lambda: False)
    tell = progress or (lambda _: None)
    if is_file(source) and not is_video(source):
        raise ValueError(f"{source}: a file, expected a folder of pictures or a film ({', '.join(VIDEO_SUFFIXES)}).")
    film = film_of(source)
    if film is None:
        return PosedSource(pose_photographs(source, out, settings, progress, should_stop), None)

    folder = Path(f"{out}.frames")
    _forget_frames(folder)
    told = "choosing frames of the film"
    taken = video_frames(
        film,
        folder,
        advance=lambda share: tell(Progress("read", 0, 0, FRAMES_SHARE * share, message=told)),
        should_stop=should_stop,
        **({} if frames is None else {"slots": frames}),
    )
    if taken is None:
        raise BuildStopped

    def tell_rest(at: Progress) -> None:
        tell(replace(at, fraction=FRAMES_SHARE + (1 - FRAMES_SHARE) * at.fraction))

    return PosedSource(pose_photographs(folder, out, settings, tell_rest, should_stop), taken)


def _forget_frames(folder: Path) -> None:
    """Remove what video_frames wrote there before, and nothing else."""
    held = sorted(folder.iterdir()) if folder.exists() else []
    foreign = next((path for path in held if not fnmatch(path.name, "frame_*.jpg")), None)
    if foreign is not None:
        raise ValueError(
            f"{foreign}: not a frame of a film, expected a folder for frames alone; move it, or give another folder for the capture."
        )
    for path in held:
        path.unlink()
