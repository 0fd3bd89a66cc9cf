"""A disk that is full: what is sent is refused with a word on when to come back, what was acknowledged stays, and all goes on once there is room.

The disk is a small one in memory where that may be mounted; elsewhere the server's processes are told that no file of theirs may grow beyond a
size, which fails as a full disk does.
"""

import resource
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import numpy as np
import psutil

from benchmarks.serve.trials.changes import finite_picture
from benchmarks.serve.trials.shapes import ball, exr, ply
from benchmarks.serve.trials.site import Answer, Site, Trial

DISK_BYTES = 96 << 20
LEFT_BYTES = 128 << 10
"""On the full disk: answers and locks find a place, files do not."""
SWEPT_SECONDS = 5.0
"""What was sent is removed behind its last byte, which the caller may have seen before."""

Send = Callable[[Site, str], Answer]


def _asset(own: Site, _session: str) -> Answer:
    return own.upload("/api/assets", "ball.ply", ply(*ball(200)))


def _environment(own: Site, _session: str) -> Answer:
    return own.upload("/api/environments", "noise.exr", exr(np.random.default_rng(0).random((512, 1024, 3), np.float32)))


def _made(own: Site, session: str) -> Answer:
    """An environment that is computed when it is first named."""
    names = [found["name"] for found in own.request("GET", "/api/environments").document["environments"]]
    folder = own.data / "environments"
    name = next(name for name in names if not (folder / name).exists())
    return own.send("POST", f"/api/sessions/{session}/edits", {"edit": {"op": "environment", "file": name}})


def _weights(own: Site, _session: str) -> Answer:
    return own.request("POST", "/api/weights", np.random.default_rng(0).random(2_000_000, np.float32).tobytes())


def _save(own: Site, session: str) -> Answer:
    return own.send("POST", f"/api/sessions/{session}/save", {})


def _export(own: Site, _session: str) -> Answer:
    return own.request("GET", f"/api/assets/{own.asset}/export?format=glb")


KINDS: dict[str, tuple[Send, int]] = {
    "an asset": (_asset, 201),
    "an environment": (_environment, 201),
    "an environment that is computed": (_made, 200),
    "painted weights": (_weights, 201),
    "a version": (_save, 201),
    "an export": (_export, 200),
}
"""What is sent, and what it is answered with where there is room."""


def trials() -> Iterator[Trial]:
    for title, (send, done) in KINDS.items():
        yield Trial("disk", f"{title} on a full disk is refused, and taken once there is room", partial(_refused, send, done), quick=False)
    yield Trial("disk", "edits on a full disk are refused or kept, and none is lost", _edits, quick=False)


@contextmanager
def _small_disk(site: Site) -> Iterator[tuple[Site, bool]]:
    """A server with one object of some size; and whether its data lie on a small disk of their own."""
    own = Site(Path(tempfile.mkdtemp(dir=site.folder)))
    own.data.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", f"size={DISK_BYTES},mode=0700", "tmpfs", str(own.data)]
    mounted = subprocess.run(mount, capture_output=True).returncode == 0 if shutil.which("mount") else False
    try:
        own.start()
        own.asset = own.upload("/api/assets", "ball.ply", ply(*ball(100))).document["id"]
        yield own, mounted
    finally:
        own.stop()
        if mounted:
            subprocess.run(["umount", "--lazy", str(own.data)], check=True)
        shutil.rmtree(own.folder, ignore_errors=True)


@contextmanager
def _full(own: Site, mounted: bool) -> Iterator[None]:
    assert own.process is not None
    filler, server = own.data / "filler", psutil.Process(own.process.pid)
    try:
        if mounted:
            with filler.open("wb") as file:
                file.write(bytes(shutil.disk_usage(own.data).free - LEFT_BYTES))
        else:
            server.rlimit(psutil.RLIMIT_FSIZE, (LEFT_BYTES, resource.RLIM_INFINITY))
        yield
    finally:
        filler.unlink(missing_ok=True)
        if not mounted:
            server.rlimit(psutil.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))


def _refused(send: Send, done: int, site: Site) -> str | None:
    with _small_disk(site) as (own, mounted):
        session = own.session()
        if complaint := finite_picture(own, session):
            return complaint
        with _full(own, mounted):
            answer = send(own, session)
            if complaint := own.complaint(answer, {503}) or own.is_well() or finite_picture(own, session):
                return complaint
        again = send(own, session)
        if again.status != done:
            return f"with room again it is answered {again.status}: {again.sentence[:200]}"
        end = time.monotonic() + SWEPT_SECONDS
        while drafts := [path.name for path in (own.data / "scratch").glob("*/*")]:
            if time.monotonic() > end:
                return f"{len(drafts)} drafts are left, such as {drafts[0]}"
            time.sleep(0.05)
        return None


def _edits(site: Site) -> str | None:
    with _small_disk(site) as (own, mounted):
        session, kept = own.session(), 0
        path = f"/api/sessions/{session}/edits"
        with _full(own, mounted):
            for k in range(60):
                # Each some kilobytes, so that the log outgrows what is left.
                edit = {"op": "deform", "handles": {"pin": [{"vertices": list(range(k, k + 1500))}]}}
                answer = own.send("POST", path, {"edit": edit})
                kept += answer.status == 200
                if complaint := own.complaint(answer, {200, 503}):
                    return complaint
        if kept == 60:
            return "all were kept: the disk was not full"
        edit = {"op": "material", "select": {"all": True}, "set": {"roughness": 0.5}}
        answer = own.send("POST", path, {"edit": edit})
        if answer.status != 200:
            return f"with room again an edit is answered {answer.status}: {answer.sentence[:200]}"
        own.kill()
        own.start()
        found = own.request("GET", f"/api/sessions/{session}").document["revision"]
        return None if found == kept + 1 else f"{kept + 1} edits were acknowledged, {found} are there"
