"""What drgs can be installed on, and how the optional parts of an installation are added.

Every message that tells a user to install something takes its command from here, so that it fits how drgs itself came: as a checkout or as a package.
Knows only the standard library: `python drgs/installation.py` is asked before anything is installed, and ends with a sentence and exit code 1 where
nothing can be.
"""

import os
import platform
import shlex
import shutil
import sys
import sysconfig
from importlib.util import find_spec
from pathlib import Path

_FOLDER = Path(__file__).resolve().parent


def checkout() -> Path | None:
    """The repository that this code runs from; None where it was installed as a package."""
    root = _FOLDER.parent
    return root if (root / "pyproject.toml").is_file() and (root / "web").is_dir() else None


def install_command(extra: str) -> str:
    """The shell command that adds an extra of pyproject.toml to the Python that runs this."""
    root = checkout()
    if root is None:
        return f"{_pip_install()} {_quoted(f'drgs[{extra}]')}"
    return f"{_pip_install()} -e {_quoted(f'{_short(root)}[{extra}]')}"


def missing_package(what: str, package: str, extra: str) -> str:
    """The sentence for something that needs an extra.

    Args:
        what: that cannot be done; begins the sentence.
        package: of the extra, that was looked for.
    """
    return f"{what} needs the package {package}; install it with: {install_command(extra)}"


def unsupported_system() -> str | None:
    """Why the packages that drgs needs cannot be installed here, as one sentence; None where they can.

    The facts are which systems the packages have wheels for (looked up in November 2026: torch 2.13, warp-lang 1.19, embreex 4.4, xatlas 0.0.11). Any
    x86-64 processor since 2009 will do: numpy asks for SSE 4.2, Embree for SSE 2, and none for AVX.
    """
    system, machine = sys.platform, platform.machine().lower()
    if sys.maxsize <= 2**32:
        return "this Python is a 32-bit one, and PyTorch, Warp and Embree have 64-bit packages only; install a 64-bit Python"
    if system == "linux" and "musl" in (sysconfig.get_config_var("HOST_GNU_TYPE") or ""):
        return "this Linux has the C library musl, and PyTorch, Warp and Embree have packages for glibc only; use Debian, Ubuntu or Fedora, or an image of these"
    if system == "linux" and machine not in ("x86_64", "amd64"):
        return f"Embree (embreex) and xatlas have Linux packages for x86-64 only, and this machine is {machine}; use one with an x86-64 processor"
    if system == "darwin" and machine == "x86_64":
        return "PyTorch and Warp have Mac packages for Apple silicon only, and this is a Python for Intel; on Apple silicon, install an arm64 Python"
    if sysconfig.get_platform() == "win-arm64":
        return "PyTorch, Embree and libigl have Windows packages for x86-64 only, and this is a Python for ARM; install the x86-64 Python"
    return None


def _pip_install() -> str:
    """How this Python's pip is told to install."""
    python = Path(sys.executable)
    if find_spec("pip") is None:  # as in the environments that uv makes
        return f"uv pip install --python {_quoted(_short(python))}"
    found = shutil.which("pip")
    if found and Path(found).parent == python.parent:
        return "pip install"
    return f"{_quoted(_short(python))} -m pip install"


def _short(path: Path) -> str:
    """Relative to the folder we are in, where the path lies below it."""
    here = Path.cwd()
    return str(path.relative_to(here)) if path.is_relative_to(here) else str(path)


def _quoted(text: str) -> str:
    return f'"{text}"' if os.name == "nt" else shlex.quote(text)


if __name__ == "__main__":
    if sentence := unsupported_system():
        sys.exit(f"drgs cannot be installed here: {sentence}")
