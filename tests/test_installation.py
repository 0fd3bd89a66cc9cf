"""Messages that tell a user to install something name a command that works, and systems without packages are told so at once."""

import platform
import shlex
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest

from drgs import installation
from drgs.installation import install_command, missing_package, unsupported_system
from tests.patience import PATIENCE_SECONDS
from tests.reconstruct.tiny_capture import FEW_VIEWS, sphere_views, write_nerf_synthetic

ROOT = Path(__file__).parent.parent
SERVICE_PACKAGES = (
    "alembic", "av", "dbos", "fastapi", "httpx", "obstore", "platformdirs", "prometheus_client", "psutil", "pydantic_settings", "sqlalchemy",
    "starlette", "uvicorn", "websockets",
)  # fmt: skip
"""What only the extra `serve` installs."""


def run_without(packages: tuple[str, ...], program: str, *arguments: str | Path) -> subprocess.CompletedProcess[str]:
    """Run Python as if these packages were not installed."""
    hide = f"import sys; sys.modules.update(dict.fromkeys({packages!r}))\n"
    return subprocess.run(
        [sys.executable, "-c", hide + program, *map(str, arguments)], capture_output=True, text=True, timeout=PATIENCE_SECONDS
    )


def test_from_a_checkout_the_command_installs_the_checkout_again(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    monkeypatch.setattr(sys, "executable", str(ROOT / ".venv" / "bin" / "python"))
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.chdir(ROOT)
    assert install_command("serve") == ".venv/bin/python -m pip install -e '.[serve]'"
    monkeypatch.chdir(tmp_path)
    assert shlex.split(install_command("serve")) == [str(ROOT / ".venv/bin/python"), "-m", "pip", "install", "-e", f"{ROOT}[serve]"]


def test_from_a_package_the_command_names_the_package(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    monkeypatch.setattr(installation, "_FOLDER", tmp_path / "site-packages" / "drgs")
    monkeypatch.setattr(sys, "executable", str(tmp_path / "bin" / "python"))
    (tmp_path / "bin").mkdir()
    (tmp_path / "bin" / "pip").write_text("#!/bin/sh\n")
    (tmp_path / "bin" / "pip").chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path / "bin"))
    assert (
        missing_package("writing USD", "usd-core", "usd")
        == "writing USD needs the package usd-core; install it with: pip install 'drgs[usd]'"
    )
    monkeypatch.setenv("PATH", str(tmp_path))  # another pip, or none, answers to the name
    assert install_command("usd") == f"{tmp_path}/bin/python -m pip install 'drgs[usd]'"
    monkeypatch.setattr(installation, "find_spec", lambda name: None)
    assert install_command("usd") == f"uv pip install --python {tmp_path}/bin/python 'drgs[usd]'"


@pytest.mark.parametrize("command", ["serve", "worker"])
def test_without_the_extra_the_service_says_in_one_sentence_how_to_install_it(command: str):
    result = run_without(SERVICE_PACKAGES, "from drgs.cli import main; main()", command)
    assert result.returncode == 1 and result.stdout == ""
    assert len(result.stderr.splitlines()) == 1
    assert result.stderr.startswith(f"drgs: drgs {command} needs the package ")
    assert "install it with: " in result.stderr and "[serve]'" in result.stderr


def test_without_the_extra_the_client_says_how_to_install_it():
    result = run_without(SERVICE_PACKAGES, "from drgs import Client")
    assert "ImportError: drgs.Client needs the package httpx; install it with: " in result.stderr and "[client]'" in result.stderr


@pytest.mark.slow
def test_the_whole_library_is_imported_and_a_capture_examined_without_the_services_packages(tmp_path: Path):
    program = """
import pkgutil, importlib, drgs
for module in pkgutil.walk_packages(drgs.__path__, "drgs."):
    if module.name != "drgs.exchange.fbx_process":  # a script that runs in a process of its own, with the extra fbx
        importlib.import_module(module.name)
for name in drgs.__all__:
    if name != "Client":
        getattr(drgs, name)
print("imported")
from drgs.cli import main
main()
"""
    capture = write_nerf_synthetic(tmp_path, sphere_views(FEW_VIEWS, square=True))
    result = run_without(SERVICE_PACKAGES, program, "doctor", capture)
    assert result.returncode == 0, result.stderr
    assert result.stdout.startswith("imported\n") and f"{FEW_VIEWS} views" in result.stdout


def test_this_system_is_supported():
    assert unsupported_system() is None
    assert subprocess.run([sys.executable, str(ROOT / "drgs" / "installation.py")], capture_output=True).returncode == 0


@pytest.mark.parametrize(
    ("system", "machine", "triplet", "platform_name", "words"),
    [
        ("linux", "x86_64", "x86_64-pc-linux-musl", "linux-x86_64", "C library musl"),
        ("linux", "aarch64", "aarch64-unknown-linux-gnu", "linux-aarch64", "this machine is aarch64"),
        ("darwin", "x86_64", "x86_64-apple-darwin", "macosx-10.15-x86_64", "Apple silicon"),
        ("win32", "arm64", None, "win-arm64", "Python for ARM"),
    ],
)
def test_a_system_without_packages_is_named(
    monkeypatch: pytest.MonkeyPatch, system: str, machine: str, triplet: str | None, platform_name: str, words: str
):
    monkeypatch.setattr(sys, "platform", system)
    monkeypatch.setattr(platform, "machine", lambda: machine)
    monkeypatch.setattr(sysconfig, "get_config_var", lambda name: triplet)
    monkeypatch.setattr(sysconfig, "get_platform", lambda: platform_name)
    sentence = unsupported_system()
    assert sentence is not None and words in sentence


def test_a_32_bit_python_is_named(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(sys, "maxsize", 2**31 - 1)
    assert "64-bit Python" in (unsupported_system() or "")


def test_a_command_on_such_a_system_ends_with_the_sentence_instead_of_a_stack():
    program = "import platform; platform.machine = lambda: 'riscv64'\nfrom drgs.cli import main; main()"
    result = run_without(("embreex",), program, "doctor", "capture")
    assert result.returncode == 1
    assert result.stderr.startswith("drgs cannot run here: ") and len(result.stderr.splitlines()) == 1
