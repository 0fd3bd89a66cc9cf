"""The wheel, built and installed into an environment that does not know the repository, is all that a user needs: no Node, no checkout.

The environment borrows the third-party packages of the one that runs the tests, but not its drgs: the line in its .pth names their folder, and
the .pth files in that folder, which an editable install of drgs is, are not read.
"""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import sysconfig
import time
import urllib.request
import venv
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from drgs import __version__
from tests.patience import PATIENCE_SECONDS

ROOT = Path(__file__).parent.parent
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(sys.platform == "win32", reason="the service runs on Linux and macOS"),
    pytest.mark.skipif(shutil.which("git") is None, reason="git lists what belongs into the wheel"),
]


@dataclass(frozen=True)
class Installed:
    """drgs as a user has it."""

    wheel: Path
    bin: Path
    folder: Path
    """Where the user works: it holds modules of theirs with names of ours and of Python's."""

    def environment(self) -> dict[str, str]:
        """What their shell has: no word of the repository."""
        kept = {name: value for name, value in os.environ.items() if name != "PYTHONPATH" and not name.startswith("DRGS_")}
        return {
            **kept,
            "PATH": f"{self.bin}{os.pathsep}{kept['PATH']}",
            "XDG_DATA_HOME": str(self.folder / "home"),
            "HOME": str(self.folder / "home"),
        }

    def run(self, *command: str) -> subprocess.CompletedProcess[str]:
        program = str(self.bin / command[0])
        return subprocess.run(
            [program, *command[1:]], cwd=self.folder, env=self.environment(), capture_output=True, text=True, timeout=PATIENCE_SECONDS
        )


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Installed:
    root = tmp_path_factory.mktemp("wheel")
    built = subprocess.run(
        [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(root / "dist")], cwd=ROOT, capture_output=True, text=True
    )
    assert built.returncode == 0, built.stdout + built.stderr
    (wheel,) = (root / "dist").glob("*.whl")
    venv.create(root / "venv", symlinks=True)
    python = root / "venv" / "bin" / "python"
    packages = Path(sysconfig.get_path("purelib", vars={"base": str(root / "venv"), "platbase": str(root / "venv")}))
    borrowed = dict.fromkeys((sysconfig.get_path("purelib"), sysconfig.get_path("platlib")))
    (packages / "borrowed.pth").write_text("\n".join(borrowed) + "\n")
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--python", str(python)]
    # --ignore-installed: pip sees the tests' own drgs beside the borrowed packages, and must let it be.
    done = subprocess.run(
        [*pip, "install", "-q", "--no-deps", "--no-index", "--no-compile", "--ignore-installed", str(wheel)], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    folder = root / "work"
    folder.mkdir()
    for name in ("server", "worker", "queue"):
        (folder / f"{name}.py").write_text(f"raise SystemExit('the {name}.py of the user was imported')\n")
    return Installed(wheel, python.parent, folder)


@pytest.mark.slow
def test_the_wheel_holds_every_file_of_the_packages_the_viewer_and_what_is_bundled(installed: Installed):
    with zipfile.ZipFile(installed.wheel) as archive:
        held = set(archive.namelist())
    assert {name.split("/")[0] for name in held} == {"drgs", "drgs_server", "drgs_worker", f"drgs-{__version__}.dist-info"}
    listed = subprocess.run(["git", "ls-files", "drgs", "server", "worker"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    ours = [name for name in listed.splitlines() if (ROOT / name).is_file()]
    assert {name.removeprefix("server/").removeprefix("worker/") for name in ours} <= held
    assert {"drgs_server/static/index.html", "drgs/convert/page/page.html"} <= held
    environments = {f"drgs_worker/bundled/environments/{path.name}" for path in (ROOT / "examples" / "environments").glob("*.exr")}
    assert {name for name in held if name.startswith("drgs_worker/bundled/environments/")} == environments
    capture = ROOT / "examples" / "sample_capture"
    files = {path.relative_to(capture).as_posix() for path in capture.rglob("*") if path.is_file() and path.suffix not in (".py", ".pyc")}
    assert {name.removeprefix("drgs_worker/bundled/sample_capture/") for name in held if "/sample_capture/" in name} == files


def test_the_service_finds_the_sample_capture_in_the_package(installed: Installed):
    program = "from drgs_worker.store.settings import ServiceSettings; print(ServiceSettings().sample_capture)"
    found = installed.run("python", "-P", "-c", program)
    assert found.returncode == 0, found.stderr
    assert (
        Path(found.stdout.strip()).is_relative_to(installed.bin.parent) and (Path(found.stdout.strip()) / "transforms_train.json").is_file()
    )


def test_the_commands_answer_outside_the_repository(installed: Installed):
    where = installed.run(
        "python", "-P", "-c", "import drgs, drgs_server, drgs_worker; print(drgs.__file__, drgs_server.__file__, drgs_worker.__file__)"
    )
    assert where.returncode == 0, where.stderr
    assert all(Path(name).is_relative_to(installed.bin.parent) for name in where.stdout.split())
    told = installed.run("drgs", "--version")
    assert (told.returncode, told.stdout) == (0, f"drgs {__version__}\n")
    help_ = installed.run("drgs", "--help")
    assert help_.returncode == 0 and "  serve " in help_.stdout


def test_a_users_own_server_py_is_no_matter_to_the_client(installed: Installed):
    # With -c the present folder is the first that Python looks in.
    (installed.folder / "queue.py").rename(installed.folder / "queue.txt")  # Python's own: no program survives that
    try:
        result = installed.run("python", "-c", "from drgs import Client; print(Client.__module__)")
    finally:
        (installed.folder / "queue.txt").rename(installed.folder / "queue.py")
    assert (result.returncode, result.stdout) == (0, "drgs_server.client\n"), result.stderr


def test_a_message_names_a_command_for_the_package(installed: Installed):
    hide = "import sys; sys.modules['uvicorn'] = None; from drgs.cli import main; main()"
    result = installed.run("python", "-P", "-c", hide, "serve")
    assert result.returncode == 1
    assert re.fullmatch(r"drgs: drgs serve needs the package uvicorn; install it with: .*pip install 'drgs\[serve\]'\n", result.stderr)


@pytest.fixture(scope="module")
def address(installed: Installed) -> Iterator[str]:
    """Of `drgs serve --open` with all its defaults but the port; the browser writes down what it was told to open."""
    browser = installed.folder / "browser"
    browser.write_text(f'#!/bin/sh\nprintf "%s" "$1" > "{installed.folder}/opened"\n')
    browser.chmod(0o755)
    environment = {**installed.environment(), "BROWSER": f"{browser} %s"}
    command = [str(installed.bin / "drgs"), "serve", "--open", "--port", "0"]
    log = installed.folder / "serve.log"
    with log.open("w") as output:
        process = subprocess.Popen(command, cwd=installed.folder, env=environment, stdout=output, stderr=subprocess.STDOUT)
    try:
        deadline = time.monotonic() + PATIENCE_SECONDS
        while not (found := re.search(r"http://\S+#token=\w+", log.read_text())):
            assert process.poll() is None and time.monotonic() < deadline, log.read_text()
            time.sleep(0.05)
        yield found[0]
    finally:
        process.send_signal(signal.SIGTERM)
        process.wait(PATIENCE_SECONDS)


def ask(address: str, path: str) -> bytes:
    origin, token = address.split("/#token=")
    request = urllib.request.Request(origin + path, headers={"Authorization": f"Bearer {token}"})
    with urllib.request.urlopen(request, timeout=PATIENCE_SECONDS) as answer:
        return answer.read()


def test_serve_shows_the_page_and_opens_it(installed: Installed, address: str):
    page = ask(address, "/").decode()
    scripts = re.findall(r'src="\.?(/assets/[^"]+\.js)"', page)
    assert "<title>" in page and scripts
    assert len(ask(address, scripts[0])) > 10_000
    deadline = time.monotonic() + PATIENCE_SECONDS
    while not (installed.folder / "opened").exists() and time.monotonic() < deadline:
        time.sleep(0.05)
    assert (installed.folder / "opened").read_text() == address


@pytest.mark.slow
def test_serve_brings_environments_and_a_worker_and_keeps_its_data_with_the_user(installed: Installed, address: str):
    names = {found["name"] for found in json.loads(ask(address, "/api/environments"))["environments"]}
    assert {path.name for path in (ROOT / "examples" / "environments").glob("*.exr")} <= names
    deadline = time.monotonic() + PATIENCE_SECONDS
    while json.loads(ask(address, "/api/jobs"))["workers_alive"] == 0:
        assert time.monotonic() < deadline, (installed.folder / "serve.log").read_text()
        time.sleep(0.2)
    assert not (installed.folder / "data").exists()
    assert sys.platform != "linux" or (installed.folder / "home" / "drgs" / "token").is_file()
