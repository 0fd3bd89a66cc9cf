"""A search for poses as a job: it stops and goes on, and what it finds is a capture that builds can read."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from PIL import Image
from sqlalchemy import select
from sqlalchemy.orm import Session

from drgs.reconstruct.capture.load_views import read_capture
from drgs.reconstruct.pose import posed_dataset
from drgs.reconstruct.pose.pose_photographs import PoseSettings
from drgs.reconstruct.progress import Progress
from drgs_worker.jobs.capture_report import CaptureReport
from drgs_worker.jobs.progress import JobStopped
from drgs_worker.jobs.steps.job_run import JobContext
from drgs_worker.jobs.steps.pose import PoseRun
from drgs_worker.store.data_directory import open_data_directory
from drgs_worker.store.database import CaptureRow, open_database
from tests.reconstruct.pose.textured_scene import orbit, write_photographs

pytest.importorskip("pycolmap")

JOB = "c" * 32
VIEWS, AROUND = 8, 24
"""The fewest that are posed, and how many would go all round at their distance from each other."""


@pytest.fixture(scope="module")
def photographs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = write_photographs(tmp_path_factory.mktemp("plain") / "photos", orbit(AROUND)[:VIEWS], masks=True)
    (folder / "broken.jpg").write_bytes(b"\xff\xd8\xff")
    shutil.copy(next((folder / "masks").iterdir()), folder / "masks" / "broken.png")
    return folder


@pytest.fixture
def context(tmp_path: Path) -> Callable[..., JobContext]:
    directory = open_data_directory(tmp_path / "data")
    engine = open_database(directory)
    directory.job(JOB).mkdir()

    def make(dataset: Path, said: list, should_stop: Callable[[], bool] = lambda: False) -> JobContext:
        parameters = {"kind": "pose", "seed": 0}
        return JobContext(JOB, "Egg", parameters, dataset, directory, engine, None, "cpu", said.append, should_stop)  # type: ignore[arg-type]

    return make


@pytest.mark.slow
def test_photographs_become_a_capture_that_builds_read(
    context: Callable[..., JobContext], photographs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = posed_dataset.pose_photographs

    def quick(photos: Path, out: Path, settings: PoseSettings, *rest: object):  # type: ignore[no-untyped-def]
        return real(photos, out, PoseSettings(seed=settings.seed, resume=settings.resume, most_features=800), *rest)

    monkeypatch.setattr(posed_dataset, "pose_photographs", quick)
    said: list = []
    # Stopped as soon as features are looked for; a worker that goes on does so in an execution of its own.
    stopped = PoseRun(context(photographs, said, lambda: any(told.stage == "features" for told in said)))
    with pytest.raises(JobStopped):
        stopped.run("pose")
    fractions = [told.fraction for told in said if isinstance(told, Progress)]
    assert 0 < max(fractions) < 1
    run = PoseRun(context(photographs, said))
    run.run("pose")
    report = said[-1]
    assert isinstance(report, CaptureReport) and report.summary.startswith(f"{VIEWS} of {VIEWS + 1} pictures found their place")
    assert report.findings[0].sentence.startswith("broken was left out: ")
    for _ in range(2):  # once more after a crash that came before the step was recorded
        run.run("register")
    made = context(photographs, [])
    place = made.directory.uploads / JOB
    with Session(made.engine) as session:
        (row,) = session.scalars(select(CaptureRow)).all()
    assert (row.id, row.name, row.folder) == (JOB, "Egg, posed", JOB)
    capture = read_capture(place)
    assert len(capture.photographs) == VIEWS and all(photograph.mask is not None for photograph in capture.photographs)
    assert not (made.folder / "posed").exists()


def test_what_is_no_folder_of_photographs_is_refused_with_a_sentence(context: Callable[..., JobContext], tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="is gone; it was removed"):
        PoseRun(context(tmp_path / "none", [])).run("pose")
    posed = tmp_path / "posed"
    posed.mkdir()
    Image.new("RGB", (8, 8)).save(posed / "a.jpg")
    (posed / "transforms.json").write_text(json.dumps({}))
    with pytest.raises(ValueError, match="part of a posed capture"):
        PoseRun(context(posed, [])).run("pose")
