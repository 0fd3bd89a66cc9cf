"""The durable workflow of a build. Imported by workers only (the API enqueues by name).

prepare -> build -> register, each a DBOS step: after a crash the finished ones are not run again, and the build itself goes on from
its own checkpoint. Cancelling is polled inside the build, since DBOS does not interrupt a running step.
"""

import contextlib
import os
import shutil
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from dbos import DBOS
from dbos import error as dbos_error
from sqlalchemy import Engine, update
from sqlalchemy.orm import Session

from worker.asset_folder import count_asset_folder, folder_bytes
from worker.builders import Builder, BuildProgress, BuildRequest, BuildStopped
from worker.data_directory import DataDirectory, try_lock_file
from worker.database import AssetRow, JobRow, now
from worker.queue import BUILD_WORKFLOW

PROGRESS_SECONDS = 0.5
"""Between two writes of progress."""
STOP_POLL_SECONDS = 0.25
"""Between two looks at the cancel flag."""


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


@DBOS.workflow(name=BUILD_WORKFLOW, max_recovery_attempts=3)
def build_asset_job(job_id: str, dataset: str, preset: str, seed: int) -> str:
    """Returns the id of the asset."""
    prepare(job_id, dataset)
    build(job_id, dataset, preset, seed)
    return register(job_id)


@DBOS.step()
def prepare(job_id: str, dataset: str) -> None:
    """Check that the capture is where it was when the job was made, and make the working folder."""
    with _failures_recorded(job_id):
        if not Path(dataset).is_dir():
            raise ValueError(f"The capture {Path(dataset).name} is gone; it was removed after the job was made.")
        _worker().directory.job(job_id).mkdir(mode=0o700, exist_ok=True)


@DBOS.step()
def build(job_id: str, dataset: str, preset: str, seed: int) -> None:
    """The long part. A second run in the same folder waits until the first has let go of it."""
    worker = _worker()
    folder = worker.directory.job(job_id)
    should_stop = _stop_flag(job_id)
    with _failures_recorded(job_id), _only_run(folder, should_stop):
        _update_job(job_id, worker_id=worker.worker_id, attempts=JobRow.attempts + 1, error=None)
        request = BuildRequest(Path(dataset), folder / "asset", preset, seed, worker.device)
        if not request.out.exists():
            worker.builder(request, _progress_writer(job_id), should_stop)


@DBOS.step()
def register(job_id: str) -> str:
    """Move the asset to its place and list it; does nothing that was already done."""
    with _failures_recorded(job_id):
        directory = _worker().directory
        built, place = directory.job(job_id) / "asset", directory.asset(job_id)
        if built.exists() and not place.exists():
            built.rename(place)
        counts = count_asset_folder(place)
        with Session(_worker().engine) as session, session.begin():
            job = session.get_one(JobRow, job_id)
            session.merge(
                AssetRow(
                    id=job_id,
                    name=job.name,
                    created_at=now(),
                    source="build",
                    bytes=folder_bytes(place),
                    surfel_count=counts.surfels,
                    vertex_count=counts.vertices,
                    face_count=counts.faces,
                )
            )
            job.asset_id, job.finished_at, job.fraction, job.stage, job.eta_seconds, job.message = job_id, now(), 1.0, "done", None, ""
        shutil.rmtree(directory.job(job_id) / "asset.build", ignore_errors=True)
        return job_id


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
    return text if isinstance(error, ValueError) else f"{type(error).__name__}: {text}"


def _stop_flag(job_id: str) -> Callable[[], bool]:
    """A cheap `should_stop`: asks the database at most four times a second."""
    checked_at, stop = 0.0, False

    def should_stop() -> bool:
        nonlocal checked_at, stop
        if _worker().stopping.is_set():
            return True
        if not stop and time.monotonic() - checked_at > STOP_POLL_SECONDS:
            checked_at = time.monotonic()
            with Session(_worker().engine) as session:
                row = session.get(JobRow, job_id)
                stop = row is None or row.cancel_requested
        return stop

    return should_stop


@contextlib.contextmanager
def _only_run(folder: Path, should_stop: Callable[[], bool]) -> Iterator[None]:
    """Two executions of one job can meet: a retry while the cancelled run still writes its checkpoint."""
    while (lock := try_lock_file(folder / ".lock")) is None:
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
    with Session(_worker().engine) as session, session.begin():
        session.execute(update(JobRow).where(JobRow.id == job_id).values(**values))
