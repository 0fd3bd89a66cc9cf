"""What comes over a stream of frames: messages that are none, viewers that do not read, logs that are long."""

import json
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial

from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect

from benchmarks.serve.trials.site import LONGEST_SENTENCE, Site, Trial
from benchmarks.serve.trials.watch import MemoryWatch

VIEW = [[1, 0, 0, 0], [0, 0, -1, -4], [0, 1, 0, 0], [0, 0, 0, 1]]
CAMERA = {"type": "camera", "number": 1, "world_from_camera": VIEW, "fov_y_degrees": 40, "width": 32, "height": 32}
FIRST: dict[str, str | bytes] = {
    "nothing": "", "junk": "junk", "a brace": "{", "null": "null", "binary": b"\x00\x01", "another version": '{"type": "hello", "v": 2}',
    "a camera": json.dumps(CAMERA), "a version of words": '{"type": "hello", "v": "one"}', "a long name": '{"type": "hello", "v": 1, "client": "' + "x" * 500 + '"}',
    "brackets without end": "[" * 100_000, "2 MB": '{"type": "' + "x" * 2_000_000 + '"}', "a codec that is none": '{"type": "hello", "v": 1, "codecs": ["bmp"]}',
}  # fmt: skip
BAD: dict[str, str | bytes] = {
    "nothing": "", "junk": "junk", "a list": "[]", "binary": b"\xff" * 100, "no type": "{}", "an unknown type": '{"type": "explode"}',
    "a long type": '{"type": "' + "x" * 900_000 + '"}', "brackets": "[" * 100_000, "a hello again": '{"type": "hello", "v": 1}',
    "a camera of infinity": json.dumps(CAMERA).replace("-4", "Infinity"), "a camera of 400 digits": json.dumps(CAMERA).replace("-4", "1" + "0" * 400),
    "a camera that scales": json.dumps(CAMERA | {"world_from_camera": [[2, 0, 0, 0], [0, 2, 0, 0], [0, 0, 2, 0], [0, 0, 0, 1]]}),
    "a camera that mirrors": json.dumps(CAMERA | {"world_from_camera": [[-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}),
    "a camera far away": json.dumps(CAMERA | {"world_from_camera": [[1, 0, 0, 1e300], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}),
    "a picture of nothing": json.dumps(CAMERA | {"width": 0}), "a picture of 4096x4096": json.dumps(CAMERA | {"width": 4096, "height": 4096}),
    "a number of -1": json.dumps(CAMERA | {"number": -1}), "a number of 2**32": json.dumps(CAMERA | {"number": 2**32}),
    "an ack of words": '{"type": "ack", "frame_id": "x"}', "a pick outside": '{"type": "pick", "id": 1, "x": 2, "y": 0}',
    "a setting that is none": '{"type": "settings", "settings": {"channel": "all"}}', "an exposure of 1e9": '{"type": "settings", "settings": {"exposure_stops": 1e9}}',
    "an edit without an id": '{"type": "edit", "edit": {"op": "environment"}}', "an edit of nothing": '{"type": "edit", "id": 1, "edit": null}',
    "a long key": json.dumps({"type": "undo", "id": 1, "key": "x" * 1000}), "half a character": '{"type": "undo", "id": 1, "key": "\\ud800"}',
}  # fmt: skip
REJECTED: dict[str, dict] = {
    "an undo of nothing": {"type": "undo", "id": 7},
    "a redo of nothing": {"type": "redo", "id": 7},
    "a splice of another revision": {"type": "splice", "id": 7, "revision": 4_000_000, "start": 0, "remove": 0, "edits": []},
    "a splice beyond the end": {"type": "splice", "id": 7, "revision": 0, "start": 5, "remove": 5, "edits": []},
    "a light that is none": {"type": "edit", "id": 7, "edit": {"op": "environment", "file": "none.exr"}},
    "a clip that is none": {"type": "edit", "id": 7, "edit": {"op": "pose", "clip": "clips/" + "0" * 32, "time": 0}},
    "a region that is none": {"type": "edit", "id": 7, "edit": {"op": "material", "select": {"region": 999_999}, "set": {"roughness": 1}}},
}
STALLED_CHANGES, STALLED_EDITS = 200, 1000
STALLED_BYTES = 150 << 20


def trials() -> Iterator[Trial]:
    for title, message in FIRST.items():
        yield Trial("streams", f"first message: {title}", partial(_first, message))
    for title, message in BAD.items():
        yield Trial("streams", title, partial(_bad, message))
    for title, document in REJECTED.items():
        yield Trial("streams", f"{title} is rejected", partial(_rejected, document))
    yield Trial("streams", "a session that is none", _no_session)
    yield Trial("streams", "text that is none", _no_text)
    yield Trial("streams", "messages without end are not taken", _many_bad)
    yield Trial("streams", "a viewer that never reads costs little memory", _stalled)
    yield Trial("streams", "viewers that vanish are forgotten", _vanished)


@contextmanager
def opened(site: Site, session: str, hello: bool = True) -> Iterator[ClientConnection]:
    """A stream, with its hello said and answered."""
    address = f"ws://127.0.0.1:{site.port}/api/sessions/{session}/stream"
    headers = {"Authorization": f"Bearer {site.token}"}
    with connect(address, additional_headers=headers, compression=None, max_size=1 << 26, open_timeout=30, close_timeout=5) as socket:
        if hello:
            socket.send('{"type": "hello", "v": 1, "client": "abuse"}')
            until(socket, "hello")
        yield socket


def until(socket: ClientConnection, *kinds: str, seconds: float = 30.0) -> dict:
    """The next message of one of these types.

    Raises:
        TimeoutError, ConnectionClosed: it does not come.
    """
    end = time.monotonic() + seconds
    while True:
        said = socket.recv(timeout=max(0.0, end - time.monotonic()))
        if isinstance(said, str) and (document := json.loads(said))["type"] in kinds:
            return document


def _sentence(site: Site, text: str) -> str | None:
    if len(text) > LONGEST_SENTENCE:
        return f"the sentence has {len(text)} characters"
    return f"the sentence shows the server's inside: {text[:200]}" if str(site.folder) in text or "Traceback" in text else None


def _first(message: str | bytes, site: Site) -> str | None:
    try:
        with opened(site, site.session(), hello=False) as socket:
            socket.send(message)
            while True:
                said = socket.recv(timeout=30)
                if isinstance(said, str) and json.loads(said)["type"] == "error":
                    return _sentence(site, json.loads(said)["message"]) or site.is_well()
                if isinstance(said, str) and json.loads(said)["type"] == "hello":
                    return "it was taken for a greeting"
    except ConnectionClosed:
        return site.is_well()
    except TimeoutError:
        return "neither an answer nor an end within 30 s"


def _bad(message: str | bytes, site: Site) -> str | None:
    try:
        with opened(site, site.session()) as socket:
            socket.send(message)
            said = until(socket, "error", "rejected", seconds=20)
            complaint = _sentence(site, said.get("message") or said.get("reason", ""))
            socket.send(json.dumps(CAMERA))
            while not isinstance(socket.recv(timeout=20), bytes):  # the stream goes on
                pass
            return complaint
    except ConnectionClosed as error:
        return f"the stream ended ({error})"
    except TimeoutError:
        return "no answer within 20 s"


def _rejected(document: dict, site: Site) -> str | None:
    with opened(site, site.session()) as socket:
        socket.send(json.dumps(document))
        said = until(socket, "rejected", "accepted")
        return _sentence(site, said["reason"]) if said["type"] == "rejected" else "it was accepted"


def _no_session(site: Site) -> str | None:
    try:
        with opened(site, "0" * 32, hello=False) as socket:
            socket.send('{"type": "hello", "v": 1}')
            return _sentence(site, until(socket, "error")["message"])
    except (ConnectionClosed, InvalidStatus):
        return None


def _no_text(site: Site) -> str | None:
    """The stream is closed, and said so; the log is looked through in the end."""
    with opened(site, site.session()) as socket:
        socket.send(b"\xff\xfe", text=True)
        try:
            while True:
                socket.recv(timeout=20)
        except ConnectionClosed:
            return site.is_well() if socket.protocol.close_code == 1007 else f"it was closed with {socket.protocol.close_code}"
        except TimeoutError:
            return "the stream is still open"


def _many_bad(site: Site) -> str | None:
    with opened(site, site.session()) as socket:
        try:
            for _ in range(5000):
                socket.send("junk")
            while True:
                socket.recv(timeout=20)
        except ConnectionClosed:
            return site.is_well()
        except TimeoutError:
            return "the stream is still open after 5000 messages that are none"


def _edit(k: int) -> dict:
    return {"op": "material", "select": {"all": True}, "set": {"roughness": 0.1 + 0.8 * (k % 10) / 10}}


def _stalled(site: Site) -> str | None:
    assert site.process is not None
    session = site.session()
    put = site.send("PUT", f"/api/sessions/{session}/edits", {"edits": [_edit(k) for k in range(STALLED_EDITS)]})
    if put.status != 200:
        return f"a log of {STALLED_EDITS} edits is answered {put.status}: {put.sentence[:200]}"
    watch = MemoryWatch(site.process.pid)
    try:
        with opened(site, session) as socket:
            socket.send(json.dumps(CAMERA))
            before = watch.now()
            # From here on nothing is read but by the library, which stops after a few messages.
            for k in range(STALLED_CHANGES):
                answer = site.send("POST", f"/api/sessions/{session}/edits", {"edit": _edit(k)})
                if answer.status != 200:
                    return f"a change is answered {answer.status}: {answer.sentence[:200]}"
            grown = watch.now() - before
    except ConnectionClosed:
        return site.is_well()  # it was let go
    finally:
        watch.stop()
    return None if grown < STALLED_BYTES else f"{STALLED_CHANGES} changes of a log of {STALLED_EDITS} edits added {grown >> 20} MiB"


def _vanished(site: Site) -> str | None:
    session = site.session()
    for _ in range(5):
        with opened(site, session) as socket:
            socket.send(json.dumps(CAMERA))
            socket.socket.close()  # without a word
    end = time.monotonic() + 30
    while time.monotonic() < end:
        viewers = site.request("GET", f"/api/sessions/{session}").document["viewers"]
        if viewers == 0:
            return None
        time.sleep(0.2)
    return f"{viewers} viewers are counted 30 s after the last one went"
