"""The set-up script and the files it installs from keep in step."""

import os
import re
import shutil
import subprocess
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
posix = pytest.mark.skipif(shutil.which("sh") is None, reason="a POSIX shell is needed")


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([str(ROOT / "run"), *arguments], capture_output=True, text=True, timeout=60)


@posix
@pytest.mark.parametrize("script", ["run", ".ci/run"])
def test_scripts_are_executable_and_parse(script: str):
    assert os.access(ROOT / script, os.X_OK)
    assert subprocess.run(["sh", "-n", str(ROOT / script)], capture_output=True).returncode == 0


@posix
def test_help_names_every_command():
    result = run("help")
    assert result.returncode == 0
    assert all(f"./run {name}" in result.stdout for name in ("setup", "demo", "test", "lint", "bench"))


@posix
def test_an_unknown_command_is_refused_with_those_there_are():
    result = run("nonsense")
    assert result.returncode == 2
    assert "'nonsense'" in result.stderr and "setup, demo, test, lint or bench" in result.stderr


def test_every_dependency_has_a_tested_version():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    name_of = lambda requirement: re.match(r"[\w.-]+", requirement)[0].lower().replace("_", "-")  # noqa: E731
    wanted = {
        name_of(requirement) for extra in project["optional-dependencies"].values() for requirement in [*project["dependencies"], *extra]
    }
    pinned = {name_of(line) for line in (ROOT / "constraints.txt").read_text().splitlines() if line and not line.startswith("#")}
    assert wanted <= pinned


def test_the_cpu_build_of_torch_satisfies_its_constraint():
    # ./run asks for 'torch==VERSION+cpu'; a local version in the file itself would shut CUDA builds out.
    (version,) = re.findall(r"^torch==(.*)$", (ROOT / "constraints.txt").read_text(), re.MULTILINE)
    assert re.fullmatch(r"[\d.]+", version)
