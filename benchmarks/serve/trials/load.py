"""Too much at once: stills, exports, files, simulations, and callers that do not wait for what they asked for."""

import http.client
import json
import socket
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import partial

from benchmarks.serve.trials.changes import finite_picture
from benchmarks.serve.trials.shapes import hdr
from benchmarks.serve.trials.site import Answer, Site, Trial
from benchmarks.serve.trials.watch import MemoryWatch

MOST_BYTES = 3 << 30
"""Of the server and all that it started."""
MOST_PROCESSES = 8
PATIENCE_SECONDS = 1800.0


def trials() -> Iterator[Trial]:
    yield Trial("load", "16 stills of 256x256 at once", partial(_stills, 16, 256, 256, 4))
    yield Trial("load", "16 stills of 512x512 at once", partial(_stills, 16, 512, 512, 4), quick=False)
    yield Trial("load", "24 stills of 1024x1024 at once", partial(_stills, 24, 1024, 1024, 4), quick=False)
    yield Trial("load", "200 stills of 4096x2160 at once", partial(_stills, 200, 4096, 2160, 1), quick=False)
    yield Trial("load", "200 stills of 256x256 at once", partial(_stills, 200, 256, 256, 32), quick=False)
    yield Trial("load", "10 stills whose askers left", partial(_abandoned, 10, 1024), quick=False)
    yield Trial("load", "20 large stills whose askers left", partial(_abandoned, 20, 2048), quick=False)
    yield Trial("load", "12 exports at once", partial(_exports, 12), quick=False)
    yield Trial("load", "12 files at once", partial(_files, 12), quick=False)
    yield Trial("load", "6 files of 16384x8192 at once are refused", _large_files, quick=False)
    yield Trial("load", "long simulations in four sessions leave room for a fifth", _simulations, quick=False)


def _at_once(count: int, call: Callable[[int], Answer]) -> list[Answer | Exception]:
    def one(k: int) -> Answer | Exception:
        try:
            return call(k)
        except (OSError, http.client.HTTPException) as error:
            return error

    with ThreadPoolExecutor(count) as pool:
        return list(pool.map(one, range(count)))


def _judge(site: Site, watch: MemoryWatch, answers: list[Answer | Exception], wanted: int) -> str | None:
    """All are done, or sent away with a word on when to come back; within memory."""
    watch.stop()
    statuses = Counter(answer.status if isinstance(answer, Answer) else type(answer).__name__ for answer in answers)
    for answer in answers:
        if isinstance(answer, Exception):
            return f"{dict(statuses)}: {answer}"
        if complaint := site.complaint(answer, {wanted, 429, 503}):
            return f"{dict(statuses)}: {complaint}"
    if wanted not in statuses:
        return f"none was done: {dict(statuses)}"
    if watch.peak_bytes > MOST_BYTES:
        return f"{watch.peak_bytes / 2**30:.1f} GiB at the peak, {dict(statuses)}"
    if watch.peak_processes > MOST_PROCESSES:
        return f"{watch.peak_processes} processes at once"
    return site.is_well()


def _watch(site: Site) -> MemoryWatch:
    assert site.process is not None
    return MemoryWatch(site.process.pid)


def _stills(count: int, width: int, height: int, spp: int, site: Site) -> str | None:
    session, watch = site.session(), _watch(site)
    query = f"width={width}&height={height}&spp={spp}&bounces=0"
    answers = _at_once(count, lambda _: site.request("GET", f"/api/sessions/{session}/frame.jpg?{query}", seconds=PATIENCE_SECONDS))
    return _judge(site, watch, answers, 200)


def _abandoned(count: int, side: int, site: Site) -> str | None:
    """A small picture must not wait for pictures that nobody will see."""
    session = site.session()
    if complaint := finite_picture(site, session):
        return complaint
    request = (
        f"GET /api/sessions/{session}/frame.jpg?width={side}&height={side}&spp=64 HTTP/1.1\r\nHost: localhost\r\n"
        f"Authorization: Bearer {site.token}\r\n\r\n"
    )
    sockets = [socket.create_connection(("127.0.0.1", site.port), timeout=10) for _ in range(count)]
    for connection in sockets:
        connection.sendall(request.encode())
    time.sleep(1.0)
    for connection in sockets:
        connection.close()
    start = time.monotonic()
    answer = site.request("GET", f"/api/sessions/{session}/frame.jpg?width=32&height=32&spp=1", seconds=PATIENCE_SECONDS)
    seconds = time.monotonic() - start
    if answer.status != 200:
        return f"a small picture is answered {answer.status}: {answer.sentence[:200]}"
    return None if seconds < 15 else f"a small picture waited {seconds:.0f} s behind those that nobody waits for"


def _exports(count: int, site: Site) -> str | None:
    watch = _watch(site)
    answers = _at_once(count, lambda _: site.request("GET", f"/api/assets/{site.asset}/export?format=glb", seconds=PATIENCE_SECONDS))
    return _judge(site, watch, answers, 200)


def _files(count: int, site: Site) -> str | None:
    watch = _watch(site)
    answers = _at_once(count, lambda k: site.upload("/api/assets", f"{k}.obj", site.mesh, seconds=PATIENCE_SECONDS))
    return _judge(site, watch, answers, 201)


def _large_files(site: Site) -> str | None:
    data, watch = hdr(16384, 8192, (128, 128, 128, 129)), _watch(site)
    answers = _at_once(6, lambda k: site.upload("/api/environments", f"large{k}.hdr", data, seconds=PATIENCE_SECONDS))
    return _judge(site, watch, answers, 422)


def _simulations(site: Site) -> str | None:
    sessions = [site.session() for _ in range(5)]
    edit = {"op": "simulate", "scene": {"matter": {"preset": "rubber"}, "particles": 100_000, "duration": 20}, "time": 20}

    def simulate(session: str) -> None:
        with suppress(OSError, http.client.HTTPException):  # it is not waited for
            site.send("POST", f"/api/sessions/{session}/edits", {"edit": edit}, seconds=25)

    threads = [threading.Thread(target=simulate, args=(session,), daemon=True) for session in sessions[:4]]
    for thread in threads:
        thread.start()
    time.sleep(2)
    start = time.monotonic()
    simple = {"op": "material", "select": {"all": True}, "set": {"roughness": 0.3}}
    try:
        answer = site.send("POST", f"/api/sessions/{sessions[4]}/edits", {"edit": simple}, seconds=20)
    except (OSError, http.client.HTTPException) as error:
        return f"another session's edit got no answer in {time.monotonic() - start:.0f} s ({error})"
    finally:
        for thread in threads:
            thread.join()
    if answer.status != 200:
        return f"another session's edit is answered {answer.status}: {json.dumps(answer.sentence)[:200]}"
    time.sleep(15)  # those that left are let go by then
    return finite_picture(site, sessions[4])
