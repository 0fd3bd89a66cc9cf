"""The durable workflow of every job. Imported by workers only (the API enqueues by name).

A job's kind gives its steps (worker/job_run.py), each a DBOS step: after a crash the finished ones are not run again, and the one that
was interrupted goes on from its own checkpoint. Cancelling is polled inside steps, since DBOS does not interrupt a running one.
"""

import contextlib
import os
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import psutil
from dbos import DBOS
from dbos import error as dbos_error
from sqlalchemy import Engine, update
from sqlalchemy.orm import Session

from worker.artifact_store import ArtifactError
from worker.artifacts import RUN_LOCK, bring_job, keep_job, patiently
from worker.builders import Builder, BuildProgress, BuildStopped
from worker.data_directory import DataDirectory, try_lock_file
from worker.database import JobRow, now, through_outage
from worker.job_build import BuildRun, RedecoupleRun
from worker.job_export import ExportRun
from worker.job_render import RenderRun
from worker.job_run import AbstractJobRun, JobContext
from worker.job_simulate import SimulateRun
from worker.queue import JOB_WORKFLOW
from worker.requests import JobLimits

PROGRESS_SECONDS = 0.5
"""Between two writes of progress."""
STOP_POLL_SECONDS = 0.25
"""Between two looks at the cancel flag and at limits."""
ASSET_KINDS = ("build", "redecouple")
"""Their job's id is their asset's."""

_RUNS: dict[str, Callable[[JobContext], AbstractJobRun]] = {
    "build": BuildRun,
    "redecouple": RedecoupleRun,
    "simulate": SimulateRun,
    "render": RenderRun,
    "export": ExportRun,
}


class WorkerStopping(BaseException):
    """Leaves a workflow without an outcome: DBOS records only `Exception`s, so the job stays PENDING and is recovered at the next start."""


@dataclass(frozen=True)
class WorkerContext:
    """What the steps of this process work with. Workflow functions take only JSON, so it is set once for the process."""

    directory: DataDirectory
    engine: Engine
    worker_id: str
    builder: Builder
    device: str
    stopping: threading.Event
    """Set on SIGTERM."""


_context: WorkerContext | None = None


def set_context(context: WorkerContext) -> None:
    """Before DBOS.launch(), which starts recovered jobs at once."""
    global _context
    _context = context


def _worker() -> WorkerContext:
    if _context is None:
        raise RuntimeError("a job started before set_context() was called")
    return _context


@DBOS.workflow(name=JOB_WORKFLOW, max_recovery_attempts=3)
def run_job(job_id: str) -> None:
    """A job's row never changes in what its steps depend on, so every execution of it has the same ones."""
    with _failures_recorded(job_id):
        job = _job_context(job_id)
        run = _RUNS[_read_job(job_id).kind](job)
    for step in run.steps:
        DBOS.run_step({"name": step}, _run_step, job, run, step)
    DBOS.run_step({"name": "finish"}, _finish, job_id)


def _run_step(job: JobContext, run: AbstractJobRun, step: str) -> None:
    """A second run in the same folder waits until the first has let go of it."""
    with _failures_recorded(job.job_id):
        job.folder.mkdir(mode=0o700, exist_ok=True)
        with _only_run(job.folder, job.should_stop):
            patiently(lambda: bring_job(job.directory, job.job_id), job.should_stop)
            _log(job, f"{step}: started by {_worker().worker_id}")
            _update_job(job.job_id, worker_id=_worker().worker_id, error=None)
            run.run(step)
            _log(job, f"{step}: finished")
            patiently(lambda: keep_job(job.directory, job.job_id), job.should_stop)


def _finish(job_id: str) -> None:
    asset_id = job_id if _read_job(job_id).kind in ASSET_KINDS else None
    _update_job(job_id, asset_id=asset_id, finished_at=now(), fraction=1.0, stage="done", eta_seconds=None, message="")


def _read_job(job_id: str) -> JobRow:
    def read() -> JobRow | None:
        with Session(_worker().engine) as session:
            return session.get(JobRow, job_id)

    row = through_outage(read)
    if row is None:
        raise ValueError("This job was deleted before it began.")
    return row


def _job_context(job_id: str) -> JobContext:
    """Also counts the attempt."""
    worker, row = _worker(), _read_job(job_id)
    _update_job(job_id, attempts=JobRow.attempts + 1)
    parameters = row.parameters if row.kind != "build" else {"preset": row.preset, "seed": row.seed} | row.parameters
    limits = JobLimits.model_validate(parameters.get("limits", {}))
    return JobContext(
        job_id=job_id,
        name=row.name,
        parameters=parameters,
        dataset=Path(row.dataset) if row.dataset else None,
        directory=worker.directory,
        engine=worker.engine,
        builder=worker.builder,
        device=worker.device,
        progress=_progress_writer(job_id),
        should_stop=_stop_flag(job_id, limits),
    )


def _log(job: JobContext, line: str) -> None:
    with job.directory.job_log(job.job_id).open("a") as file:
        file.write(f"{datetime.now(UTC).isoformat(timespec='milliseconds')} {line}\n")


@contextlib.contextmanager
def _failures_recorded(job_id: str) -> Iterator[None]:
    """Turn what a step raises into what the queue and the user should see."""
    try:
        yield
    except BuildStopped as stopped:
        if _worker().stopping.is_set():
            raise WorkerStopping from stopped
        # DBOS records no outcome for this one, so that a retry runs the step again.
        raise dbos_error.DBOSWorkflowCancelledError(f"job {job_id} was cancelled") from stopped
    except Exception as error:
        _update_job(job_id, error=_sentence(error), finished_at=now())
        DBOS.logger.exception("job %s failed", job_id)
        raise


def _sentence(error: Exception) -> str:
    """Wrong input explains itself; anything else is named."""
    text = str(error).strip() or "no further words"
    return text if isinstance(error, ValueError | ArtifactError) else f"{type(error).__name__}: {text}"


def _stop_flag(job_id: str, limits: JobLimits) -> Callable[[], bool]:
    """A cheap `should_stop`: asks the database at most four times a second."""
    started, checked_at, stop = time.monotonic(), 0.0, False
    process = psutil.Process()

    def is_cancelled() -> bool:
        with Session(_worker().engine) as session:
            row = session.get(JobRow, job_id)
            return row is None or row.cancel_requested

    def should_stop() -> bool:
        nonlocal checked_at, stop
        if _worker().stopping.is_set():
            return True
        if not stop and time.monotonic() - checked_at > STOP_POLL_SECONDS:
            checked_at = time.monotonic()
            stop = through_outage(is_cancelled)
            if limits.seconds is not None and checked_at - started > limits.seconds:
                raise ValueError(f"The job took longer than its limit of {limits.seconds:g} s.")
            if limits.memory_bytes is not None and process.memory_info().rss > limits.memory_bytes:
                raise ValueError(f"The job needs more memory than its limit of {limits.memory_bytes / 2**30:.1f} GiB.")
        return stop

    return should_stop


@contextlib.contextmanager
def _only_run(folder: Path, should_stop: Callable[[], bool]) -> Iterator[None]:
    """Two executions of one job can meet: a retry while the cancelled run still writes its checkpoint."""
    while (lock := try_lock_file(folder / RUN_LOCK)) is None:
        if should_stop():
            raise BuildStopped
        time.sleep(0.1)
    try:
        yield
    finally:
        os.close(lock)


def _progress_writer(job_id: str) -> Callable[[BuildProgress], None]:
    """Writes every change of stage, and otherwise at most two rows a second."""
    written_at, stage = 0.0, ""
    preview = _worker().directory.preview(job_id)

    def write(progress: BuildProgress) -> None:
        nonlocal written_at, stage
        values: dict = {}
        if progress.preview_jpeg is not None:
            draft = preview.with_suffix(".new")
            draft.write_bytes(progress.preview_jpeg)
            draft.rename(preview)
            values["preview_version"] = JobRow.preview_version + 1
        elif progress.capture is not None:
            values["capture_report"] = progress.capture.model_dump()
        elif progress.stage == stage and time.monotonic() - written_at < PROGRESS_SECONDS:
            return
        written_at, stage = time.monotonic(), progress.stage
        _update_job(
            job_id,
            stage=progress.stage,
            iteration=progress.iteration,
            iterations=progress.iterations,
            fraction=min(max(progress.fraction, 0.0), 1.0),
            psnr=progress.psnr,
            eta_seconds=progress.eta_seconds,
            message=progress.message,
            **values,
        )

    return write


def _update_job(job_id: str, **values: object) -> None:
    def write() -> None:
        with Session(_worker().engine) as session, session.begin():
            session.execute(update(JobRow).where(JobRow.id == job_id).values(**values))

    through_outage(write)
