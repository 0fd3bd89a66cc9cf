"""One more edit against how many are in force: until it is acknowledged, until a picture shows it, and what the viewer is sent."""

import json
import random
import statistics
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple

import psutil
from websockets.sync.client import ClientConnection

from benchmarks.scale.cost_curve import CostCurve, Point
from benchmarks.scale.made_objects import bumpy_ball
from benchmarks.scale.own_server import own_server
from benchmarks.scale.scale_run import ScaleRun
from benchmarks.serve.soak import SEED, random_edit
from drgs.scene.asset import save_asset
from drgs_server.client import Client, RemoteSession, ServerError
from drgs_server.live.frame_header import FLAG_CONVERGED, FrameHeader, unpack_frame

FACES = 1280
"""About as many as the ball of `python -m benchmarks soak`."""
PICTURE_SIDE = 160
RAYS = 8
"""A pixel, at which a picture counts as converged: the work behind a change is what is asked about."""
SECONDS_TO_WAIT = 300.0
"""For a picture of thousands of edits."""


class _Change(NamedTuple):
    """What one edit took."""

    accepted_seconds: float
    picture_seconds: float
    message_bytes: int
    """Of text, until the picture had come."""


def edits(run: ScaleRun) -> CostCurve:
    """On a server of its own."""
    with own_server(run.folder / "edits") as (server, client):
        return edits_on_server(run, server, client)


def edits_on_server(run: ScaleRun, server: psutil.Process, client: Client) -> CostCurve:
    """Medians of single edits, each sent when the picture before has converged; a session of its own for each point."""
    save_asset(bumpy_ball(FACES, run.device), run.folder / "ball")
    asset = client.upload_asset(run.folder / "ball", "ball").id
    points = [_point(client, server, asset, count, run) for count in run.sizes.edits]
    costs = {"seconds": "edit to picture", "accepted_seconds": "edit to acknowledgement", "message_bytes": "bytes of messages"}
    return CostCurve("edits", "edits in force", points, costs)


def _point(client: Client, server: psutil.Process, asset: str, in_force: int, run: ScaleRun) -> Point:
    chooser = random.Random(SEED)
    session = client.open_session(asset)
    session.put_edits([random_edit(chooser) for _ in range(in_force)])
    with _watching(client, session.id) as socket:
        changed = [_change(socket, -1)]  # warms up
        cpu_before = sum(server.cpu_times()[:2])
        changed = [_change(socket, number) for number in range(run.sizes.edits_measured * run.repeats)]
        cpu_seconds = (sum(server.cpu_times()[:2]) - cpu_before) / len(changed)
    _delete(session)
    return {
        "x": in_force,
        "seconds": round(statistics.median(change.picture_seconds for change in changed), 6),
        "accepted_seconds": round(statistics.median(change.accepted_seconds for change in changed), 6),
        "cpu_seconds": round(cpu_seconds, 6),
        "message_bytes": statistics.median(change.message_bytes for change in changed),
    }


def _delete(session: RemoteSession) -> None:
    """Once the server has noticed that its viewer is gone."""
    deadline = time.monotonic() + SECONDS_TO_WAIT
    while True:
        try:
            return session.delete()
        except ServerError as error:
            if error.status != 409 or time.monotonic() > deadline:
                raise
        time.sleep(0.02)


@contextmanager
def _watching(client: Client, session: str) -> Iterator[ClientConnection]:
    """A viewer that is told changes, as the page is, and sees a converged picture."""
    with client._connect(session) as socket:
        socket.send(json.dumps({"type": "hello", "v": 1, "changes": True, "client": "scale"}))
        while (said := json.loads(socket.recv(SECONDS_TO_WAIT)))["type"] != "hello":
            pass
        start = said["start_view"]
        socket.send(json.dumps({"type": "settings", "settings": {"spp_target": RAYS}}))
        camera = {"world_from_camera": start["world_from_camera"], "fov_y_degrees": start["fov_y_degrees"]}
        socket.send(json.dumps({"type": "camera", "number": 1, "width": PICTURE_SIDE, "height": PICTURE_SIDE} | camera))
        _until_converged(socket)
        yield socket


def _change(socket: ClientConnection, number: int) -> _Change:
    """Send one edit and wait until its picture has converged.

    Raises:
        ValueError: it was not accepted.
    """
    roughness = 0.5 + 0.4 * (number % 7 - 3) / 3
    edit = {"op": "material", "select": {"all": True}, "set": {"roughness": roughness}}
    started, message_bytes = time.perf_counter(), 0
    socket.send(json.dumps({"type": "edit", "id": 1000 + number, "edit": edit}))
    revision, accepted_seconds = None, 0.0
    while True:
        said = socket.recv(SECONDS_TO_WAIT)
        if isinstance(said, bytes):
            header = _acknowledge(socket, said)
            if revision is not None and header.state_rev >= revision:
                break
            continue
        message_bytes += len(said)
        message = json.loads(said)
        if message["type"] in ("rejected", "error"):
            raise ValueError(f"an edit was refused: {said[:300]}")
        if message["type"] == "accepted":
            revision, accepted_seconds = message["revision"], time.perf_counter() - started
    picture_seconds = time.perf_counter() - started
    if not header.flags & FLAG_CONVERGED:
        _until_converged(socket)
    return _Change(accepted_seconds, picture_seconds, message_bytes)


def _until_converged(socket: ClientConnection) -> None:
    while True:
        said = socket.recv(SECONDS_TO_WAIT)
        if isinstance(said, bytes) and _acknowledge(socket, said).flags & FLAG_CONVERGED:
            return


def _acknowledge(socket: ClientConnection, said: bytes) -> FrameHeader:
    header, _ = unpack_frame(said)
    socket.send(json.dumps({"type": "ack", "frame_id": header.frame_id}))
    return header
