"""The queue as the API sees it: enqueue, cancel, retry, list, give a dead worker's jobs to a living one.

Uses DBOSClient only. DBOS.launch() in the API process would restart the PENDING jobs of its executor, and so run a live job twice.
Arguments and results are small JSON. A queue row tagged as pickled would still be unpickled on reading, so inputs and outputs are
never loaded here, and pickle reading is switched off (`refuse_pickled_rows`).
"""

import os
import socket
from collections.abc import Iterable
from dataclasses import dataclass

from dbos import DBOS, DBOSClient, DBOSPortableJSONSerializer
from dbos._schemas.system_database import SystemSchema
from dbos._serialization import DefaultSerializer
from sqlalchemy import Engine, select
from sqlalchemy.orm import Session

from drgs_worker.store.backups import check_database
from drgs_worker.store.data_directory import DataDirectory, lock_file
from drgs_worker.store.database import JobRow, WorkerRow, now

QUEUE_NAME = "builds"
JOB_WORKFLOW = "run_job"
JOBS_VERSION = "2"
"""Raise it when a workflow's steps change, so that a worker of another version leaves older jobs alone. DBOS would otherwise hash
the source code, and any edit of it would orphan the jobs that wait."""
APPLICATION_NAME = "drgs"
HEARTBEAT_SECONDS = 2.0
DEAD_AFTER_SECONDS = 15.0
"""Without a heartbeat. A worker on this machine whose process is gone counts as dead at once."""

_STATUS = SystemSchema.workflow_status
_STATES = {
    "ENQUEUED": "queued",
    "DELAYED": "queued",
    "PENDING": "running",
    "SUCCESS": "done",
    "ERROR": "failed",
    "MAX_RECOVERY_ATTEMPTS_EXCEEDED": "failed",
    "CANCELLED": "cancelled",
}


@dataclass(frozen=True)
class JobStatus:
    """What the queue says of one job."""

    state: str
    """queued, running, stalled, done, failed, cancelled or unknown."""


class JobNotInState(Exception):
    """A job cannot be cancelled, retried or resumed as it is; the text is a sentence."""


class JobQueue:
    """Final. One an API process; thread-safe as DBOSClient is."""

    def __init__(self, directory: DataDirectory, engine: Engine) -> None:
        refuse_pickled_rows()
        self._engine = engine
        self._on_their_way: set[str] = set()
        migrate_queue(directory)
        self._client = DBOSClient(
            system_database_url=directory.queue_url, serializer=DBOSPortableJSONSerializer(), application_name=APPLICATION_NAME
        )

    def close(self) -> None:
        self._client.destroy()

    def submit(self, row: JobRow) -> None:
        """Store the job and enqueue it; a job that was stored but not enqueued reads `unknown`, never done.

        The two lie in two databases, and others may read the job between them: until this call ends it reads `queued`.
        """
        job_id = row.id
        self._on_their_way.add(job_id)
        try:
            with Session(self._engine, expire_on_commit=False) as session, session.begin():
                session.add(row)
            self._enqueue(row)
            with Session(self._engine) as session:
                stored = session.get(JobRow, job_id)
            if stored is not None and stored.cancel_requested:  # before the queue knew what to cancel
                self._client.cancel_workflow(job_id)
        finally:
            self._on_their_way.discard(job_id)

    def _enqueue(self, row: JobRow) -> None:
        self._client.enqueue(
            {
                "workflow_name": JOB_WORKFLOW,
                "queue_name": QUEUE_NAME,
                "workflow_id": row.id,
                "app_version": JOBS_VERSION,
                "priority": row.priority,
                "application_name": APPLICATION_NAME,
            },
            row.id,
        )

    def statuses(self, job_ids: Iterable[str], workers: Iterable[WorkerRow] | None = None) -> dict[str, JobStatus]:
        """One for each id, `unknown` for those the queue has never heard of.

        Args:
            workers: as `workers()` says, if the caller has asked already.
        """
        wanted = list(job_ids)
        if not wanted:
            return {}
        # Before the queue is asked: a job that arrives there meanwhile is then in one of the two.
        on_their_way = self._on_their_way.intersection(wanted)
        # Three columns of DBOS's table: its own list reads thirty, which is most of what listing 500 jobs costs.
        query = select(_STATUS.c.workflow_uuid, _STATUS.c.status, _STATUS.c.executor_id).where(_STATUS.c.workflow_uuid.in_(wanted))
        with self._client._sys_db.engine.connect() as connection:
            found = {row.workflow_uuid: row for row in connection.execute(query)}
        dead = {row.id for row in (self.workers() if workers is None else workers) if not is_alive(row)}
        answer = {}
        for job_id in wanted:
            row = found.get(job_id)
            missing = "queued" if job_id in on_their_way else "unknown"
            state = _STATES.get(row.status, "unknown") if row else missing
            if row and state == "running" and row.executor_id in dead:
                state = "stalled"
            answer[job_id] = JobStatus(state)
        return answer

    def cancel(self, job_id: str) -> None:
        """Ask for the end: no step starts any more, and the running one sees the flag within a second.

        Raises:
            JobNotInState: it is over.
        """
        state = self.statuses([job_id])[job_id].state
        if state not in ("queued", "running", "stalled"):
            raise JobNotInState(f"This job is {state}; only a job that waits or runs can be cancelled.")
        with Session(self._engine) as session, session.begin():
            row = session.get_one(JobRow, job_id)
            row.cancel_requested = True
            row.finished_at = now()
        self._client.cancel_workflow(job_id)

    def retry(self, job_id: str) -> None:
        """Start a failed or cancelled job again; its build goes on from the checkpoint. One that never reached the queue is enqueued.

        Raises:
            JobNotInState: it is none of these.
        """
        state = self.statuses([job_id])[job_id].state
        if state not in ("failed", "cancelled", "unknown"):
            raise JobNotInState(f"This job is {state}; only a failed or cancelled job can be retried.")
        with Session(self._engine, expire_on_commit=False) as session, session.begin():
            row = session.get_one(JobRow, job_id)
            row.cancel_requested, row.error, row.finished_at, row.message, row.unended = False, None, None, "", 0
        if state == "unknown":
            self._enqueue(row)
        else:
            self._client.rewind_workflow(job_id, queue_name=QUEUE_NAME)

    def resume(self, job_id: str) -> None:
        """Hand a job whose worker is dead to whichever worker is free.

        Raises:
            JobNotInState: its worker lives, or it does not run.
        """
        state = self.statuses([job_id])[job_id].state
        if state == "running":
            raise JobNotInState("This job's worker is alive and works on it.")
        if state != "stalled":
            raise JobNotInState(f"This job is {state}; only a stalled job can be resumed, and a failed or cancelled one retried.")
        self._client.resume_workflow(job_id, queue_name=QUEUE_NAME)

    def requeue_dead(self) -> list[str]:
        """Hand over all jobs of dead workers, if some worker is alive to take them. Returns their ids."""
        dead = {row.id for row in self.workers() if not is_alive(row)}
        if not dead or not self.alive_workers():
            return []
        rows = self._client.list_workflows(status="PENDING", executor_id=sorted(dead), load_input=False, load_output=False)
        for row in rows:
            self._client.resume_workflow(row.workflow_id, queue_name=QUEUE_NAME)
        return [row.workflow_id for row in rows]

    def requeue_worker(self, worker_id: str) -> list[str]:
        """Hand over the jobs of a worker of which an operator knows that it will not come back. Returns their ids.

        Raises:
            ValueError: its process runs on this machine, or nobody has heard of it.
        """
        with Session(self._engine) as session:
            row = session.get(WorkerRow, worker_id)
            if row is None:
                known = ", ".join(session.scalars(select(WorkerRow.id).order_by(WorkerRow.id))) or "none"
                raise ValueError(f"no worker is called {worker_id!r}; known ones: {known}")
        if worker_id.rpartition("-")[0] == socket.gethostname() and is_alive(row):
            raise ValueError(f"worker {worker_id} runs on this machine (process {row.pid}); stop it instead")
        rows = self._client.list_workflows(status="PENDING", executor_id=worker_id, load_input=False, load_output=False)
        for found in rows:
            self._client.resume_workflow(found.workflow_id, queue_name=QUEUE_NAME)
        return [found.workflow_id for found in rows]

    def active_count(self) -> int:
        """Jobs that wait or run."""
        return len(self._client.list_workflows(status=["ENQUEUED", "DELAYED", "PENDING"], load_input=False, load_output=False))

    def workers(self) -> list[WorkerRow]:
        """All that ever were."""
        with Session(self._engine) as session:
            return list(session.scalars(select(WorkerRow)))

    def alive_workers(self) -> list[str]:
        return [row.id for row in self.workers() if is_alive(row)]


def is_alive(worker: WorkerRow) -> bool:
    """By its process where it runs on this machine, and by its heartbeat."""
    if worker.id.rpartition("-")[0] == socket.gethostname():
        try:
            os.kill(worker.pid, 0)
        except ProcessLookupError:
            return False
        except PermissionError:
            return True
    return now() - worker.heartbeat_at < DEAD_AFTER_SECONDS


def migrate_queue(directory: DataDirectory) -> None:
    """Make or upgrade DBOS's tables; DBOSClient itself never does.

    Raises:
        ValueError: a SQLite database is damaged or cannot be opened; the sentence says what to do.
    """
    check_database(directory, directory.queue_url)
    with lock_file(directory.root / ".setup.lock"):
        DBOS.migrate(directory.queue_url)


def refuse_pickled_rows() -> None:
    """DBOS decodes each row by the tag stored in it, so one tagged py_pickle would be unpickled whatever serializer we configure."""

    def refuse(self: DefaultSerializer, serialized_data: str) -> object:
        raise ValueError("the jobs database holds a pickled value; drgs writes none, so somebody else did")

    DefaultSerializer.deserialize = refuse  # type: ignore[assignment,method-assign]
