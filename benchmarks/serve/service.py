"""Load a server as a small team would: viewers on shared sessions move cameras and edit, while the API is asked and 500 jobs wait.

    python -m benchmarks service [--json] [--seconds 60] [--viewers 20] [--sessions 4] [--size 320x240] [--asset FOLDER] [--jobs 500]

Starts `drgs serve` in a process of its own on a new data folder, with the real renderer, and everything that asks in others. Prints
api_p99_ms (GET calls from a process that does nothing else), errors, lost_edits (acknowledged and not in the log afterwards, or never
answered), memory_growth_percent (server's resident memory: last sixth of the time against the third sixth, when all is warm), jobs_list_ms
(median, all jobs on one page) and frames_per_second (all viewers together).
"""

import argparse
import asyncio
import http.client
import json
import math
import multiprocessing
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import time
import uuid
from dataclasses import dataclass, field
from multiprocessing.queues import Queue
from pathlib import Path

import psutil
from websockets.asyncio.client import ClientConnection, connect

from drgs_server.client import Client
from drgs_server.live.frame_header import unpack_frame
from drgs_server.live.messages import ServerHello, server_message

SERVE = "import sys; from pathlib import Path; from drgs_server.run import serve; serve(Path(sys.argv[1]), port=0, with_worker=False, ready=lambda a: print(a, flush=True))"
CAMERAS_A_SECOND = 10
MOVING_SHARE = 0.5
"""Of each viewer's time; it rests for the other half."""
CYCLE_SECONDS = 6.0
EDITS_A_SECOND = 2.0
PROBES_A_SECOND = 25
ANSWER_SECONDS = 20.0
QUIET_SECONDS = 8.0
"""Of calls before viewers come: what the machine itself does to them."""


@dataclass
class Seen:
    """By one viewer."""

    frames: int = 0
    errors: list[str] = field(default_factory=list)
    sent: int = 0
    accepted: list[int] = field(default_factory=list)


def main(arguments: list[str]) -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks service", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--viewers", type=int, default=20)
    parser.add_argument("--sessions", type=int, default=4)
    parser.add_argument("--size", default="320x240", help="WIDTHxHEIGHT of every viewer's picture")
    parser.add_argument("--asset", type=Path, help="asset folder; without it an icosphere of 20 480 faces")
    parser.add_argument("--jobs", type=int, default=500)
    given = parser.parse_args(arguments)
    if not 1 <= given.sessions <= given.viewers or not 0 <= given.jobs <= 500:
        raise ValueError("expected 1 <= --sessions <= --viewers and 0 <= --jobs <= 500")
    with tempfile.TemporaryDirectory() as folder:
        print(json.dumps(measure(given, Path(folder)), indent=None if given.json else 1))


def measure(given: argparse.Namespace, folder: Path) -> dict:
    """Serve, load, compare."""
    server = subprocess.Popen([sys.executable, "-c", SERVE, str(folder / "data")], stdout=subprocess.PIPE, text=True)
    try:
        assert server.stdout is not None
        address = server.stdout.readline().strip()
        with Client(address, timeout_seconds=300) as client:
            asset = client.upload_asset(_asset_file(given.asset, folder), "ball").id
            sessions = [client.open_session(asset) for _ in range(given.sessions)]
            _queue_jobs(folder / "data", given.jobs)
            width, _, height = given.size.partition("x")
            for session in sessions:  # kernels are compiled once a machine; that is not what is measured
                session.frame(int(width), int(height), spp=8)
            queue: Queue = multiprocessing.get_context("spawn").Queue()
            _probe(client.address, client._headers["Authorization"], sessions[0].id, QUIET_SECONDS, queue)
            quiet = sorted(seconds for _, seconds in queue.get()["seconds"])
            memory, probes, seen = asyncio.run(
                _load(client, server.pid, [session.id for session in sessions], given, int(width), int(height))
            )
            lost = 0
            for index, session in enumerate(sessions):
                editor = seen[index]
                revision = session.info().revision
                lost += editor.sent - len(editor.accepted) + max(0, len(editor.accepted) - revision)
            lists = [_timed(lambda: client.jobs(limit=500)) for _ in range(9)]
            replayed = _revisions_after_kill(server, folder, [session.id for session in sessions])
            for index, revision in enumerate(replayed):
                lost += max(0, max(seen[index].accepted, default=0) - revision)
    finally:
        if server.poll() is None:
            server.send_signal(signal.SIGTERM)
            server.wait(30)
    errors = [error for viewer in seen for error in viewer.errors] + probes["errors"]
    times = sorted(seconds for _, seconds in probes["seconds"])
    by_path: dict[str, list[float]] = {}
    for path, seconds in probes["seconds"]:
        by_path.setdefault(path.split("?")[0].rsplit("/", 1)[0] if "sessions" in path else path.split("?")[0], []).append(seconds)
    sixth = len(memory) // 6
    early, late = statistics.median(memory[2 * sixth : 3 * sixth]), statistics.median(memory[5 * sixth :])
    return {
        "api_p99_ms": _percentile_ms(times, 0.99),
        "api_p99_ms_without_viewers": _percentile_ms(quiet, 0.99),
        "api_p99_ms_by_call": {path: _percentile_ms(sorted(found), 0.99) for path, found in by_path.items()},
        "api_p50_ms": round(1e3 * statistics.median(times), 2),
        "errors": len(errors),
        "error_examples": errors[:3],
        "lost_edits": lost,
        "memory_growth_percent": round(100 * (late / early - 1), 2),
        "memory_mib": round(late / 2**20),
        "jobs_list_ms": round(1e3 * statistics.median(lists), 1),
        "frames_per_second": round(sum(viewer.frames for viewer in seen) / given.seconds, 1),
        "slowest_viewer_frames_per_second": round(min(viewer.frames for viewer in seen) / given.seconds, 2),
        "edits": sum(len(viewer.accepted) for viewer in seen),
        "api_calls": len(times),
        "viewers": given.viewers,
        "sessions": given.sessions,
        "seconds": given.seconds,
        "size": given.size,
        "cores": os.cpu_count(),
        "load_before": round(os.getloadavg()[2], 1),
    }


def _percentile_ms(ordered: list[float], share: float) -> float:
    return round(1e3 * ordered[max(0, math.ceil(share * len(ordered)) - 1)], 2)


def _asset_file(asset: Path | None, folder: Path) -> Path:
    import trimesh

    if asset is None:
        path = folder / "ball.ply"
        trimesh.creation.icosphere(subdivisions=5).export(path)
        return path
    import shutil

    return Path(shutil.make_archive(str(folder / "asset"), "zip", asset))


def _queue_jobs(data: Path, count: int) -> None:
    """As POST /api/jobs does, without as many uploads."""
    from drgs_worker.jobs.queue import JobQueue
    from drgs_worker.store.data_directory import open_data_directory
    from drgs_worker.store.database import JobRow, now, open_database

    directory = open_data_directory(data)
    engine = open_database(directory)
    queue = JobQueue(directory, engine)
    for _ in range(count):
        queue.submit(JobRow(id=uuid.uuid4().hex, kind="build", name="waiting", dataset="none", preset="draft", seed=0, created_at=now()))
    queue.close()
    engine.dispose()


def _timed(call) -> float:
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


async def _load(client: Client, pid: int, sessions: list[str], given: argparse.Namespace, width: int, height: int):
    process = psutil.Process(pid)
    end_at = time.monotonic() + given.seconds
    results: Queue = multiprocessing.get_context("spawn").Queue()
    probe = multiprocessing.get_context("spawn").Process(
        target=_probe, args=(client.address, client._headers["Authorization"], sessions[0], given.seconds, results)
    )
    probe.start()
    seen = [Seen() for _ in range(given.viewers)]
    memory: list[float] = []

    async def watch_memory() -> None:
        while time.monotonic() < end_at:
            memory.append(process.memory_info().rss)
            await asyncio.sleep(0.5)

    await asyncio.gather(
        watch_memory(),
        *(
            _view(client, sessions[index % len(sessions)], index, index < len(sessions), seen[index], end_at, width, height)
            for index in range(given.viewers)
        ),
    )
    probes = await asyncio.to_thread(results.get, True, 60)
    probe.join()
    return memory, probes, seen


async def _view(client: Client, session: str, index: int, edits: bool, seen: Seen, end_at: float, width: int, height: int) -> None:
    """One viewer; the first of each session edits."""
    address = client.address.replace("http", "ws", 1) + f"/api/sessions/{session}/stream"
    try:
        async with connect(address, additional_headers=client._headers, compression=None, max_size=1 << 26) as socket:
            await socket.send(json.dumps({"type": "hello", "v": 1, "client": "benchmark"}))
            hello = None
            while hello is None:
                said = await socket.recv()
                message = server_message.validate_json(said) if isinstance(said, str) else None
                hello = message if isinstance(message, ServerHello) else None
            tasks = [asyncio.create_task(_move(socket, hello, index, end_at, width, height))]
            if edits:
                tasks.append(asyncio.create_task(_edit(socket, seen, end_at)))
            while time.monotonic() < end_at or len(seen.accepted) < seen.sent:
                try:
                    said = await asyncio.wait_for(socket.recv(), 0.25)
                except TimeoutError:
                    if time.monotonic() > end_at + ANSWER_SECONDS:
                        break
                    continue
                if isinstance(said, bytes):
                    seen.frames += time.monotonic() < end_at
                    await socket.send(json.dumps({"type": "ack", "frame_id": unpack_frame(said)[0].frame_id}))
                elif said.startswith('{"type":"accepted"'):
                    seen.accepted.append(json.loads(said)["revision"])
                elif said.startswith(('{"type":"error"', '{"type":"rejected"')):
                    seen.errors.append(said[:200])
            await asyncio.gather(*tasks)
    except Exception as error:  # whatever ends a viewer is what this benchmark counts
        seen.errors.append(f"{type(error).__name__}: {error}"[:200])


async def _move(socket: ClientConnection, hello: ServerHello, index: int, end_at: float, width: int, height: int) -> None:
    start = hello.start_view
    number = 0
    while time.monotonic() < end_at:
        phase = (time.monotonic() / CYCLE_SECONDS + index / 7) % 1
        if phase < MOVING_SHARE or number == 0:
            number += 1
            angle = 0.02 * number
            turn: list[list[float]] = [
                [math.cos(angle), -math.sin(angle), 0, 0],
                [math.sin(angle), math.cos(angle), 0, 0],
                [0, 0, 1, 0],
                [0, 0, 0, 1],
            ]
            matrix = [[sum(row[k] * start.world_from_camera[k][column] for k in range(4)) for column in range(4)] for row in turn]
            camera = {"type": "camera", "number": number, "world_from_camera": matrix, "fov_y_degrees": start.fov_y_degrees}
            await socket.send(json.dumps({**camera, "width": width, "height": height}))
        await asyncio.sleep(1 / CAMERAS_A_SECOND)


async def _edit(socket: ClientConnection, seen: Seen, end_at: float) -> None:
    while time.monotonic() < end_at - 1:
        seen.sent += 1
        message: dict = {"type": "undo", "id": seen.sent}
        if seen.sent % 3:
            edit = {"op": "material", "select": {"all": True}, "set": {"roughness": 0.1 + 0.8 * (seen.sent % 10) / 10}}
            message = {"type": "edit", "id": seen.sent, "edit": edit}
        await socket.send(json.dumps(message))
        await asyncio.sleep(1 / EDITS_A_SECOND)


def _probe(address: str, authorization: str, session: str, seconds: float, results: Queue) -> None:
    """Calls that a page or a script makes, one at a time."""
    host = address.removeprefix("http://")
    connection = http.client.HTTPConnection(host, timeout=30)
    paths = ["/healthz", "/api/assets", "/api/jobs?limit=20", f"/api/sessions/{session}", "/api/environments"]
    times: list[tuple[str, float]] = []
    errors = []
    end_at, count = time.monotonic() + seconds, 0
    while time.monotonic() < end_at:
        path = paths[count % len(paths)]
        count += 1
        start = time.perf_counter()
        try:
            connection.request("GET", path, headers={"Authorization": authorization})
            answer = connection.getresponse()
            answer.read()
            if answer.status != 200:
                errors.append(f"{path}: {answer.status}")
        except (OSError, http.client.HTTPException) as error:
            errors.append(f"{path}: {error}")
            connection.close()
        times.append((path, time.perf_counter() - start))
        time.sleep(1 / PROBES_A_SECOND)
    results.put({"seconds": times, "errors": errors})


def _revisions_after_kill(server: subprocess.Popen, folder: Path, sessions: list[str]) -> list[int]:
    """Of each session's log, as another process finds it after kill -9 of the server."""
    server.kill()
    server.wait()
    from sqlalchemy import func, select
    from sqlalchemy.orm import Session

    from drgs_worker.store.data_directory import open_data_directory
    from drgs_worker.store.database import SessionEventRow, open_database

    engine = open_database(open_data_directory(folder / "data"))
    with Session(engine) as database:
        newest = select(func.max(SessionEventRow.revision))
        return [database.scalar(newest.where(SessionEventRow.session_id == session)) or 0 for session in sessions]
