"""`drgs serve` as users run it: its own process, its own worker, the typed client, and the parts of it killed."""

import json
import os
import queue
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

from drgs.convert.import_mesh import import_mesh
from drgs.scene.asset import save_asset
from drgs_server.client import Client, ServerError
from drgs_server.run import serve
from drgs_worker.jobs.builders import BUILDER_VARIABLE
from examples import turntable, variants_sheet
from tests.patience import PATIENCE_SECONDS

REPOSITORY = Path(__file__).parents[2]
PROGRAM = "import sys; from pathlib import Path; from drgs_server.run import serve; sys.exit(serve(Path(sys.argv[1]), port=int(sys.argv[2]), ready=lambda a: print(a, flush=True)))"


class ServeProcess:
    """Started again and again on one data directory."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.process: subprocess.Popen | None = None

    def start(self, port: int = 0) -> Client:
        paths = os.pathsep.join(str(REPOSITORY / folder) for folder in ("tests/worker", ".", "worker", "server"))
        environment = {**os.environ, BUILDER_VARIABLE: "tiny_builder:build", "PYTHONPATH": paths}
        self.process = subprocess.Popen(
            [sys.executable, "-c", PROGRAM, str(self.root / "data"), str(port)],
            env=environment,
            cwd=self.root,
            stdout=subprocess.PIPE,
            text=True,
        )
        lines: queue.Queue[str] = queue.Queue()
        stdout = self.process.stdout
        assert stdout is not None
        threading.Thread(target=lambda: lines.put(stdout.readline()), daemon=True).start()
        address = lines.get(timeout=PATIENCE_SECONDS).strip()
        assert address.startswith("http://127.0.0.1:") and "#token=" in address
        return Client(address)

    def worker(self) -> psutil.Process:
        assert self.process is not None
        start = time.monotonic()
        while time.monotonic() - start < PATIENCE_SECONDS:
            found = [child for child in psutil.Process(self.process.pid).children() if "drgs_worker" in child.cmdline()]
            if found:
                return found[0]
            time.sleep(0.05)
        raise AssertionError("no worker was started")

    def stop(self) -> int:
        assert self.process is not None
        self.process.send_signal(signal.SIGTERM)
        return self.process.wait(PATIENCE_SECONDS)


@pytest.fixture
def running(tmp_path: Path) -> Iterator[ServeProcess]:
    running = ServeProcess(tmp_path)
    yield running
    if running.process and running.process.poll() is None:
        running.stop()


def capture(root: Path, **plan: object) -> Path:
    folder = root / "capture"
    folder.mkdir(exist_ok=True)
    (folder / "plan.json").write_text(json.dumps(plan))
    return folder


@pytest.mark.slow
def test_a_build_survives_kill_9_of_the_worker_and_of_the_server(running: ServeProcess) -> None:
    client = running.start()
    job = client.submit_build(capture(running.root, iterations=60, seconds=0.04), preset="draft", idempotency_key="once")
    assert client.submit_build(running.root / "capture", preset="draft", idempotency_key="once").id == job.id
    states = []
    worker = running.worker()
    killed = []
    for seen in client.watch(job, interval_seconds=0.1):
        states.append(seen.state)
        if seen.iteration >= 5 and not killed:
            worker.kill()  # the server starts another one, which goes on
            killed.append("worker")
        if seen.attempts == 2 and len(killed) == 1:
            assert running.process is not None
            running.process.kill()
            running.process.wait()
            killed.append("server")
            break
    assert killed == ["worker", "server"]
    client = running.start()
    last = [*client.watch(job.id, interval_seconds=0.1)][-1]
    assert (last.state, last.fraction, last.asset_id, last.error) == ("done", 1.0, job.id, None)
    assert last.attempts == 3 and client.jobs().total == 1
    ran = (running.root / "data" / "jobs" / job.id / "ran.txt").read_text().split("\n")
    iterations = [int(line.split()[1]) for line in ran if line]
    assert sorted(set(iterations)) == list(range(60)) and len(iterations) <= 62
    assert client.preview(job.id).startswith(b"\xff\xd8")
    assert client.assets().assets[0].face_count == 20
    assert running.stop() == 0


@pytest.mark.slow
def test_acknowledged_edits_are_there_after_kill_9_of_the_server(running: ServeProcess, tmp_path: Path) -> None:
    client = running.start()
    mesh = tmp_path / "tetrahedron.obj"
    mesh.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n")
    asset = client.upload_asset(mesh, name="four faces")
    assert (asset.face_count, asset.has_thumbnail, asset.name) == (4, True, "four faces")
    save_asset(import_mesh(mesh), tmp_path / "in a folder")
    folder = client.upload_asset(tmp_path / "in a folder")
    assert (folder.face_count, folder.name) == (4, "in a folder")
    with pytest.raises(ValueError, match=r"has no asset\.json"):
        client.upload_asset(tmp_path)
    session = client.open_session(asset.id)
    for k in range(5):
        revision = session.edit({"op": "material", "select": {"all": True}, "set": {"roughness": k / 10}}).revision
    session.undo()
    before = session.info()
    assert running.process is not None
    running.process.kill()
    running.process.wait()
    client = running.start()
    after = client.session(session.id).info()
    assert after == before and after.revision == revision + 1 and len(after.edits) == 4
    with client.session(session.id).stream() as stream:
        stream.send(type="settings", settings={"spp_target": 16})
        stream.look(96, 64)
        frames = list(stream.frames())
    assert frames[-1][0].state_rev == 6 and frames[-1][0].spp >= 16 and frames[-1][1].startswith(b"\x89PNG")
    with pytest.raises(ServerError, match="No session"):
        client.session("0" * 32)
    address = f"{client.address}/#token={client._headers['Authorization'].removeprefix('Bearer ')}"
    turntable.main(
        [
            address,
            asset.id,
            str(tmp_path / "turn.mp4"),
            "--frames",
            "2",
            "--size",
            "32x32",
            "--spp",
            "4",
            "--environment",
            client.environments()[0].name,
        ]
    )
    assert b"ftyp" in (tmp_path / "turn.mp4").read_bytes()[:12]
    variants_sheet.main([address, asset.id, str(tmp_path / "sheet.png"), "--side", "16", "--steps", "2", "--spp", "4"])
    assert (tmp_path / "sheet.png").read_bytes().startswith(b"\x89PNG")
    with pytest.raises(ServerError, match="No environment"):
        turntable.main([address, asset.id, str(tmp_path / "none.mp4"), "--environment", "none.exr"])


def test_the_server_refuses_to_listen_to_the_world(tmp_path: Path) -> None:
    for host in ("0.0.0.0", "192.168.1.1", "::"):
        with pytest.raises(ValueError, match="this machine only"):
            serve(tmp_path, host=host)
