"""The short form of the abuse benchmark holds, and its judges see what does not."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.serve.abuse import all_trials
from benchmarks.serve.trials.shapes import ball, exr, hdr, ply, read_exr
from benchmarks.serve.trials.site import Answer, Site
from benchmarks.serve.trials.watch import percentile_ms

ROOT = Path(__file__).parents[3]


def test_there_are_more_than_three_hundred_trials_with_names_of_their_own() -> None:
    trials = list(all_trials())
    names = [(trial.group, trial.name) for trial in trials]
    assert len(trials) >= 300 and len(set(names)) == len(names)
    assert sum(trial.quick for trial in trials) >= 300


def test_nothing_of_the_server_is_imported_by_its_judge() -> None:
    code = "import sys, benchmarks.serve.abuse; print([name for name in sys.modules if name.split('.')[0].startswith('drgs')])"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def answer(status: int, **problem: str) -> Answer:
    return Answer(status, {"content-type": "application/problem+json"}, json.dumps(problem).encode(), 0.1)


@pytest.mark.parametrize(
    ("found", "words"),
    [
        (answer(500, detail="The server made an error."), "answered 500"),
        (answer(200), "answered 200"),
        (answer(422, detail="x" * 5000), "5000 characters"),
        (answer(422, detail="/srv/drgs/data/token: is wrong"), "inside"),
        (answer(429, detail="Come again."), "without Retry-After"),
    ],
)
def test_a_wrong_answer_is_seen(found: Answer, words: str) -> None:
    complaint = Site(Path("/srv/drgs")).complaint(found)
    assert complaint is not None and words in complaint


def test_a_right_refusal_is_none() -> None:
    assert Site(Path("/srv/drgs")).complaint(answer(422, detail="width: expected at least 16.")) is None


def test_the_files_that_are_sent_are_what_they_say() -> None:
    vertices, faces = ball(5)
    edges = {tuple(edge) for face in faces for edge in zip(face, face[[1, 2, 0]], strict=True)}
    assert all((b, a) in edges for a, b in edges), "the ball is not closed"
    assert ply(vertices, faces).count(b"element") == 2
    channels = read_exr(exr(vertices[:8].reshape(2, 4, 3)))
    assert sorted(channels) == ["B", "G", "R"] and channels["R"].shape == (2, 4)
    assert len(hdr(16384, 8192, (128, 128, 128, 129))) < 10 << 20


def test_percentiles_of_answers_that_never_came_are_none() -> None:
    assert percentile_ms([0.001] * 99 + [float("inf")], 0.5) == 1.0
    assert percentile_ms([0.001] * 9 + [float("inf")], 0.99) is None and percentile_ms([], 0.5) is None


@pytest.mark.slow
def test_the_short_form_holds() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks", "abuse", "--quick", "--json"], cwd=ROOT, capture_output=True, text=True, env={**os.environ}
    )
    found = json.loads(done.stdout)
    assert found["failed"] == 0, found["failures"]
    assert found["held"] >= 300 and done.returncode == 0
