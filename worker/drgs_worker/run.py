"""`drgs worker`: take builds from the queue until told to stop.

SIGTERM and Ctrl-C: the running build writes its checkpoint and stays in the queue as it is, so the next start goes on with it.
"""

import logging
import os
import signal
import socket
import sys
import threading
from pathlib import Path
from types import FrameType

from dbos import DBOS, DBOSPortableJSONSerializer
from sqlalchemy import Engine
from sqlalchemy.exc import OperationalError
from sqlalchemy.orm import Session

from drgs.openmp import spin_briefly
from drgs_worker.jobs.builders import find_builder
from drgs_worker.jobs.queue import (
    APPLICATION_NAME,
    HEARTBEAT_SECONDS,
    JOBS_VERSION,
    QUEUE_NAME,
    JobQueue,
    migrate_queue,
    refuse_pickled_rows,
)
from drgs_worker.jobs.workflows import WorkerContext, set_context
from drgs_worker.logs import set_up_logging
from drgs_worker.store.artifact_store import StoreAway
from drgs_worker.store.artifacts import remove_deleted_elsewhere
from drgs_worker.store.data_directory import DataDirectory, open_data_directory, try_lock_file
from drgs_worker.store.database import WorkerRow, now, open_database
from drgs_worker.store.settings import read_settings

SHUTDOWN_SECONDS = 30
"""For the checkpoint of a build that is told to stop."""
MAX_SLOTS = 64
MODESTY = 3
"""Nice value, less than that of threads that render: beside a viewer that moves all the time a build gets more than half of the machine, and the viewer's
pictures get smaller; the event loop and a browser, which need little, come before either. `python -m benchmarks beside` tells both."""


def run_worker(data: Path | None = None, device: str | None = None, parent_pid: int | None = None) -> int:
    """Work until SIGTERM, SIGINT, or until the process `parent_pid` is gone. Returns the exit code.

    Args:
        data, device: those of the settings where None.

    Raises:
        ValueError: a setting is wrong, or the data directory cannot be used.
    """
    settings = read_settings(data=data, device=device)
    set_up_logging(settings.log_format)
    directory = open_data_directory(settings.data, settings.database_url, settings.queue_url, settings.artifact_url)
    worker_id, slot_lock = _claim_slot(directory)
    spin_briefly()
    os.nice(MODESTY)
    engine = open_database(directory)
    migrate_queue(directory)
    refuse_pickled_rows()
    try:
        remove_deleted_elsewhere(directory, engine)
    except StoreAway as error:  # the next start tries again
        logging.getLogger(__name__).warning("%s", error)
    stopping = threading.Event()
    set_context(WorkerContext(directory, engine, worker_id, find_builder(), settings.device, stopping))

    def stop(_signal: int, _frame: FrameType | None) -> None:
        stopping.set()

    signal.signal(signal.SIGTERM, stop)
    signal.signal(signal.SIGINT, stop)
    _beat(engine, worker_id, first=True)
    DBOS(
        config={
            "name": APPLICATION_NAME,
            "system_database_url": directory.queue_url,
            "application_version": JOBS_VERSION,
            "executor_id": worker_id,
            "run_migrations": False,
            "serializer": DBOSPortableJSONSerializer(),
            "log_level": "WARNING",
        }
    )
    DBOS.launch()
    DBOS.register_queue(QUEUE_NAME, worker_concurrency=1, polling_interval_sec=0.2)
    print(f"drgs worker {worker_id} takes builds from {directory.root}", file=sys.stderr, flush=True)
    while not stopping.wait(HEARTBEAT_SECONDS):
        try:
            _beat(engine, worker_id)
        except OperationalError as error:
            logging.getLogger(__name__).warning("the database does not answer: %s", error)
        if parent_pid is not None and os.getppid() != parent_pid:
            logging.getLogger(__name__).warning("the server that started this worker is gone")
            stopping.set()
    DBOS.destroy(workflow_completion_timeout_sec=SHUTDOWN_SECONDS)
    with Session(engine) as session, session.begin():
        if (row := session.get(WorkerRow, worker_id)) is not None:
            row.heartbeat_at = 0.0
    engine.dispose()
    os.close(slot_lock)
    return 0


def requeue_worker(data: Path | None, worker_id: str) -> list[str]:
    """Give the jobs of a worker that will not come back to the others. Returns their ids.

    Raises:
        ValueError: a setting is wrong, nobody has heard of the worker, or it runs on this machine.
    """
    settings = read_settings(data=data)
    directory = open_data_directory(settings.data, settings.database_url, settings.queue_url, settings.artifact_url)
    engine = open_database(directory)
    queue = JobQueue(directory, engine)
    try:
        return queue.requeue_worker(worker_id)
    finally:
        queue.close()
        engine.dispose()


def _claim_slot(directory: DataDirectory) -> tuple[str, int]:
    """`hostname-N` with the smallest free N: after kill -9 the kernel frees the lock, so a restart gets the same name."""
    for slot in range(MAX_SLOTS):
        lock = try_lock_file(directory.workers / f"slot-{slot}.lock")
        if lock is not None:
            return f"{socket.gethostname()}-{slot}", lock
    raise ValueError(f"{MAX_SLOTS} workers already use {directory.root} on this machine; expected fewer")


def _beat(engine: Engine, worker_id: str, first: bool = False) -> None:
    with Session(engine) as session, session.begin():
        row = session.get(WorkerRow, worker_id)
        if row is None:
            row = WorkerRow(id=worker_id, pid=os.getpid(), started_at=now(), heartbeat_at=now())
            session.add(row)
        if first:
            row.pid, row.started_at = os.getpid(), now()
        row.heartbeat_at = now()
