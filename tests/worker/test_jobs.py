"""Jobs through a real worker process and a real queue on SQLite, with a builder that only counts."""

import json
import os
import signal
import subprocess
import sys
import time
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy.orm import Session

from drgs_worker.jobs.builders import BUILDER_VARIABLE
from drgs_worker.jobs.queue import JobNotInState, JobQueue
from drgs_worker.store.data_directory import DataDirectory, open_data_directory
from drgs_worker.store.database import JobRow, now, open_database
from tests.new_databases import put_new_databases
from tests.patience import PATIENCE_SECONDS

REPOSITORY = Path(__file__).parents[2]


class Bench:
    """A data directory, its queue as the API sees it, and worker processes that the test may end as it likes."""

    def __init__(self, root: Path) -> None:
        self.root = root
        put_new_databases(root / "data")
        self.directory: DataDirectory = open_data_directory(root / "data")
        self.engine = open_database(self.directory)
        self.queue = JobQueue(self.directory, self.engine)
        self.workers: list[subprocess.Popen] = []

    def environment(self) -> dict[str, str]:
        paths = [Path(__file__).parent, REPOSITORY, REPOSITORY / "worker"]
        return {**os.environ, BUILDER_VARIABLE: "tiny_builder:build", "PYTHONPATH": os.pathsep.join(map(str, paths))}

    def start_worker(self) -> subprocess.Popen:
        command = [sys.executable, "-m", "drgs_worker", "--data", str(self.directory.root)]
        worker = subprocess.Popen(command, env=self.environment(), cwd=self.root)
        self.workers.append(worker)
        return worker

    def submit(self, priority: int = 100, limits: dict | None = None, **plan: object) -> str:
        job_id = uuid.uuid4().hex
        capture = self.directory.uploads / job_id
        capture.mkdir()
        (capture / "plan.json").write_text(json.dumps({"iterations": 3, "seconds": 0.02, **plan}))
        row = JobRow(id=job_id, kind="build", name="tiny", dataset=str(capture), preset="draft", seed=0, created_at=now())
        row.priority, row.parameters = priority, {"limits": limits or {}}
        self.queue.submit(row)
        return job_id

    def stages_run(self, job_id: str) -> list[tuple[str, str]]:
        """(stage, begins or ends), in order, without the fit."""
        lines = (self.directory.job(job_id) / "stages.txt").read_text().splitlines()
        return [(line.split()[1], line.split()[2]) for line in lines]

    def state(self, job_id: str) -> str:
        return self.queue.statuses([job_id])[job_id].state

    def row(self, job_id: str) -> JobRow:
        with Session(self.engine) as session:
            return session.get_one(JobRow, job_id)

    def wait(self, condition: Callable[[], bool]) -> float:
        """Seconds until it held."""
        start = time.monotonic()
        while not condition():
            assert time.monotonic() - start < PATIENCE_SECONDS, "waited too long"
            time.sleep(0.03)
        return time.monotonic() - start

    def wait_for(self, job_id: str, state: str) -> float:
        try:
            return self.wait(lambda: self.state(job_id) == state)
        except AssertionError as error:
            raise AssertionError(f"expected {state}, still {self.state(job_id)}: {self.row(job_id).error}") from error

    def iterations_run(self, job_id: str) -> list[tuple[int, int]]:
        """(process, iteration), in order."""
        lines = (self.directory.job(job_id) / "ran.txt").read_text().split("\n")
        return [(int(line.split()[0]), int(line.split()[1])) for line in lines if line]

    def end(self) -> None:
        for worker in self.workers:
            if worker.poll() is None:
                worker.kill()  # an orderly end takes seconds, and has its own test
        for worker in self.workers:
            worker.wait(PATIENCE_SECONDS)
        self.queue.close()
        self.engine.dispose()


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    bench = Bench(tmp_path)
    yield bench
    bench.end()


@pytest.fixture(scope="module")
def working(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    """With a worker that goes on from test to test: its start takes more of a core than its jobs."""
    bench = Bench(tmp_path_factory.mktemp("working"))
    bench.start_worker()
    yield bench
    bench.end()


@pytest.mark.slow
def test_a_job_runs_to_the_end_and_its_asset_is_listed(bench: Bench) -> None:
    found = {"summary": "4 pictures.", "findings": [{"level": "warning", "sentence": "4 views are few.", "advice": "Take more."}]}
    job = bench.submit(found=found, folders=["posed", "posed.frames"])
    assert bench.state(job) == "queued"
    bench.start_worker()
    bench.wait_for(job, "done")
    row = bench.row(job)
    assert row.capture_report == found, "kept, though told right after other progress"
    assert (row.asset_id, row.fraction, row.attempts, row.error) == (job, 1.0, 1, None)
    assert row.preview_version == 3 and bench.directory.preview(job).read_bytes() == b"\xff\xd8tiny"
    assert (bench.directory.asset(job) / "asset.json").exists()
    assert {path.name for path in (bench.directory.job(job) / "asset.build").iterdir()} == {
        "stage1.safetensors",
        "mesh.safetensors",
        "surface.safetensors",
        "posed",
    }
    log = bench.directory.job_log(job).read_text()
    assert [line.split()[1] for line in log.splitlines()[::2]] == ["read:", "fit:", "mesh:", "surface:", "materials:", "pack:", "register:"]


@pytest.mark.slow
def test_a_job_survives_kill_9_of_its_worker_and_goes_on_from_the_checkpoint(bench: Bench) -> None:
    job = bench.submit(iterations=30, seconds=0.05)
    first = bench.start_worker()
    bench.wait(lambda: bench.row(job).iteration >= 5)
    first.kill()
    first.wait()
    assert bench.state(job) == "stalled"
    second = bench.start_worker()
    bench.wait_for(job, "done")
    ran = bench.iterations_run(job)
    assert {process for process, _ in ran} == {first.pid, second.pid}
    repeated = len(ran) - len({iteration for _, iteration in ran})
    assert sorted({iteration for _, iteration in ran}) == list(range(30)) and repeated <= 1
    assert bench.row(job).attempts == 2


@pytest.mark.slow
@pytest.mark.parametrize("killed_in", [("read", "mesh"), ("materials", "pack")])
def test_kill_9_in_any_stage_repeats_no_finished_one_and_gives_the_same_asset(bench: Bench, killed_in: tuple[str, str]) -> None:
    job = bench.submit(iterations=2, seconds=0.0, stage_seconds=0.1)
    notes = bench.directory.job(job) / "stages.txt"
    for stage in killed_in:
        worker = bench.start_worker()
        bench.wait(lambda begins=f"{worker.pid} {stage} begins": notes.exists() and begins in notes.read_text())
        worker.kill()
        worker.wait()
    bench.start_worker()
    bench.wait_for(job, "done")
    begun = [name for name, what in bench.stages_run(job) if what == "begins"]
    assert begun.count("read") == 3, begun  # every process reads the capture; nothing else that was finished is done again
    for name in ("mesh", "surface", "materials", "pack"):
        assert begun.count(name) == 1 + (name in killed_in), begun
    assert [iteration for _, iteration in bench.iterations_run(job)] == [0, 1]
    assert json.loads((bench.directory.asset(job) / "asset.json").read_text())["counts"]["faces"] == 20
    steps = [line.split(" ", 1)[1] for line in bench.directory.job_log(job).read_text().splitlines()]
    for name in ("read", "fit", "mesh", "surface", "materials", "pack", "register"):
        assert sum(step.startswith(f"{name}: started") for step in steps) == 1 + (name in killed_in), steps
        assert sum(step.startswith(f"{name}: finished") for step in steps) == 1, steps


@pytest.mark.slow
def test_a_job_beyond_its_limits_ends_with_a_sentence(working: Bench) -> None:
    job = working.submit(iterations=200, seconds=0.05, limits={"seconds": 0.5})
    working.wait_for(job, "failed")
    assert working.row(job).error == "The job took longer than its limit of 0.5 s."
    assert not working.directory.asset(job).exists()


@pytest.mark.slow
def test_jobs_of_lower_number_run_first(working: Bench) -> None:
    occupying = working.submit(iterations=1000)
    working.wait(lambda: working.row(occupying).iteration >= 1)
    later, sooner = working.submit(priority=200), working.submit(priority=1)
    working.queue.cancel(occupying)
    working.wait_for(later, "done")
    first, second = working.row(sooner), working.row(later)
    assert first.finished_at is not None and second.finished_at is not None and first.finished_at < second.finished_at


@pytest.mark.slow
def test_a_job_goes_on_after_its_worker_was_asked_to_end(bench: Bench) -> None:
    job = bench.submit(iterations=30, seconds=0.05)
    first = bench.start_worker()
    bench.wait(lambda: bench.row(job).iteration >= 3)
    first.send_signal(signal.SIGTERM)
    assert first.wait(PATIENCE_SECONDS) == 0
    assert bench.state(job) == "stalled" and bench.row(job).error is None
    assert bench.row(job).unended == 0, "a stop in order is no death"
    bench.start_worker()
    bench.wait_for(job, "done")
    assert [iteration for _, iteration in bench.iterations_run(job)] == list(range(30))


@pytest.mark.slow
def test_a_job_fails_at_the_third_death_of_its_worker_whoever_handed_it_over(bench: Bench) -> None:
    job = bench.submit(die_at=0)
    with Session(bench.engine) as session, session.begin():
        session.get_one(JobRow, job).unended = 2  # two deaths before
    worker = bench.start_worker()
    assert worker.wait(PATIENCE_SECONDS) == -signal.SIGKILL
    assert (bench.row(job).unended, bench.state(job)) == (3, "stalled")
    bench.queue.resume(job)  # as if to another worker
    bench.start_worker()
    bench.wait_for(job, "failed")
    assert bench.row(job).error == "The worker died 3 times while it ran this job; it may need more memory than there is."
    (bench.directory.uploads / job / "plan.json").write_text(json.dumps({"iterations": 1, "seconds": 0}))
    bench.queue.retry(job)
    bench.wait_for(job, "done")
    assert bench.row(job).unended == 0


@pytest.mark.slow
def test_a_running_job_is_cancelled_within_two_seconds_and_can_be_retried(working: Bench) -> None:
    job = working.submit(iterations=60, seconds=0.05)
    working.wait(lambda: working.row(job).iteration >= 2)
    working.queue.cancel(job)
    assert working.state(job) == "cancelled"
    cancelled_at = time.time()
    count = -1

    def stopped() -> bool:
        nonlocal count
        before, count = count, len(working.iterations_run(job))
        time.sleep(0.5)
        return before == count

    working.wait(stopped)
    assert (working.directory.job(job) / "ran.txt").stat().st_mtime - cancelled_at < 2.0
    assert working.row(job).asset_id is None
    with pytest.raises(JobNotInState, match="This job is cancelled"):
        working.queue.cancel(job)
    working.queue.retry(job)
    working.wait_for(job, "done")
    assert [iteration for _, iteration in working.iterations_run(job)] == list(range(60))


@pytest.mark.slow
def test_a_failed_job_says_why_and_can_be_retried(working: Bench) -> None:
    job = working.submit(fail="The capture has no cameras.")
    working.wait_for(job, "failed")
    assert working.row(job).error == "The capture has no cameras."
    (working.directory.uploads / job / "plan.json").write_text(json.dumps({"iterations": 1, "seconds": 0}))
    working.queue.retry(job)
    working.wait_for(job, "done")
    assert working.row(job).error is None


@pytest.mark.slow
def test_another_worker_takes_over_what_a_dead_one_left(bench: Bench) -> None:
    workers = {worker.pid: worker for worker in (bench.start_worker(), bench.start_worker())}
    bench.wait(lambda: len(bench.queue.alive_workers()) == 2)
    job = bench.submit(iterations=30, seconds=0.05)
    bench.wait(lambda: bench.row(job).iteration >= 2)
    with pytest.raises(JobNotInState, match="worker is alive"):
        bench.queue.resume(job)
    first = workers.pop(bench.iterations_run(job)[0][0])
    first.kill()
    first.wait()
    dead = bench.row(job).worker_id
    assert dead is not None
    with pytest.raises(ValueError, match=f"known ones: .*{dead}"):
        bench.queue.requeue_worker("nobody-0")
    with pytest.raises(ValueError, match="runs on this machine"):
        bench.queue.requeue_worker(next(name for name in bench.queue.alive_workers() if name != dead))
    assert bench.queue.requeue_worker(dead) == [job]
    assert bench.queue.requeue_dead() in ([], [job])
    bench.wait_for(job, "done")
    assert bench.iterations_run(job)[-1][0] in workers


@pytest.mark.slow
def test_an_unknown_job_is_not_done(bench: Bench) -> None:
    assert bench.state("no-such-job") == "unknown"


@pytest.mark.slow
def test_a_job_on_its_way_to_the_queue_is_read_as_queued(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = []

    def look_then_fail(*_: object) -> None:
        seen.append(bench.state("on-its-way"))
        raise ConnectionError("the queue's database went away")

    monkeypatch.setattr(bench.queue._client, "enqueue", look_then_fail)
    row = JobRow(id="on-its-way", kind="build", name="tiny", dataset="nowhere", preset="draft", seed=0, created_at=now())
    with pytest.raises(ConnectionError):
        bench.queue.submit(row)
    assert seen == ["queued"]
    assert bench.state("on-its-way") == "unknown"


@pytest.mark.slow
def test_a_job_cancelled_on_its_way_to_the_queue_is_cancelled(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    enqueue = bench.queue._client.enqueue

    def cancel_first(*arguments: Any) -> Any:
        bench.queue.cancel("cancelled-early")
        return enqueue(*arguments)

    monkeypatch.setattr(bench.queue._client, "enqueue", cancel_first)
    bench.queue.submit(JobRow(id="cancelled-early", kind="build", name="tiny", dataset="nowhere", preset="draft", seed=0, created_at=now()))
    assert bench.state("cancelled-early") == "cancelled"


@pytest.mark.slow
def test_a_job_that_never_reached_the_queue_is_unknown_until_it_is_retried(bench: Bench) -> None:
    row = JobRow(id="stored-only", kind="build", name="tiny", dataset="nowhere", preset="draft", seed=0, created_at=now())
    with Session(bench.engine) as session, session.begin():
        session.add(row)
    assert bench.state("stored-only") == "unknown"
    bench.queue.retry("stored-only")
    assert bench.state("stored-only") == "queued"
