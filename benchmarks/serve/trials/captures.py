"""Folders of photographs that are not what they say, as `drgs doctor` sees them: a document of JSON, and never a stack."""

import json
import math
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np
from PIL import Image

from benchmarks.serve.trials.site import Site, Trial

VIEWS, SIDE = 6, 32
Change = Callable[[Path, dict], None]


def write_capture(folder: Path) -> dict:
    """A grey ball before nothing, with alpha; returns the document of its cameras."""
    (folder / "train").mkdir(parents=True)
    y, x = np.mgrid[:SIDE, :SIDE] - (SIDE - 1) / 2
    inside = np.hypot(x, y) < 10
    pixels = np.where(inside[..., None], np.array([120, 120, 120, 255], np.uint8), np.uint8(0))
    frames = []
    for k in range(VIEWS):
        angle = 2 * math.pi * k / VIEWS
        c, s = math.cos(angle), math.sin(angle)
        matrix = [[-s, 0, c, 3 * c], [c, 0, s, 3 * s], [0, 1, 0, 0], [0, 0, 0, 1]]
        Image.fromarray(pixels).save(folder / "train" / f"r_{k:03d}.png")
        frames.append({"file_path": f"./train/r_{k:03d}", "transform_matrix": matrix})
    return {"camera_angle_x": 0.7, "frames": frames}


def _set(**values: object) -> Change:
    return lambda _folder, document: document.update(values)


def _frame(**values: object) -> Change:
    return lambda _folder, document: document["frames"][1].update(values)


def _masks(folder: Path, _document: dict) -> None:
    """One beside each picture, which loses its alpha."""
    (folder / "masks").mkdir()
    for path in (folder / "train").glob("*.png"):
        picture = Image.open(path)
        picture.getchannel("A").save(folder / "masks" / path.name)
        picture.convert("RGB").save(path)


def _deep(folder: Path, document: dict) -> None:
    document.clear()
    (folder / "transforms_train.json").write_text("[" * 100_000 + "]" * 100_000)


WRONG: dict[str, tuple[Change, bool]] = {
    "w: Infinity": (_set(w=math.inf, h=SIDE), True),
    "w of 400 digits": (_set(w=10**400, h=SIDE), False),
    "JSON of 100 000 brackets": (_deep, False),
    "a path of 5000 characters": (_frame(file_path="x" * 5000), False),
    "w: NaN": (_set(w=math.nan, h=SIDE), False),
    "an angle of 400 digits": (_set(camera_angle_x=10**400), False),
    "a focal length of 1e308": (_set(fl_x=1e308), False),
    "a pose of 1e300": (_frame(transform_matrix=[[1e300] * 4] * 4), False),
    "a pose of words": (_frame(transform_matrix=[["a"] * 4] * 4), False),
    "a mirrored pose": (_frame(transform_matrix=[[-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 3], [0, 0, 0, 1]]), False),
    "a name of 300 characters": (_frame(file_path="x" * 300), False),
    "a name with NUL": (_frame(file_path="a\0b"), False),
    "half a character": (_frame(file_path="\ud800"), False),
    "a path elsewhere": (_frame(file_path="/etc/passwd"), False),
    "no frames": (_set(frames=[]), False),
    "frames of null": (_set(frames=[None] * 5), False),
}


def trials() -> Iterator[Trial]:
    for title, (change, quick) in WRONG.items():
        yield Trial("captures", title, partial(_wrong, title, change), quick)
    yield Trial("captures", "masks beside train are used", _masks_are_used, quick=False)
    yield Trial("captures", "a folder of 5000 characters", _long_folder, quick=False)


def _doctor(folder: str) -> tuple[str | None, dict]:
    """What is wrong with its answer, and the report."""
    done = subprocess.run([sys.executable, "-m", "drgs", "doctor", folder, "--json"], capture_output=True, text=True, timeout=300)
    if "Traceback" in done.stderr:
        return f"a stack: {done.stderr.strip().splitlines()[-1][:200]}", {}
    try:
        report = json.loads(done.stdout)
    except ValueError:
        return f"no JSON, but {done.stdout[:100]!r} and {done.stderr[:200]!r}", {}
    return None if done.returncode in (0, 1) else f"exit code {done.returncode}", report


def _wrong(title: str, change: Change, site: Site) -> str | None:
    folder = site.folder / "captures" / "".join(c if c.isalnum() else "-" for c in title)
    document = write_capture(folder)
    change(folder, document)
    if document:
        (folder / "transforms_train.json").write_text(json.dumps(document))
    complaint, report = _doctor(str(folder))
    shutil.rmtree(folder)
    return complaint or (f"it says that all is well: {report.get('summary')}" if report["ok"] else None)


def _masks_are_used(site: Site) -> str | None:
    folder = site.folder / "captures" / "masks"
    document = write_capture(folder)
    _masks(folder, document)
    (folder / "transforms_train.json").write_text(json.dumps(document))
    complaint, report = _doctor(str(folder))
    shutil.rmtree(folder)
    if complaint:
        return complaint
    return None if report["ok"] and report["masks"]["present"] else f"the report says {report.get('findings')}"


def _long_folder(site: Site) -> str | None:
    complaint, report = _doctor("/" + "x" * 5000)
    return complaint or ("it says that all is well" if report["ok"] else None)
