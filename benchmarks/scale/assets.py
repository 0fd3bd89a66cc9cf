"""A server's memory against the assets that are open in it."""

import math
import time

import psutil

from benchmarks.scale.cost_curve import CostCurve, Point
from benchmarks.scale.made_objects import bumpy_ball
from benchmarks.scale.own_server import own_server
from benchmarks.scale.scale_run import ScaleRun
from drgs.scene.asset import save_asset
from drgs_server.client import Client

PICTURE_SIDE = 160
RAYS = 16
WARM_UP_FACES = 1280


def assets(run: ScaleRun) -> CostCurve:
    """On a server of its own."""
    with own_server(run.folder / "assets") as (server, client):
        return assets_on_server(run, server, client)


def assets_on_server(run: ScaleRun, server: psutil.Process, client: Client) -> CostCurve:
    """Resident memory beyond that of the server with one tiny asset, which has loaded all code, by the bytes of the opened assets' files."""
    most = max(run.sizes.assets)
    _open(client, run, WARM_UP_FACES, 0.0)
    empty_mib = _resident_mib(server)
    points: list[Point] = []
    asset_mib = seconds = 0.0
    for count in range(1, most + 1):
        opened_mib, took = _open(client, run, run.sizes.asset_faces, 2 * math.pi * count / (most + 1))
        asset_mib, seconds = asset_mib + opened_mib, seconds + took
        if count in run.sizes.assets:
            points.append(_point(count, asset_mib, _resident_mib(server), empty_mib, seconds))
    costs = {"grown_mib": "memory beyond the empty server's [MiB]", "seconds": "seconds to have them all open"}
    return CostCurve("assets", "open assets", points, costs)


def _point(count: int, asset_mib: float, memory_mib: float, empty_mib: float, seconds: float) -> Point:
    grown_mib = memory_mib - empty_mib
    return {
        "x": count,
        "asset_mib": round(asset_mib, 3),
        "memory_mib": round(memory_mib, 1),
        "grown_mib": round(grown_mib, 1),
        "mib_per_mib": round(grown_mib / asset_mib, 2),
        "seconds": round(seconds, 2),
    }


def _open(client: Client, run: ScaleRun, faces: int, turn: float) -> tuple[float, float]:
    """Upload an asset, open it, and have a picture of it; the MiB of its files, and seconds without those that made it."""
    folder = run.folder / f"asset_{faces}_{turn:.6f}"
    save_asset(bumpy_ball(faces, run.device, turn), folder)
    started = time.perf_counter()
    session = client.open_session(client.upload_asset(folder).id)
    session.frame(PICTURE_SIDE, PICTURE_SIDE, spp=RAYS)
    return sum(path.stat().st_size for path in folder.iterdir()) / 2**20, time.perf_counter() - started


def _resident_mib(server: psutil.Process) -> float:
    return server.memory_info().rss / 2**20
