"""Frames as they are made live: a moving camera, an edit, a picture at rest.

    python -m benchmarks frame --asset ASSET [--size 400] [--spp 32] [--frames 24] [--truth 1024] [--json]

fps_moving: pictures a second with the camera turning around the asset, one degree each, `spp` new rays a pixel, what came before
reprojected, diffuse light that is kept on the mesh read where it is known, SVGF, tone mapped; the median. `milliseconds` tells where
the time goes and `cpu_ms` is summed over threads, steadier on a busy machine. kept: share of the last picture's points that show kept
light. relmse: of three of the pictures, a third of the path apart, against `truth` rays, over pixels that the object covers wholly.
traced: the same of pictures that trace all their rays. edit_to_frame_ms: from sending an edit to having the first picture that shows
it, through the WebSocket of a server started for this; the median of eight. idle_cpu_percent: of one core, of that server with its
viewer still connected, once the picture has converged.
"""

import argparse
import json
import math
import os
import shutil
import statistics
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from subprocess import PIPE, Popen
from types import MappingProxyType

import psutil
import torch

from drgs.deform.pose_scene import pose_scene
from drgs.render.film.resolve_frame import resolve_frame
from drgs.render.integrate.plan import samples_per_pass
from drgs.render.progressive.refine import refine_frame
from drgs.render.progressive.start_frame import start_frame
from drgs.render.records import Frame, RenderSettings
from drgs.scene.asset import Asset, load_asset
from drgs.scene.camera import Camera, camera_from_opengl
from drgs.scene.posed_scene import PrimarySurface
from drgs.warp_torch import device_from_name
from drgs_server.client import Client, Stream
from drgs_server.live.messages import AcceptedMessage
from drgs_server.render.settle_memory import settle_memory

WARM_UP = 3
"""Pictures before the first that is measured."""
EDITS = 8
IDLE_SECONDS = 4.0
PROGRAM = (
    "import sys; from pathlib import Path; from drgs_server.run import serve;"
    "sys.exit(serve(Path(sys.argv[1]), port=0, with_worker=False, device=sys.argv[2], ready=lambda address: print(address, flush=True)))"
)


def main(arguments: list[str]) -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks frame", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--asset", type=Path, required=True)
    parser.add_argument("--size", type=int, default=400)
    parser.add_argument("--spp", type=int, default=32)
    parser.add_argument("--frames", type=int, default=24)
    parser.add_argument("--truth", type=int, default=1024, help="rays a pixel of the pictures that relmse compares with; 0: compares none")
    parser.add_argument("--primary", choices=["gaussians", "mesh"], help="default: what the asset has")
    parser.add_argument("--device", default="auto", choices=["auto", "cpu", "cuda"])
    parser.add_argument("--no-server", action="store_true", help="only the moving camera")
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args(arguments)
    asset = load_asset(given.asset, device_from_name(given.device))
    settle_memory()  # as a server does once its first picture is made
    truth = true_pictures(asset, given.size, given.truth, given.frames, given.primary)
    result = moving(asset, given.size, given.spp, given.frames, given.primary, truth)
    result["traced"] = moving(asset, given.size, given.spp, given.frames, given.primary, truth, keep_light=False)
    if not given.no_server:
        with served(given.asset, given.size, given.device) as (process, client, stream):
            result |= edits(client, stream, given.size)
            result |= idle(process, stream)
    print(json.dumps(result, indent=None if given.json else 1))


def orbit(asset: Asset, size: int) -> Iterator[Camera]:
    """Cameras around the asset's middle, a degree apart, that show it as large as the asset's own cameras do."""
    vertices = asset.mesh.vertices.cpu().double()
    middle = (vertices.amin(0) + vertices.amax(0)) / 2
    radius = float((vertices - middle).norm(dim=-1).max())
    distance, field = 4 * radius, 0.55  # of an imported mesh, which has none
    if asset.cameras:
        distance = statistics.median(float((camera.center_world.cpu().double() - middle).norm()) for camera in asset.cameras)
        field = statistics.median(2 * math.atan(0.5 * camera.width / float(camera.intrinsics[0, 0])) for camera in asset.cameras)
    focal = size / (2 * math.tan(field / 2))
    intrinsics = torch.tensor([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]])
    degrees = 0
    while True:
        angle = math.radians(30 + degrees)
        back = torch.tensor([math.cos(angle) * 0.9, math.sin(angle) * 0.9, math.sqrt(1 - 0.81)], dtype=torch.float64)
        right = torch.nn.functional.normalize(torch.linalg.cross(torch.tensor([0.0, 0, 1], dtype=torch.float64), back), dim=0)
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, :3] = torch.stack([right, torch.linalg.cross(back, right), back], -1)
        pose[:3, 3] = middle + distance * back
        yield camera_from_opengl(pose, intrinsics, size, size)
        degrees += 1


def true_pictures(asset: Asset, size: int, rays: int, frames: int, primary: PrimarySurface | None) -> dict[int, Frame]:
    """By their numbers on the path, those that errors are measured against."""
    scene, truth = pose_scene(asset, []), {}
    settings = RenderSettings(primary=primary, seed=1)  # random numbers of their own
    for number, camera in zip(range(-WARM_UP, frames), orbit(asset, size), strict=False):
        if rays > 0 and number + 1 in (frames // 3, 2 * frames // 3, frames):
            state = start_frame(scene, camera, settings)
            truth[number] = resolve_frame(refine_frame(state, -(-rays // samples_per_pass(state.inputs).total)))
    return truth


def relmse(found: Frame, truth: Frame) -> float:
    inside = truth.gbuffer.coverage == 1
    x, y = (frame.radiance_linear[inside].double() for frame in (found, truth))
    return float(((x - y) ** 2 / (y * y + 0.01)).mean())


def moving(
    asset: Asset,
    size: int,
    samples: int,
    frames: int,
    primary: PrimarySurface | None,
    truth: Mapping[int, Frame] = MappingProxyType({}),
    keep_light: bool = True,
) -> dict:
    """Frame times of a camera that turns, and errors of the pictures of which there is a truth."""
    scene, cameras = pose_scene(asset, []), orbit(asset, size)
    settings = RenderSettings(
        samples_per_pixel=samples, samples_per_pass=samples, primary=primary, denoise="svgf", keep_light=keep_light
    )  # fmt: skip
    wall: list[float] = []
    cpu: list[float] = []
    errors: list[float] = []
    steps: dict[str, list[float]] = {}
    state = None
    for number in range(-WARM_UP, frames):  # the first pictures compile and build what all share
        started, cpu_started = time.perf_counter(), time.process_time()
        state = refine_frame(start_frame(scene, next(cameras), settings, previous=state))
        frame = resolve_frame(state)
        if scene.mesh.vertices.is_cuda:
            torch.cuda.synchronize()
        if number >= 0:
            wall.append(time.perf_counter() - started)
            cpu.append(time.process_time() - cpu_started)
            for step, milliseconds in frame.metadata["milliseconds"].items():
                steps.setdefault(step, []).append(milliseconds)
        if number in truth:
            errors.append(relmse(frame, truth[number]))
    kept = None if state is None else state.kept_samples
    covered = float((frame.gbuffer.coverage > 0).float().mean())
    return {
        "fps_moving": round(1 / statistics.median(wall), 2),
        "frame_ms": round(1000 * statistics.median(wall), 1),
        "cpu_ms": round(1000 * statistics.median(cpu), 1),
        "covered": round(covered, 3),
        "kept": 0.0 if kept is None else round(float((kept > 0).float().mean()) / covered, 3),
        "relmse": [round(error, 5) for error in errors],
        "milliseconds": {step: round(statistics.median(values), 1) for step, values in steps.items()},
    }


@contextmanager
def served(asset: Path, size: int, device: str) -> Iterator[tuple[psutil.Process, Client, Stream]]:
    """A server with the asset open in one session, watched by one viewer."""
    with tempfile.TemporaryDirectory() as folder:
        # Other threads that spin between their tasks would be measured as well.
        environment = {**os.environ, "OMP_WAIT_POLICY": "PASSIVE"}
        process = Popen([sys.executable, "-c", PROGRAM, folder, device], stdout=PIPE, text=True, env=environment)
        assert process.stdout is not None
        try:
            with Client(process.stdout.readline().strip()) as client:
                zipped = asset if asset.is_file() else Path(shutil.make_archive(f"{folder}/asset", "zip", asset))
                session = client.open_session(client.upload_asset(zipped).id)
                with session.stream() as stream:
                    stream.look(size, size)
                    yield psutil.Process(process.pid), client, stream
        finally:
            process.terminate()
            process.wait()


def edits(client: Client, stream: Stream, size: int) -> dict:
    """Milliseconds from an edit to its first picture."""
    for _ in stream.frames():
        pass
    waits = []
    for number in range(EDITS):
        edit = {"op": "material", "select": {"all": True}, "set": {"roughness": 0.1 + 0.1 * number}, "mode": "absolute"}
        started = time.perf_counter()
        stream.send(type="edit", id=1000 + number, edit=edit)
        revision = None
        while True:
            frame = stream.receive(60)
            if frame is None and isinstance(stream.messages[-1], AcceptedMessage):
                revision = stream.messages[-1].revision
            if frame is not None and revision is not None and frame[0].state_rev >= revision:
                break
        waits.append(1000 * (time.perf_counter() - started))
        for _ in stream.frames():
            pass
    return {"edit_to_frame_ms": round(statistics.median(waits), 1), "edit_to_frame_ms_worst": round(max(waits), 1)}


def idle(process: psutil.Process, stream: Stream) -> dict:
    """Share of one core that a server with a converged picture takes."""

    def seconds() -> float:
        times = process.cpu_times()
        return times.user + times.system

    time.sleep(1)  # what was under way ends
    started, before = time.perf_counter(), seconds()
    time.sleep(IDLE_SECONDS)
    return {"idle_cpu_percent": round(100 * (seconds() - before) / (time.perf_counter() - started), 2)}
