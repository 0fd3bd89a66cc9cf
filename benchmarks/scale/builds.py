"""Whole builds against their photographs: how many there are, and how large they are.

In: a scene in NeRF-synthetic's layout. Each point builds a copy of it in a process of its own, as a user does, and forgets the asset.
"""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
from PIL import Image

from benchmarks.builds.build_process import cli_command, run_build
from benchmarks.scale.cost_curve import CostCurve, Point
from benchmarks.scale.scale_run import ScaleRun
from benchmarks.scenes.bench_scene import read_rgba
from benchmarks.scenes.retake_photographs import bytes_of, premultiplied, shrunk

TRANSFORMS = "transforms_train.json"
USUAL_PRESET = "draft"
COSTS = {"seconds": "seconds", "memory_mib": "peak memory [MiB]"}


def builds(run: ScaleRun) -> CostCurve:
    """Against the number of photographs, taken evenly out of the scene's."""
    points = _points(run, run.sizes.builds, lambda count, out: write_views(_scene_of(run), out, count), lambda count: count)
    return CostCurve("builds", "photographs", points, COSTS)


def builds_pixels(run: ScaleRun) -> CostCurve:
    """Against the pixels of a photograph; all photographs of the scene, shrunk."""
    points = _points(run, run.sizes.builds_pixels, lambda side, out: write_shrunk(_scene_of(run), out, side), lambda side: side * side)
    return CostCurve("builds_pixels", "pixels of a photograph", points, COSTS)


def write_views(scene: Path, out: Path, count: int) -> None:
    """A capture of `count` photographs, as far apart in the scene's order as can be.

    Raises:
        ValueError: the scene has fewer.
    """
    document = _read_transforms(scene)
    frames = document["frames"]
    if not 1 <= count <= len(frames):
        raise ValueError(f"{scene}: has {len(frames)} photographs; expected at least {count}")
    chosen = [frames[index * len(frames) // count] for index in range(count)]
    for frame in chosen:
        target = out / f"{frame['file_path']}.png"
        target.parent.mkdir(parents=True, exist_ok=True)
        target.symlink_to((scene / f"{frame['file_path']}.png").resolve())
    (out / TRANSFORMS).write_text(json.dumps(document | {"frames": chosen}))


def write_shrunk(scene: Path, out: Path, side: int) -> None:
    """A capture of the scene's photographs at `side` pixels along the longer edge.

    Raises:
        ValueError: they are smaller, or their cameras are not given by one camera_angle_x, which holds at any size.
    """
    document = _read_transforms(scene)
    if "camera_angle_x" not in document or "fl_x" in document:
        raise ValueError(f"{scene}: {TRANSFORMS} has no camera_angle_x alone; expected a scene of the benchmark")
    for frame in document["frames"]:
        rgba = read_rgba(scene / f"{frame['file_path']}.png")
        longest = max(rgba.shape[:2])
        if longest < side:
            raise ValueError(f"{scene}: has a photograph of {longest} pixels; expected at least {side}")
        target = out / f"{frame['file_path']}.png"
        target.parent.mkdir(parents=True, exist_ok=True)
        light = shrunk(premultiplied(rgba.astype(np.float64)), side / longest)
        Image.fromarray(bytes_of(light)).save(target)
    kept = {key: value for key, value in document.items() if key not in ("w", "h")}
    (out / TRANSFORMS).write_text(json.dumps(kept))


def _points(run: ScaleRun, sizes: tuple[int, ...], write: Callable[[int, Path], None], x: Callable[[int], int]) -> list[Point]:
    """Each of one build: they are long, so repetitions are not for them."""
    points: list[Point] = []
    for size in sizes:
        folder = run.folder / "build"
        folder.mkdir()
        write(size, folder / "capture")
        command = cli_command(folder / "capture", folder / "asset", run.preset or USUAL_PRESET, device=run.device.type, resume=False)
        took = run_build(command)
        shutil.rmtree(folder)
        points.append({"x": x(size), "seconds": took.seconds, "cpu_seconds": took.cpu_seconds, "memory_mib": took.peak_memory_mib})
    return points


def _scene_of(run: ScaleRun) -> Path:
    assert run.scene is not None, "command.py refuses builds without one"
    return run.scene


def _read_transforms(scene: Path) -> dict:
    """Raises:
    ValueError: there are none.
    """
    path = scene / TRANSFORMS
    if not path.is_file():
        raise ValueError(f"{scene}: has no {TRANSFORMS}; expected a scene in NeRF-synthetic's layout")
    document: dict = json.loads(path.read_text())
    return document
