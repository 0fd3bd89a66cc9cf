"""How far long work is: the one record that the command line, jobs, their rows and REST tell it by, and the stages of a build.

Imports nothing heavy, so that services can. A new field of `Progress` is also a column of JobRow and a field of JobInfo (a test says so);
the viewer's type follows from JobInfo.
"""

from dataclasses import dataclass, fields
from typing import Any

STAGE_SHARES = {
    "particles": {"read": 0.1, "fit": 0.32, "mesh": 0.03, "surface": 0.3, "materials": 0.23, "pack": 0.02},
    "mesh": {"read": 0.09, "fit": 0.28, "mesh": 0.03, "surface": 0.27, "bind": 0.1, "materials": 0.21, "pack": 0.02},
}
"""The stages of a build with each binding, in their order, and their shares of its time, for the progress bar."""
POSED = "posed"
"""Folder beside a build's checkpoints: the capture that was made of pictures without cameras."""


class BuildStopped(Exception):
    """should_stop() was true; what was finished is on disk, and a run that resumes goes on from there."""


@dataclass(frozen=True)
class Progress:
    """How far a build or another job is."""

    stage: str
    iteration: int
    iterations: int
    fraction: float
    """Of the whole, 0..1."""
    psnr: float | None = None
    message: str = ""
    eta_seconds: float | None = None
    preview_jpeg: bytes | None = None


TOLD = tuple(field.name for field in fields(Progress) if field.name != "preview_jpeg")
"""The fields that are plain data."""


def plain_progress(progress: Progress) -> dict[str, Any]:
    """All but the picture, for JSON and for the job's row."""
    return {name: getattr(progress, name) for name in TOLD}
