"""What two commits are compared by, and a whole comparison in a small repository of its own."""

import json
import os
import shutil
import subprocess
from pathlib import Path

import pytest

from benchmarks.commits import compare
from benchmarks.commits._check_out import Side, checked_out, commit_hash
from benchmarks.commits._compare_runs import compare_runs, compare_times, kind_of, leaves
from benchmarks.commits._run_in_turns import turned
from benchmarks.commits.compare import asked_benchmarks
from drgs.openmp import SPINS

needs_git = pytest.mark.skipif(shutil.which("git") is None, reason="commits are compared by git")


def test_keys_of_nested_documents_are_joined_by_dots_and_items_are_numbered():
    document = {"ms": 1.5, "steps": {"trace": {"ms": 2}}, "rows": [{"seconds": 3, "name": "bunny"}, 4], "none": []}
    assert dict(leaves(document)) == {"ms": 1.5, "steps.trace.ms": 2, "rows.0.seconds": 3, "rows.0.name": "bunny", "rows.1": 4}


@pytest.mark.parametrize(
    ("kind", "keys"),
    [
        ("time", ["ms", "forward_ms", "ms_per_frame", "ns_per_particle_step", "reconnect_s", "milliseconds.trace", "rows.0.cpu_seconds"]),
        ("time", ["edit_to_frame_ms_worst", "seconds_per_stage.mesh", "ms_a_change_first_tenth"]),
        ("rate", ["fps_moving", "local_fps", "updates_per_second", "frames_per_second", "rays_per_s", "traced.fps_moving"]),
        ("figure", ["surfels", "substeps_per_frame", "relmse.0", "peak_memory_mib", "items", "programs"]),
    ],
)
def test_times_and_rates_are_told_by_the_words_of_their_keys(kind: str, keys: list[str]):
    assert {key: kind_of(key) for key in keys} == dict.fromkeys(keys, kind)


def verdict(values_a: list[float], values_b: list[float], is_rate: bool = False, threshold_percent: float = 3.0) -> str:
    return compare_times(values_a, values_b, threshold_percent, is_rate)["verdict"]


def test_medians_ratios_and_their_spread():
    # The machine was twice as slow in the second pair, which the ratios do not see.
    entry = compare_times([10.0, 20.0, 10.0, 10.0, 10.0], [11.0, 24.0, 12.0, 13.0, 14.0], 3.0, is_rate=False)
    assert entry == {
        "a": 10.0, "b": 13.0, "ratio": 1.2, "least": 1.1, "most": 1.4, "quartiles": [1.2, 1.3], "verdict": "slower",
    }  # fmt: skip
    assert compare_times([10.0], [10.0], 3.0, is_rate=False)["quartiles"] == [1, 1]


def test_what_takes_longer_in_all_pairs_is_slower_and_a_rate_counts_the_other_way_round():
    less, more = [10.01, 10.12, 9.93, 10.04, 10.05], [11.02, 11.14, 10.97, 11.11, 11.05]
    assert (verdict(less, more), verdict(more, less)) == ("slower", "faster")
    assert (verdict(less, more, is_rate=True), verdict(more, less, is_rate=True)) == ("faster", "slower")


def test_a_change_below_the_threshold_is_none():
    before, after = [10.01, 10.12, 9.93, 10.04, 10.05], [10.22, 10.33, 10.12, 10.24, 10.25]
    assert verdict(before, after) == "same" and verdict(before, after, threshold_percent=1) == "slower"
    assert verdict(after, before) == "same" and verdict(after, before, threshold_percent=1) == "faster"
    assert verdict(before, before) == "same"


def test_pairs_that_disagree_prove_nothing_but_one_in_eight_may():
    assert verdict([10.01] * 5, [12.01, 12.02, 12.03, 12.04, 9.05]) == "same"
    assert verdict([10.01] * 8, [12.01, 12.02, 12.03, 12.04, 12.05, 12.06, 12.07, 9.08]) == "slower"
    assert verdict([10.01] * 8, [12.01, 12.02, 12.03, 12.04, 12.05, 12.06, 9.07, 9.08]) == "same"
    # One that is equal agrees with nobody.
    assert verdict([10.01] * 5, [12.01, 12.02, 12.03, 12.04, 10.01]) == "same"


def test_the_last_digit_that_is_printed_is_no_change():
    assert verdict([0.3] * 5, [0.4] * 5) == "same" and verdict([0.3] * 5, [0.5] * 5) == "slower"
    assert verdict([10] * 5, [11] * 5) == "same" and verdict([100] * 5, [110] * 5) == "slower"


def test_other_figures_are_listed_where_they_differ_and_times_that_have_no_ratio():
    a = {"ms": 10.0, "surfels": 5, "error": 0.1, "device": "cpu", "idle_ms": 0.0, "gone_ms": 4.0, "ok": True}
    b = {"ms": 10.0, "surfels": 5, "error": 0.2, "device": "cuda", "idle_ms": 1.0, "new_ms": 4.0, "ok": False}
    comparison = compare_runs([(a, b)] * 5)
    assert list(comparison.times) == ["ms"] and comparison.times["ms"]["verdict"] == "same"
    assert comparison.figures == {
        "error": {"a": 0.1, "b": 0.2},
        "device": {"a": "cpu", "b": "cuda"},
        "idle_ms": {"a": 0.0, "b": 1.0},
        "gone_ms": {"a": 4.0, "b": None},
        "ok": {"a": True, "b": False},
        "new_ms": {"a": None, "b": 4.0},
    }


def test_pairs_run_in_turned_order():
    sides = (Side("A", "", Path()), Side("B", "", Path()))
    assert ["".join(side.letter for side in turned(sides, pair)) for pair in range(4)] == ["AB", "BA", "AB", "BA"]


def test_arguments_belong_to_one_benchmark():
    assert list(asked_benchmarks([], [])) == ["rasterize", "simulate", "carry"]
    assert asked_benchmarks(["carry", "arap"], []) == {"carry": compare.QUICK["carry"], "arap": []}
    assert asked_benchmarks(["carry"], ["--particles", "9"]) == {"carry": ["--particles", "9"]}
    for names in ([], ["carry", "arap"]):
        with pytest.raises(ValueError, match="those of one benchmark"):
            asked_benchmarks(names, ["--particles", "9"])


def test_a_commit_runs_its_own_code_and_chooses_its_own_waiting(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    monkeypatch.setenv("GOMP_SPINCOUNT", SPINS)
    monkeypatch.setenv("OPENBLAS_THREAD_TIMEOUT", "20")
    monkeypatch.setenv("PYTHONPATH", "elsewhere")
    environment = Side("A", "", tmp_path).environment()
    assert environment["PYTHONPATH"].split(os.pathsep) == [str(tmp_path), f"{tmp_path}/server", f"{tmp_path}/worker", "elsewhere"]
    assert "GOMP_SPINCOUNT" not in environment and environment["OPENBLAS_THREAD_TIMEOUT"] == "20"


FAKE = """
import json, pathlib, sys
assert sys.argv[1:] == ["speed", "--size", "3", "--json"], sys.argv
runs = pathlib.Path({runs!r})
number = len(runs.read_text()) if runs.exists() else 0
runs.write_text((runs.read_text() if number else "") + {letter!r})
print("working", file=sys.stderr)
print(json.dumps({{"work": {{"ms": {milliseconds} + 0.01 * number}}, "fps": 50.25, "faces": {milliseconds}, "page": {page}}}))
"""


def git(repository: Path, *arguments: str) -> str:
    command = ["git", "-C", str(repository), "-c", "user.name=A", "-c", "user.email=a@example.org", *arguments]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()


@pytest.fixture
def repository(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Three commits: the second prints slower numbers, the third fails. Its page is built and ignored, in the working tree only."""
    root = tmp_path / "repository"
    (root / "benchmarks").mkdir(parents=True)
    (root / "web").mkdir()
    git(root, "init", "--quiet")
    (root / ".gitignore").write_text("node_modules\n")
    (root / "web" / "build.py").write_text("")
    (root / "benchmarks" / "__init__.py").write_text("")
    page = "(pathlib.Path(__file__).parents[1] / 'web/node_modules').is_dir()"
    for letter, milliseconds in (("a", 20.25), ("b", 30.25)):
        text = FAKE.format(runs=str(tmp_path / "runs"), letter=letter, milliseconds=milliseconds, page=page)
        (root / "benchmarks" / "__main__.py").write_text(text)
        git(root, "add", ".")
        git(root, "commit", "--quiet", "--message", letter)
    (root / "benchmarks" / "__main__.py").write_text("raise SystemExit('the third commit is broken')")
    git(root, "commit", "--quiet", "--all", "--message", "c")
    (root / "web" / "node_modules").mkdir()
    monkeypatch.setattr(compare, "REPOSITORY", root)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "temporary"))
    (tmp_path / "temporary").mkdir()
    return root


def is_clean(repository: Path) -> bool:
    """Neither checkouts nor what git knows of them."""
    listed = git(repository, "worktree", "list").splitlines()
    return len(listed) == 1 and list((repository.parent / "temporary").iterdir()) == [] and git(repository, "status", "--porcelain") == ""


@needs_git
def test_the_slower_of_two_commits_is_named_and_ends_the_gate(repository: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    asked = ["HEAD~2", "HEAD~1", "--repeats", "5", "speed", "--json", "--gate", "--", "--size", "3"]
    with pytest.raises(SystemExit, match="1"):
        compare.main(asked)
    said = capsys.readouterr()
    result = json.loads(said.out)
    assert (result["a"], result["b"]) == (git(repository, "rev-parse", "HEAD~2"), git(repository, "rev-parse", "HEAD~1"))
    entries = result["benchmarks"]["speed"]
    assert set(entries) == {"work.ms", "fps"} and entries["fps"]["verdict"] == "same"
    slower = entries["work.ms"]
    assert slower["verdict"] == "slower" and slower["least"] <= slower["quartiles"][0] <= slower["ratio"] == pytest.approx(1.5, abs=0.01)
    assert result["figures"] == {"speed": {"faces": {"a": 20.25, "b": 30.25}}}, "both find the page that is built"
    assert (tmp_path / "runs").read_text() == "ab" + "ab" + "ba" + "ab" + "ba" + "ab", "a warm-up of each, then in turns"
    assert "pair 5 of 5: B" in said.err and result["machine"]
    assert is_clean(repository)


@needs_git
def test_the_working_tree_is_run_as_it_is_and_a_table_is_for_people(repository: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    fast = git(repository, "show", "HEAD~2:benchmarks/__main__.py").replace("20.25", "10.25")
    (repository / "benchmarks" / "__main__.py").write_text(fast)
    compare.main(["HEAD~1", ".", "speed", "--repeats", "2", "--out", str(tmp_path / "out"), "--", "--size", "3"])
    said = capsys.readouterr().out
    assert f"B: worktree at {git(repository, 'rev-parse', 'HEAD')}" in said and "| work.ms |" in said and "| faster |" in said
    assert "speed: faces is 30.25 in A, 10.25 in B." in said
    kept = [json.loads(line) for line in (tmp_path / "out" / "runs.jsonl").read_text().splitlines()]
    assert [run["pair"] for run in kept] == [1, 2] and kept[0]["a"]["faces"] == 30.25 and kept[0]["b"]["faces"] == 10.25
    assert not (tmp_path / "out" / "A").exists() and len(git(repository, "worktree", "list").splitlines()) == 1


@needs_git
def test_a_run_that_fails_says_which_and_leaves_nothing(repository: Path):
    broken = git(repository, "rev-parse", "HEAD")
    with pytest.raises(ValueError, match=rf"speed of B \({broken}\) ended with exit code 1; its stderr ends: the third commit is broken"):
        compare.main(["HEAD~1", "HEAD", "speed", "--", "--size", "3"])
    assert is_clean(repository)


@needs_git
def test_ctrl_c_leaves_no_checkout(repository: Path, tmp_path: Path):
    with pytest.raises(KeyboardInterrupt), checked_out(repository, ("HEAD", "HEAD~1"), tmp_path / "sides") as (a, b):
        assert (a.root / "benchmarks").is_dir() and (b.root / "web/node_modules").is_symlink()
        raise KeyboardInterrupt
    assert is_clean(repository) and not a.root.exists() and not b.root.exists() and (repository / "web/node_modules").is_dir()


@needs_git
def test_what_is_there_is_not_overwritten_and_what_is_no_commit_is_refused(
    repository: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    (tmp_path / "B").mkdir()
    (tmp_path / "B" / "mine").write_text("")
    with pytest.raises(ValueError, match="B exists; a checkout is to be made there"), checked_out(repository, ("HEAD", "HEAD"), tmp_path):
        pass
    assert is_clean(repository) and (tmp_path / "B" / "mine").exists()
    with pytest.raises(ValueError, match="'nonsense' names no commit of repository"):
        compare.main(["HEAD", "nonsense"])
    monkeypatch.setenv("GIT_DIR", "of another repository, as in its hooks")
    assert len(commit_hash(repository, "HEAD")) == 40


def test_no_pairs_are_refused_nor_a_gate_of_few():
    with pytest.raises(ValueError, match=r"--repeats and --threshold are 0 and 3\.0"):
        compare.main(["HEAD~1", "HEAD", "--repeats", "0"])
    with pytest.raises(ValueError, match="--repeats is 4; a gate wants at least 5 pairs"):
        compare.main(["HEAD~1", "HEAD", "--repeats", "4", "--gate"])
