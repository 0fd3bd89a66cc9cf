"""Poses: where plain photographs, or the frames of a film, were taken from. They become a capture of their own, with the job's id, for builds to read."""

import shutil
from pathlib import Path
from typing import TYPE_CHECKING

from sqlalchemy.orm import Session

from drgs.reconstruct.progress import POSED, BuildStopped
from drgs_worker.jobs.capture_report import CaptureFinding, CaptureReport
from drgs_worker.jobs.progress import JobStopped
from drgs_worker.jobs.retry_while_unavailable import retry_while_unavailable
from drgs_worker.jobs.steps.job_run import AbstractJobRun, JobContext
from drgs_worker.store.artifacts import fetch_capture, share_artifact
from drgs_worker.store.database import CaptureRow, now
from drgs_worker.store.user_names import LONGEST_NAME

if TYPE_CHECKING:
    from drgs.reconstruct.pose.posed_dataset import PosedSource

NAME_ENDING = ", posed"
"""Of the capture that is made."""


class PoseRun(AbstractJobRun):
    """Final."""

    def __init__(self, job: JobContext) -> None:
        self._job = job
        self.steps = ("pose", "register")

    def run(self, step: str) -> None:
        if step == "pose":
            self._pose()
        else:
            retry_while_unavailable(self._register, self._job.should_stop)

    @property
    def _posed(self) -> Path:
        return self._job.folder / POSED

    def _pose(self) -> None:
        from drgs.reconstruct.pose.pose_photographs import PoseSettings
        from drgs.reconstruct.pose.posed_dataset import pose_source

        job = self._job
        assert job.dataset is not None
        given = job.dataset
        photographs = retry_while_unavailable(lambda: fetch_capture(job.directory, given), job.should_stop)
        if not photographs.is_dir():
            raise ValueError(f"The capture {photographs.name} is gone; it was removed after the job was made.")
        settings = PoseSettings(seed=job.parameters.get("seed", 0), resume=True)
        try:
            found = pose_source(photographs, self._posed, settings, progress=job.progress, should_stop=job.should_stop)
        except BuildStopped as stopped:
            raise JobStopped from stopped
        job.progress(report_on(found))

    def _register(self) -> None:
        """Does nothing that was already done."""
        job = self._job
        place = job.directory.uploads / job.job_id
        if self._posed.exists() and not place.exists():
            self._posed.rename(place)
        share_artifact(job.directory, "captures", job.job_id, place)
        with Session(job.engine) as session, session.begin():
            if session.get(CaptureRow, job.job_id) is None:
                name = f"{job.name[: LONGEST_NAME - len(NAME_ENDING)]}{NAME_ENDING}"
                session.add(CaptureRow(id=job.job_id, name=name, created_at=now(), folder=job.job_id))
        shutil.rmtree(Path(f"{self._posed}.frames"), ignore_errors=True)


def report_on(found: "PosedSource") -> CaptureReport:
    """How many pictures found their place, and why the others did not."""
    poses = found.capture
    count = f"{len(poses.placed)} of {poses.given} pictures found their place, {poses.reprojection_error:.2f} pixels off on average."
    left_out = [
        CaptureFinding(level="warning", sentence=f"{name} was left out: {reason}.", advice="") for name, reason in poses.left_out.items()
    ]
    masks = [
        CaptureFinding(level="info", sentence="The object was cut out of a plain backdrop.", advice="Look at the outlines of the masks.")
        for _ in range(poses.masks_from == "backdrop")
    ]
    return CaptureReport(summary=count, findings=[*left_out, *masks])
