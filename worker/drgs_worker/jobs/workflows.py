"""The durable workflow of every job. Imported by workers only (the API enqueues by name).

A job's kind gives its steps (steps/job_run.py), each a DBOS step: after a crash the finished ones are not run again, and the interrupted
one goes on from its own checkpoint. Cancelling is polled inside steps, since DBOS does not interrupt a running one.
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

from drgs.reconstruct.progress import Progress, plain_progress
from drgs_worker.jobs.builders import Builder
from drgs_worker.jobs.capture_report import CaptureReport
from drgs_worker.jobs.progress import JobStopped, Tell
from drgs_worker.jobs.queue import JOB_WORKFLOW
from drgs_worker.jobs.requests import JobLimits
from drgs_worker.jobs.retry_while_unavailable import retry_while_unavailable
from drgs_worker.jobs.steps.build import BuildRun, RedecoupleRun
from drgs_worker.jobs.steps.export import ExportRun
from drgs_worker.jobs.steps.job_run import AbstractJobRun, JobContext
from drgs_worker.jobs.steps.pose import PoseRun
from drgs_worker.jobs.steps.render import RenderRun
from drgs_worker.jobs.steps.simulate import SimulateRun
from drgs_worker.store.artifact_store import ArtifactError
from drgs_worker.store.artifacts import RUN_LOCK, fetch_job, share_job
from drgs_worker.store.data_directory import DataDirectory, try_lock_file
from drgs_worker.store.database import JobRow, now, retry_while_database_unavailable

PROGRESS_SECONDS = 0.5
"""Between two writes of progress."""
STOP_POLL_SECONDS = 0.25
"""Between two looks at the cancel flag and at limits."""
MOST_DEATHS = 3
"""Of workers in one job; then it fails, so that a job that is too large does not take the service down for ever."""
ASSET_KINDS = ("build", "redecouple")
"""Their job's id is their asset's."""

_RUNS: dict[str, Callable[[JobContext], AbstractJobRun]] = {
    "build": BuildRun,
    "pose": PoseRun,
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
    """Called before DBOS.launch(), which starts recovered jobs at once."""
    global _context
    _context = context


def _worker() -> WorkerContext:
    if _context is None:
        raise RuntimeError("a job started before set_context() was called")
    return _context


# DBOS' own count is left out: a stop in order is no death for it, and a job that is handed to another worker begins at nought.
@DBOS.workflow(name=JOB_WORKFLOW, max_recovery_attempts=None)
def run_job(job_id: str) -> None:
    """Every execution has the same steps: what they depend on in the job's row never changes."""
    with _failures_recorded(job_id):
        _count_deaths(job_id)
        job = _job_context(job_id)
        run = _RUNS[_read_job(job_id).kind](job)
    for step in run.steps:
        DBOS.run_step({"name": step}, _run_step, job, run, step)
    DBOS.run_step({"name": "finish"}, _finish, job_id)


def _run_step(job: JobContext, run: AbstractJobRun, step: str) -> None:
    """A second execution in the same folder waits until the first one has ended."""
    with _failures_recorded(job.job_id):
        job.folder.mkdir(mode=0o700, exist_ok=True)
        with _only_run(job.folder, job.should_stop):
            retry_while_unavailable(lambda: fetch_job(job.directory, job.job_id), job.should_stop)
            _log(job, f"{step}: started by {_worker().worker_id}")
            _update_job(job.job_id, worker_id=_worker().worker_id, error=None)
            run.run(step)
            _log(job, f"{step}: finished")
            retry_while_unavailable(lambda: share_job(job.directory, job.job_id), job.should_stop)


def _count_deaths(job_id: str) -> None:
    """Begin an execution, unless too many before it never ended.

    Raises:
        ValueError: a sentence for the user.
    """
    if _read_job(job_id).unended >= MOST_DEATHS:
        raise ValueError(f"The worker died {MOST_DEATHS} times while it ran this job; it may need more memory than there is.")
    _update_job(job_id, unended=JobRow.unended + 1)


def _finish(job_id: str) -> None:
    asset_id = job_id if _read_job(job_id).kind in ASSET_KINDS else None
    _update_job(job_id, asset_id=asset_id, finished_at=now(), fraction=1.0, stage="done", eta_seconds=None, message="", unended=0)


def _read_job(job_id: str) -> JobRow:
    def read() -> JobRow | None:
        with Session(_worker().engine) as session:
            return session.get(JobRow, job_id)

    row = retry_while_database_unavailable(read)
    if row is None:
        raise ValueError("This job was deleted before it began.")
    return row


def _job_context(job_id: str) -> JobContext:
    """What the job's steps work with; also counts the attempt."""
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
    except JobStopped as stopped:
        if _worker().stopping.is_set():
            _update_job(job_id, unended=JobRow.unended - 1)
            raise WorkerStopping from stopped
        # DBOS records no outcome of a cancelled step, so a retry runs it again.
        raise dbos_error.DBOSWorkflowCancelledError(f"job {job_id} was cancelled") from stopped
    except Exception as error:
        _update_job(job_id, error=_sentence(error), finished_at=now(), unended=0)
        DBOS.logger.exception("job %s failed", job_id)
        raise


def _sentence(error: Exception) -> str:
    """Wrong input explains itself; anything else is named."""
    text = str(error).strip() or "no further words"
    return _worker().directory.told(text if isinstance(error, ValueError | ArtifactError) else f"{type(error).__name__}: {text}")


def _stop_flag(job_id: str, limits: JobLimits) -> Callable[[], bool]:
    """The job's `should_stop`, cheap: it asks the database at most four times a second."""
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
            stop = retry_while_database_unavailable(is_cancelled)
            if limits.seconds is not None and checked_at - started > limits.seconds:
                raise ValueError(f"The job took longer than its limit of {limits.seconds:g} s.")
            if limits.memory_bytes is not None and process.memory_info().rss > limits.memory_bytes:
                raise ValueError(f"The job needs more memory than its limit of {limits.memory_bytes / 2**30:.1f} GiB.")
        return stop

    return should_stop


@contextlib.contextmanager
def _only_run(folder: Path, should_stop: Callable[[], bool]) -> Iterator[None]:
    """Two executions of one job can meet: a retry starts while the cancelled one still writes its checkpoint."""
    while (lock := try_lock_file(folder / RUN_LOCK)) is None:
        if should_stop():
            raise JobStopped
        time.sleep(0.1)
    try:
        yield
    finally:
        os.close(lock)


def _progress_writer(job_id: str) -> Tell:
    """Writes every change of stage, and otherwise at most two rows a second."""
    written_at, stage = 0.0, ""
    preview = _worker().directory.preview(job_id)

    def write(told: Progress | CaptureReport) -> None:
        nonlocal written_at, stage
        if isinstance(told, CaptureReport):
            directory = _worker().directory
            findings = [found.model_copy(update={"sentence": directory.told(found.sentence)}) for found in told.findings]
            _update_job(job_id, capture_report=told.model_copy(update={"findings": findings}).model_dump())
            return
        values = plain_progress(told) | {"fraction": min(max(told.fraction, 0.0), 1.0)}
        if told.preview_jpeg is not None:
            draft = preview.with_suffix(".new")
            draft.write_bytes(told.preview_jpeg)
            draft.rename(preview)
            values["preview_version"] = JobRow.preview_version + 1
        elif told.stage == stage and time.monotonic() - written_at < PROGRESS_SECONDS:
            return
        written_at, stage = time.monotonic(), told.stage
        _update_job(job_id, **values)

    return write


def _update_job(job_id: str, **values: object) -> None:
    def write() -> None:
        with Session(_worker().engine) as session, session.begin():
            session.execute(update(JobRow).where(JobRow.id == job_id).values(**values))

    retry_while_database_unavailable(write)
