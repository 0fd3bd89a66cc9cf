"""Simulations: an asset's matter moves, and the clip is kept where `pose` edits find it. Every finished frame is on disk, beside the
clip's place: a worker that dies costs one frame, and `pose` edits of this machine find what is made so far."""

import time
from pathlib import Path

from drgs.reconstruct.progress import Progress
from drgs_worker.jobs.progress import JobStopped
from drgs_worker.jobs.requests import SimulateRequest
from drgs_worker.jobs.retry_while_unavailable import retry_while_unavailable
from drgs_worker.jobs.steps.job_run import AbstractJobRun, JobContext
from drgs_worker.store.artifacts import share_artifact


class SimulateRun(AbstractJobRun):
    """Final."""

    steps = ("simulate",)

    def __init__(self, job: JobContext) -> None:
        self._job = job
        self._asked = SimulateRequest.model_validate(job.parameters)

    def run(self, step: str) -> None:
        job, out = self._job, self._job.directory.clip(self._job.job_id)
        if not out.exists():  # else written whole; the crash came before the step was recorded
            self._simulate(out)
        retry_while_unavailable(lambda: share_artifact(job.directory, "clips", job.job_id, out), job.should_stop)

    def _simulate(self, out: Path) -> None:
        from drgs.deform.matter.simulate import simulate
        from drgs.deform.matter.simulation_scene import parse_simulation_scene
        from drgs.scene.asset import load_asset
        from drgs.warp_torch import device_from_name

        job = self._job
        asset = load_asset(job.fetch_asset(self._asked.asset), device_from_name(job.device))

        told: list[tuple[float, int]] = []

        def report(done: int, total: int) -> None:
            told.append((time.monotonic(), done))
            (begun, first), (now, _) = told[0], told[-1]
            # The first one was there already: the object at rest, or what an earlier run left.
            left = (now - begun) / (done - first) * (total - done) if done > first else None
            job.progress(Progress("simulate", done, total, done / total, message=f"frame {done} of {total}", eta_seconds=left))
            if job.should_stop():
                raise JobStopped

        out.parent.mkdir(mode=0o700, exist_ok=True)
        simulate(asset, parse_simulation_scene(self._asked.scene), out, report, checkpoint=job.directory.growing_clip(job.job_id))
