"""What a user waits for at first: a server that starts, an asset that opens, kernels that are compiled, commands.

    python -m benchmarks cold [--asset ASSET] [--repeats 3] [--no-fresh] [--json]

serve_ready_s: from starting `drgs serve` (no worker, a free port, a new data folder) until it answers /healthz. upload_s: of the asset into
that server. open_to_traced_s: there, from opening a session of it to the first traced picture at 400x400, while kernels are compiled and kept,
but this process has not loaded the asset, and began to load the renderer with the upload; first_picture_s: the three together. next_open_to_traced_s: of the same file
uploaded once more, as another asset, so that only the asset is loaded anew. fresh_serve_ready_s, fresh_upload_s, fresh_open_to_traced_s,
fresh_first_picture_s: the same on a fresh installation, whose folder of compiled kernels is empty; fresh_modules: how many of Warp's
modules are compiled until then. The server does not tell how long it compiles: what fresh_first_picture_s is more than first_picture_s.
render_first_s: `drgs render` of one camera at 400x400 with 4 rays a pixel. drgs_help_s, import_client_s: `drgs --help`, `from drgs import
Client`, beside python_s, an interpreter that does nothing.

Each is a process of its own, one after the other, in each of the repeats; the first of all, which fills the folder of kernels, is not
measured. Medians, and under `values` all that was measured, in its order.
"""

import argparse
import json
import math
import os
import re
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import httpx

from drgs_server.client import Client
from drgs_server.live.messages import StartView

SIZE = 400
RAYS = 4
WAIT_SECONDS = 600.0
"""For a picture, behind which kernels may be compiled."""
STOP_SECONDS = 30.0
"""After which a server that was asked to end is killed."""
DRGS = ("-c", "from drgs.cli import main; main()")


def main(arguments: list[str]) -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks cold", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--asset", type=Path, help="folder or zip of an asset; a ball of 1280 faces without it")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--no-fresh", action="store_true", help="leave out the fresh installation, which compiles all kernels each time")
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args(arguments)
    if given.repeats < 1:
        raise ValueError(f"--repeats is {given.repeats}; expected at least 1")
    with tempfile.TemporaryDirectory(prefix="drgs-cold-") as folder:
        asset = given.asset or _ball(Path(folder))
        print(json.dumps(measure(asset, Path(folder), given.repeats, not given.no_fresh), indent=None if given.json else 1))


def measure(asset: Path, folder: Path, repeats: int, fresh: bool) -> dict:
    """All figures, by their names.

    Args:
        folder: for what is written meanwhile.
    """
    view = first_opening(asset, folder).view  # compiles what the machine has not yet
    write_camera(folder / "transforms.json", view)
    render_seconds(asset, folder)
    values: dict[str, list[float]] = {}
    modules = 0
    for _ in range(repeats):
        opening = first_opening(asset, folder)
        found = opening.seconds()
        if fresh:
            with tempfile.TemporaryDirectory(dir=folder) as kernels:
                found |= {f"fresh_{name}": value for name, value in first_opening(asset, folder, Path(kernels)).seconds().items()}
                modules = len(compiled_modules(Path(kernels)))
        found["render_first_s"] = render_seconds(asset, folder)
        found["drgs_help_s"] = seconds_of([*DRGS, "--help"])
        found["import_client_s"] = seconds_of(["-c", "from drgs import Client"])
        found["python_s"] = seconds_of(["-c", ""])
        for name, value in found.items():
            values.setdefault(name, []).append(value)
    result: dict = {name: round(statistics.median(each), 3) for name, each in values.items()}
    result |= {"fresh_modules": modules} if fresh else {}
    return result | {
        "first_picture_size": [opening.width, opening.height],
        "repeats": repeats,
        "cores": os.cpu_count(),
        "load": round(os.getloadavg()[0], 1),
        "values": {name: [round(value, 3) for value in each] for name, each in values.items()},
    }


@dataclass(frozen=True)
class Opening:
    """Seconds of the way from nothing to a picture, and what it showed."""

    serve_ready_s: float
    upload_s: float
    open_to_traced_s: float
    next_s: float | None
    """Of the same asset under another id, in the same server; None: not asked."""
    view: StartView
    width: int
    height: int

    def seconds(self) -> dict[str, float]:
        whole = self.serve_ready_s + self.upload_s + self.open_to_traced_s
        found = {"serve_ready_s": self.serve_ready_s, "upload_s": self.upload_s, "open_to_traced_s": self.open_to_traced_s}
        return found | {"first_picture_s": whole} | ({} if self.next_s is None else {"next_open_to_traced_s": self.next_s})


def first_opening(asset: Path, folder: Path, kernels: Path | None = None) -> Opening:
    """By a server of its own.

    Args:
        folder: for the server's data, and for nothing afterwards.
        kernels: the folder of compiled kernels; None: the machine's own, and the asset is opened twice.
    """
    with tempfile.TemporaryDirectory(dir=folder) as data, served(Path(data), kernels) as (address, ready), Client(address) as client:
        started = time.perf_counter()
        uploaded = client.upload_asset(asset).id
        upload = time.perf_counter() - started
        seconds, view, width, height = _open(client, uploaded)
        next_seconds = _open(client, client.upload_asset(asset).id)[0] if kernels is None else None
        return Opening(ready, upload, seconds, next_seconds, view, width, height)


def _open(client: Client, asset_id: str) -> tuple[float, StartView, int, int]:
    """Seconds to the first picture, where it is seen from, and its size."""
    started = time.perf_counter()
    session = client.open_session(asset_id)
    with session.stream() as stream:
        stream.look(SIZE, SIZE)
        while (frame := stream.receive(WAIT_SECONDS)) is None:
            pass
        seconds = time.perf_counter() - started
        return seconds, stream.hello.start_view, frame[0].width, frame[0].height


@contextmanager
def served(data: Path, kernels: Path | None = None) -> Iterator[tuple[str, float]]:
    """The address of a new server, token included, and the seconds until it answered.

    Raises:
        ValueError: it ended before it said an address.
    """
    fresh = {} if kernels is None else {"WARP_CACHE_PATH": str(kernels), "XDG_CACHE_HOME": str(kernels)}
    environment = {**os.environ, **fresh}
    started = time.perf_counter()
    command = [sys.executable, *DRGS, "serve", "--no-worker", "--data", str(data), "--port", "0"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment)
    try:
        assert process.stdout is not None
        address = next((found[0] for line in process.stdout if (found := re.search(r"http://\S+#token=\S+", line))), None)
        if address is None:
            raise ValueError(f"drgs serve ended with {process.wait()} before it said its address")
        httpx.get(f"{address.partition('/#')[0]}/healthz").raise_for_status()
        yield address, time.perf_counter() - started
    finally:
        process.terminate()
        try:
            process.wait(STOP_SECONDS)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        if process.stdout is not None:
            process.stdout.close()


def seconds_of(arguments: Sequence[str]) -> float:
    """Of a new interpreter, from its start to its end.

    Raises:
        ValueError: it failed; its last line.
    """
    started = time.perf_counter()
    done = subprocess.run([sys.executable, *arguments], capture_output=True, text=True)
    seconds = time.perf_counter() - started
    if done.returncode != 0:
        raise ValueError(f"python {' '.join(arguments)} ended with {done.returncode}: {(done.stderr.strip().splitlines() or [''])[-1]}")
    return seconds


def render_seconds(asset: Path, folder: Path) -> float:
    """Of `drgs render` from the camera in the folder's transforms.json."""
    with tempfile.TemporaryDirectory(dir=folder) as out:
        return seconds_of(
            [*DRGS, "render", str(asset), out, "--cameras", str(folder / "transforms.json"), "--size", f"{SIZE}x{SIZE}", "--spp", str(RAYS)]
        )


def compiled_modules(kernels: Path) -> list[Path]:
    """Folders of Warp's modules below a folder of compiled kernels, one a module and set of its options."""
    return [path for path in kernels.glob("**/wp_*") if path.is_dir()]


def write_camera(path: Path, view: StartView) -> None:
    """One of SIZE x SIZE, whose angles are the same across and upwards."""
    frame = {"file_path": "first", "transform_matrix": view.world_from_camera}
    path.write_text(json.dumps({"camera_angle_x": math.radians(view.fov_y_degrees), "frames": [frame]}))


def _ball(folder: Path) -> Path:
    from drgs.convert.import_mesh import import_mesh
    from drgs.scene.asset import save_asset
    from tests.web.browser import write_ball

    write_ball(folder / "ball.ply")
    save_asset(import_mesh(folder / "ball.ply"), folder / "ball")
    return folder / "ball"


if __name__ == "__main__":
    main(sys.argv[1:])
