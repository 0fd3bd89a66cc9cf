"""The set-up script and the files it installs from keep in step."""

import json
import os
import re
import shutil
import subprocess
import tomllib
from pathlib import Path

import pytest
import yaml

from drgs import __version__
from tests.patience import PATIENCE_SECONDS

ROOT = Path(__file__).parent.parent
posix = pytest.mark.skipif(shutil.which("sh") is None, reason="a POSIX shell is needed")


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([str(ROOT / "run"), *arguments], capture_output=True, text=True, timeout=PATIENCE_SECONDS)


@posix
@pytest.mark.parametrize("script", ["run", ".ci/run"])
def test_scripts_are_executable_and_parse(script: str):
    assert os.access(ROOT / script, os.X_OK)
    assert subprocess.run(["sh", "-n", str(ROOT / script)], capture_output=True).returncode == 0


@posix
def test_help_names_every_command():
    result = run("help")
    assert result.returncode == 0
    assert all(f"./run {name}" in result.stdout for name in ("setup", "demo", "test", "lint", "docs", "bench", "wheel", "blender"))


@posix
def test_an_unknown_command_is_refused_with_those_there_are():
    result = run("nonsense")
    assert result.returncode == 2
    assert "'nonsense'" in result.stderr and "setup, demo, test, lint, docs, bench, wheel or blender" in result.stderr


FAKE_PYTHON = """#!/bin/sh
echo "$*" >>calls
case "$*" in *"$FAILING"*) echo "a fault of $FAILING"; exit 3 ;; esac
"""


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """The script where its Python does nothing but write down what it is called with, and what $FAILING names fails."""
    (tmp_path / ".venv" / "bin").mkdir(parents=True)
    (tmp_path / "tests").mkdir()
    (tmp_path / "tests" / "test_speed.py").write_text("@pytest.mark.alone")
    shutil.copy(ROOT / "run", tmp_path)
    for name in ("pyproject.toml", "constraints.txt"):
        (tmp_path / name).touch()
    python = tmp_path / ".venv" / "bin" / "python"
    python.write_text(FAKE_PYTHON)
    python.chmod(0o755)
    installed = subprocess.run(["cksum"], input=(ROOT / "run").read_bytes(), capture_output=True, check=True).stdout
    (tmp_path / ".venv" / ".installed-dev").write_bytes(installed)
    return tmp_path


def run_tests_in(project: Path, failing: str, *arguments: str) -> tuple[subprocess.CompletedProcess[str], str]:
    """What the script ends with, and what Python was called with."""
    command, environment = [str(project / "run"), "test", *arguments], os.environ | {"FAILING": failing}
    result = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=PATIENCE_SECONDS)
    return result, (project / "calls").read_text()


@posix
@pytest.mark.parametrize("failing", ["nothing", "-m mypy", "--numprocesses"])
def test_a_fault_of_lint_or_of_a_test_is_shown_and_fails_the_run(project: Path, failing: str):
    result, called = run_tests_in(project, failing)
    assert "-m ruff check" in called and "--numprocesses" in called
    assert (result.returncode == 0) == (failing == "nothing"), result.stderr
    assert failing == "nothing" or f"a fault of {failing}" in result.stdout
    assert ("-m pytest -m alone tests/test_speed.py" in called) == (failing == "nothing"), "time is measured when all the rest is well"


@posix
@pytest.mark.parametrize("failing", ["nothing", "--check", "--numprocesses"])
def test_a_fault_of_the_viewer_or_of_a_quick_test_is_shown_and_fails_the_run(project: Path, failing: str):
    result, called = run_tests_in(project, failing, "--fast", "-k", "some")
    assert "web/build.py --check" in called and re.search("--numprocesses .* -k some", called) and "mypy" not in called
    assert (result.returncode == 0) == (failing == "nothing"), result.stderr
    assert failing == "nothing" or f"a fault of {failing}" in result.stdout


def test_every_dependency_has_a_tested_version():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    name_of = lambda requirement: re.match(r"[\w.-]+", requirement)[0].lower().replace("_", "-")  # noqa: E731
    wanted = {
        name_of(requirement) for extra in project["optional-dependencies"].values() for requirement in [*project["dependencies"], *extra]
    }
    wanted.remove("drgs")  # one extra names another
    pinned = {name_of(line) for line in (ROOT / "constraints.txt").read_text().splitlines() if line and not line.startswith("#")}
    assert wanted <= pinned


def test_the_version_is_written_once():
    assert "version" not in tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert "version" not in json.loads((ROOT / "web" / "package.json").read_text())
    newest = re.search(r"^## (\S+) - \d{4}-\d\d-\d\d$", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert newest is not None and newest[1] == __version__


def test_the_cpu_build_of_torch_satisfies_its_constraint():
    # ./run asks for 'torch==VERSION+cpu'; a local version in the file itself would shut CUDA builds out.
    (version,) = re.findall(r"^torch==(.*)$", (ROOT / "constraints.txt").read_text(), re.MULTILINE)
    assert re.fullmatch(r"[\d.]+", version)


def test_hosted_ci_calls_the_same_two_commands():
    workflow = yaml.safe_load((ROOT / ".github" / "workflows" / "ci.yml").read_text())
    called = {step["run"] for job in workflow["jobs"].values() for step in job["steps"] if "run" in step}
    assert called == {"./run lint", "./run test"}
    assert workflow["permissions"] == {"contents": "read"}


def test_hooks_before_a_commit_are_the_projects_own_tools():
    repositories = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text())["repos"]
    assert [repository["repo"] for repository in repositories] == ["local"]
    hooks = repositories[0]["hooks"]
    assert all(hook["entry"].startswith(".venv/bin/python -m ") for hook in hooks)
    checked = {hook["entry"].split()[2] for hook in hooks}
    assert checked == {"ruff", "mypy"}
