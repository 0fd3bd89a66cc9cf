"""Change one session ten thousand times, kill the server, and compare: the log and the picture must come back bit for bit.

    python -m benchmarks soak [--changes 10000] [--edits-only] [--json]

Starts `drgs serve` in a process of its own on a new data folder, with the real renderer and a ball of 1 280 faces. A program sends edits,
undos and redos over a stream (six, three and one in ten), a few at a time on their way. Then the server is killed (-9) and another one
started on the same folder. Compared are the log before, the log after, a replay of the stored events in this process, and a picture of
each: before, after, and of a new session that is given the edits in force at once.
"""

import argparse
import asyncio
import hashlib
import json
import random
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import psutil
from websockets.asyncio.client import connect

from benchmarks.serve.service import SERVE
from drgs_server.client import Client, RemoteSession

ON_THEIR_WAY = 8
PICTURE: dict[str, Any] = {"width": 160, "height": 120, "spp": 16}
SHARES = {"edit": 6, "undo": 3, "redo": 1}
SEED = 7


def main(arguments: list[str]) -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks soak", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--changes", type=int, default=10_000)
    parser.add_argument("--edits-only", action="store_true", help="no undo, no redo: all changes are in force at the end")
    given = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as folder:
        print(json.dumps(measure(given.changes, Path(folder), mixed=not given.edits_only), indent=None if given.json else 1))


def measure(changes: int, folder: Path, mixed: bool = True) -> dict:
    """Serve, change, kill, serve again, compare.

    Args:
        mixed: with undo and redo; else edits only, all of which are in force at the end.
    """
    import trimesh

    trimesh.creation.icosphere(subdivisions=3).export(folder / "ball.ply")
    server, client = serve_folder(folder)
    try:
        asset = client.upload_asset(folder / "ball.ply", "ball").id
        session = client.open_session(asset)
        _digest(session)  # kernels are compiled once a machine; that is not what is measured
        process = psutil.Process(server.pid)
        rss_before, cpu_before, start = process.memory_info().rss, sum(process.cpu_times()[:2]), time.monotonic()
        tenth = max(1, changes // 10)
        seconds, spent, received = asyncio.run(_send(client, session.id, _messages(changes, mixed), process))
        took, cpu = time.monotonic() - start, sum(process.cpu_times()[:2]) - cpu_before
        rss_after = process.memory_info().rss
        info, picture = session.info(), _digest(session)
        server.kill()
        server.wait()
        client.close()
        server, client = serve_folder(folder)
        start = time.monotonic()
        again = client.session(session.id)
        info_again = again.info()
        replay_seconds = time.monotonic() - start
        picture_again = _digest(again)
        fresh = client.open_session(asset)
        fresh.put_edits(info.edits)
        picture_fresh = _digest(fresh)
    finally:
        client.close()
        server.kill()
        server.wait()
    return {
        "changes": changes,
        "acknowledged": info.revision,
        "edits_in_force": len(info.edits),
        "log_after_kill_is_the_same": info_again.revision == info.revision and info_again.edits == info.edits,
        "log_replayed_here_is_the_same": _replayed(folder, session.id) == (info.revision, tuple(info.edits)),
        "picture_after_kill_is_the_same": picture_again == picture,
        "picture_of_the_edits_anew_is_the_same": picture_fresh == picture,
        "seconds": round(took, 1),
        "server_cpu_seconds": round(cpu, 1),
        "ms_a_change_first_tenth": round(1e3 * statistics.mean(seconds[:tenth]), 2),
        "ms_a_change_last_tenth": round(1e3 * statistics.mean(seconds[-tenth:]), 2),
        "server_ms_a_change_first_tenth": round(1e3 * (spent[tenth] - spent[0]) / tenth, 2),
        "server_ms_a_change_last_tenth": round(1e3 * (spent[-1] - spent[-1 - tenth]) / tenth, 2),
        "bytes_to_the_viewer": received,
        "replay_seconds": round(replay_seconds, 2),
        "memory_mib_before": round(rss_before / 2**20),
        "memory_mib_after": round(rss_after / 2**20),
    }


def serve_folder(folder: Path) -> tuple[subprocess.Popen, Client]:
    """A server of its own on folder/data, with the real renderer, and a client of it; whoever asks ends both."""
    server = subprocess.Popen([sys.executable, "-c", SERVE, str(folder / "data")], stdout=subprocess.PIPE, text=True)
    assert server.stdout is not None
    return server, Client(server.stdout.readline().strip(), timeout_seconds=300)


def _digest(session: RemoteSession) -> str:
    return hashlib.sha256(session.frame(**PICTURE)).hexdigest()


def _messages(changes: int, mixed: bool) -> list[dict]:
    """Fixed by the seed. Undo and redo only where there is something to undo or redo."""
    chooser = random.Random(SEED)
    done = undone = 0
    made: list[dict] = []
    for _ in range(changes):
        kind = chooser.choices(list(SHARES), list(SHARES.values()))[0] if mixed else "edit"
        if (kind == "undo" and not done) or (kind == "redo" and not undone):
            kind = "edit"
        done += -1 if kind == "undo" else 1
        undone = 0 if kind == "edit" else undone + (1 if kind == "undo" else -1)
        made.append({"type": kind} | ({"edit": random_edit(chooser)} if kind == "edit" else {}))
    return made


def random_edit(chooser: random.Random) -> dict:
    """Of a material mostly, of the light or of the shape."""
    kind = chooser.choices(["all", "sphere", "environment", "twist"], [10, 8, 3, 1])[0]
    if kind == "environment":
        return {"op": "environment", "rotation": chooser.uniform(-180, 180)}
    if kind == "twist":
        return {"op": "deform", "map": {"type": "twist", "rate": chooser.uniform(-0.05, 0.05)}}
    center = [chooser.uniform(-1, 1) for _ in range(3)]
    select = {"all": True} if kind == "all" else {"sphere": {"center": center, "radius": 0.4, "falloff": 0.1}}
    return {
        "op": "material",
        "select": select,
        "set": {"roughness": chooser.uniform(0.1, 1), "albedo": [chooser.random() for _ in range(3)]},
    }


async def _send(client: Client, session: str, messages: list[dict], server: psutil.Process) -> tuple[list[float], list[float], int]:
    """Seconds between each change's acknowledgement and the one before; the server's processor seconds before the first and after each; and the
    bytes that came meanwhile.

    Raises:
        ValueError: one was not accepted.
    """
    address = client.address.replace("http", "ws", 1) + f"/api/sessions/{session}/stream"
    seconds: list[float] = []
    spent = [sum(server.cpu_times()[:2])]
    received = 0
    async with connect(address, additional_headers=client._headers, compression=None, max_size=1 << 26) as socket:
        await socket.send(json.dumps({"type": "hello", "v": 1, "changes": True, "client": "soak"}))
        sent, at = 0, time.monotonic()
        while len(seconds) < len(messages):
            while sent < len(messages) and sent - len(seconds) < ON_THEIR_WAY:
                await socket.send(json.dumps(messages[sent] | {"id": sent}))
                sent += 1
            said = await socket.recv()
            received += len(said)
            if isinstance(said, str) and said.startswith(('{"type":"rejected"', '{"type":"error"')):
                raise ValueError(f"a change was refused: {said[:300]}")
            if isinstance(said, str) and said.startswith('{"type":"accepted"'):
                seconds.append(time.monotonic() - at)
                spent.append(sum(server.cpu_times()[:2]))
                at = time.monotonic()
    return seconds, spent, received


def _replayed(folder: Path, session: str) -> tuple[int, tuple]:
    from drgs_server.live.session_store import SessionStore
    from drgs_server.settings import Limits
    from drgs_worker.store.data_directory import open_data_directory
    from drgs_worker.store.database import open_database

    engine = open_database(open_data_directory(folder / "data"))
    log = SessionStore(engine, Limits()).read(session).log
    engine.dispose()
    return log.revision, log.done
