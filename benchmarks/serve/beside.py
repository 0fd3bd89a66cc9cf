"""A build beside other work on the same cores: beside another build, and beside a viewer whose camera never rests.

    python -m benchmarks beside DATASET ASSET [--preset draft] [--size 400] [--seconds 20] [--script] [--json]

The same build is run five times: alone; twice at once; as the service's worker runs it (giving way to others by some steps of priority), while a
viewer of ASSET moves its camera with each picture that comes; and alone once more, for a shared machine's speed differs by a half from one minute to the next. A
viewer that has the machine to itself is measured for `--seconds` before and after its build. What is alone is the mean of both.
beside_build_ratio, beside_viewer_ratio: seconds over those alone, of the two builds the longer one's; ..._cpu_ratio: the same of processor time, which says
what threads that wait for each other burn. viewer_kept: pictures a second that the viewer gets while the build runs, over those without it.
With --script a build is not a command but a script's call of drgs.build_asset, which imports torch before drgs and chooses nothing of how threads wait.
"""

import argparse
import json
import statistics
import tempfile
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from benchmarks.builds.build_process import BuildRun, cli_command, run_build
from benchmarks.render.frame import WARM_UP, orbit, served
from drgs.scene.asset import load_asset
from drgs.scene.camera import opengl_from_camera
from drgs_server.client import Stream
from drgs_server.live.frame_header import CAMERA_NUMBER_SHIFT, FrameHeader
from drgs_worker.run import MODESTY

GIVING_WAY = f"import os, sys; os.nice({MODESTY}); sys.argv[0] = 'drgs'; from drgs.cli import main; main()"
"""`drgs` with the priority of the service's worker; its arguments follow."""
SCRIPT = """
import json, os, sys
for name in ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT", "OPENBLAS_THREAD_TIMEOUT"):
    os.environ.pop(name, None)
import torch
import drgs
from pathlib import Path
dataset, out, preset, device, modesty = sys.argv[1:]
os.nice(int(modesty))
asset = drgs.build_asset(Path(dataset), Path(out), drgs.BuildSettings(preset=preset, device=device))
print(json.dumps({"stage": "done", "provenance": asset.provenance}))
"""
FIELD_OF_VIEW_DEGREES = 31.5
"""Of the viewer's camera."""


def main(arguments: list[str]) -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks beside", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("dataset", type=Path)
    parser.add_argument("asset", type=Path, help="what the viewer looks at")
    parser.add_argument("--preset", default="draft", choices=["draft", "fast", "full"])
    parser.add_argument("--size", type=int, default=400, help="of the viewer's picture [pixels]")
    parser.add_argument("--seconds", type=float, default=20.0, help="how long a viewer alone is measured")
    parser.add_argument("--device", default="auto", choices=["auto", "cpu", "cuda"])
    parser.add_argument("--script", action="store_true", help="builds by a script that imports torch before drgs, not by the command")
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory(prefix="drgs-beside-") as folder:
        result = measure(given.dataset, given.asset, given.preset, given.device, given.size, given.seconds, Path(folder), given.script)
    print(json.dumps(result, indent=None if given.json else 1))


def measure(dataset: Path, asset: Path, preset: str, device: str, size: int, seconds: float, folder: Path, by_script: bool = False) -> dict:
    """All builds and viewers.

    Raises:
        ValueError: a build failed; its own words are on stderr.
    """

    def build(name: str, giving_way: bool = False) -> BuildRun:
        if by_script:
            return run_build(["-c", SCRIPT, str(dataset), str(folder / name), preset, device, str(MODESTY if giving_way else 0)])
        command = cli_command(dataset, folder / name, preset, device=device, resume=False)
        # The first two words are what Python is to run.
        return run_build(["-c", GIVING_WAY, *command[2:]] if giving_way else command)

    alone = [build("alone")]
    with ThreadPoolExecutor(2) as pool:
        both = list(pool.map(build, ("one", "other")))
    with served(asset, size, device) as (_, _, stream):
        turn = camera_path(asset, size)
        pictures_a_second(stream, turn, size, lambda: True, WARM_UP)
        fps_alone = [_pictures_for(seconds, stream, turn, size)]
        over, found = threading.Event(), []

        def run() -> None:
            try:
                found.append(build("watched", giving_way=True))
            finally:
                over.set()

        builder = threading.Thread(target=run)
        builder.start()
        fps_beside = pictures_a_second(stream, turn, size, lambda: not over.is_set())
        builder.join()
        fps_alone.append(_pictures_for(seconds, stream, turn, size))
    if not found:
        raise ValueError("the build beside the viewer failed; its own words are above")
    alone.append(build("alone_again"))
    return figures(alone, both, found[0], fps_alone, fps_beside) | {
        "dataset": dataset.name,
        "asset": asset.name,
        "preset": preset,
        "by_script": by_script,
        "size": size,
    }


def figures(alone: list[BuildRun], both: list[BuildRun], watched: BuildRun, fps_alone: list[float], fps_beside: float) -> dict:
    """What the document holds."""
    seconds, cpu_seconds = (statistics.mean(values) for values in zip(*((run.seconds, run.cpu_seconds) for run in alone), strict=True))
    fps = statistics.mean(fps_alone)
    return {
        "alone_s": round(seconds, 2),
        "alone_cpu_s": round(cpu_seconds, 2),
        "alone_each_s": [run.seconds for run in alone],
        "beside_build_s": [run.seconds for run in both],
        "beside_build_ratio": round(max(run.seconds for run in both) / seconds, 2),
        "beside_build_cpu_ratio": round(statistics.mean(run.cpu_seconds for run in both) / cpu_seconds, 2),
        "beside_viewer_s": watched.seconds,
        "beside_viewer_ratio": round(watched.seconds / seconds, 2),
        "beside_viewer_cpu_ratio": round(watched.cpu_seconds / cpu_seconds, 2),
        "viewer_fps_alone": round(fps, 2),
        "viewer_fps_alone_each": [round(each, 2) for each in fps_alone],
        "viewer_fps_beside": round(fps_beside, 2),
        "viewer_kept": round(fps_beside / fps, 3),
    }


def _pictures_for(seconds: float, stream: Stream, turn: Callable[[], list[list[float]]], size: int) -> float:
    """A second, for so many seconds."""
    until = time.perf_counter() + seconds
    return pictures_a_second(stream, turn, size, lambda: time.perf_counter() < until)


def camera_path(asset: Path, size: int) -> Callable[[], list[list[float]]]:
    """Gives the next camera of a path around the asset, a degree further, as messages hold it."""
    cameras = orbit(load_asset(asset), size)
    return lambda: opengl_from_camera(next(cameras)).tolist()


def pictures_a_second(
    stream: Stream, turn: Callable[[], list[list[float]]], size: int, go_on: Callable[[], bool], most: int | None = None
) -> float:
    """Of a viewer that asks for the next camera as soon as the last one's picture has come, while it is to go on."""
    started, pictures, shown = time.perf_counter(), 0, None
    while go_on() and (most is None or pictures < most):
        stream.look(size, size, turn(), FIELD_OF_VIEW_DEGREES)
        while (seen := _camera_of(stream.receive(120))) in (None, shown):
            pass
        shown, pictures = seen, pictures + 1
    return pictures / (time.perf_counter() - started)


def _camera_of(frame: tuple[FrameHeader, bytes] | None) -> int | None:
    """The low bits of the number of the camera that a frame shows; None of a message."""
    return None if frame is None else frame[0].flags >> CAMERA_NUMBER_SHIFT & 255
