"""Painted weights as files: sent by those who may, refused in a sentence where they are none, and named by edits before and after they came."""

import hashlib
import http.client
import json
from collections.abc import Callable, Iterator
from functools import partial

import numpy as np

from benchmarks.serve.trials.changes import finite_picture
from benchmarks.serve.trials.site import Answer, Site, Trial

BODY_BYTES = 16 << 20
"""Of a body that is no upload."""

WRONG: dict[str, Callable[[], bytes]] = {
    "nothing": lambda: b"",
    "three bytes": lambda: b"abc",
    "half a number": lambda: np.ones(5, "<f4").tobytes()[:-2],
    "no numbers": lambda: np.full(4, np.nan, "<f4").tobytes(),
    "infinities": lambda: np.full(4, np.inf, "<f4").tobytes(),
    "below 0": lambda: np.array([0, -1e-3], "<f4").tobytes(),
    "above 1": lambda: np.array([0, 1.001], "<f4").tobytes(),
    "numbers of 64 bits": lambda: np.full(81, 0.5).tobytes(),
    "numbers of the other byte order": lambda: np.linspace(0, 1, 81).astype(">f4").tobytes(),
    "whole numbers": lambda: np.arange(100, 181, dtype="<i4").tobytes() + np.array([2], "<f4").tobytes(),
    "JSON": lambda: json.dumps([0.5] * 8).encode(),
    "a picture": lambda: b"\x89PNG\r\n\x1a\n" + bytes(range(200, 256)) * 4,
}
UNKNOWN = (
    f"weights/{'0' * 32}.f32", f"weights/{'g' * 32}.f32", f"weights/{'0' * 32}.f32/../x", "weights/../../token", "../weights/x.f32",
    "/etc/passwd", "weights/", "", "studio.exr", f"weights\\{'0' * 32}.f32", "weights/" + "0" * 300, f"weights/{'0' * 32}.f32\x00",
)  # fmt: skip


def trials() -> Iterator[Trial]:
    yield Trial("weights", "right ones are taken, read back and painted with", _right)
    yield Trial("weights", "the same ones twice are one file", _twice)
    for title, token in (("no token", ""), ("a foreign token", "f" * 64), ("half a token", "{half}")):
        yield Trial("weights", f"{title} is refused", partial(_foreign, token))
    for title, make in WRONG.items():
        yield Trial("weights", f"{title} are refused", partial(_wrong, make))
    yield Trial("weights", "a byte more than a body may have", partial(_large, 4), quick=False)
    yield Trial("weights", "a body of 64 MiB", partial(_large, 48 << 20), quick=False)
    yield Trial("weights", "as large as a body may be", _largest, quick=False)
    yield Trial("weights", "an edit that names them before they came", _named_first)
    yield Trial("weights", "an edit that names those of another mesh", _other_mesh)
    for number, name in enumerate(UNKNOWN):
        yield Trial("weights", f"unknown name {number}, {name[:20]!r}", partial(_unknown, name))
    for name in ("0" * 32, "..%2f..%2ftoken", "%00", "x" * 3000):
        yield Trial("weights", f"reading {name[:20]!r}", partial(_read_unknown, name))


def _send(site: Site, data: bytes, **options: object) -> Answer:
    return site.request("POST", "/api/weights", data, {"Content-Type": "application/octet-stream"}, **options)  # type: ignore[arg-type]


def _painted(site: Site, seed: int) -> bytes:
    """For each vertex of the object that every trial may use."""
    vertices = site.request("GET", f"/api/assets/{site.asset}").document["vertex_count"]
    return np.random.default_rng(seed).random(vertices, np.float32).tobytes()


def _edit(file: str) -> dict:
    return {"edit": {"op": "material", "select": {"weights_file": file}, "set": {"roughness": 0.2}}}


def _right(site: Site) -> str | None:
    data = _painted(site, 0)
    sent = _send(site, data)
    if sent.status != 201:
        return f"they are answered {sent.status}: {sent.sentence[:200]}"
    file = sent.document["file"]
    if site.request("GET", f"/api/{file}").body != data:
        return "what is read back is something else"
    session = site.session()
    for _ in range(3):
        answer = site.send("POST", f"/api/sessions/{session}/edits", _edit(file))
        if answer.status != 200:
            return f"an edit that names them is answered {answer.status}: {answer.sentence[:200]}"
    return finite_picture(site, session)


def _twice(site: Site) -> str | None:
    first, second = _send(site, _painted(site, 1)), _send(site, _painted(site, 1))
    if (first.status, second.status) != (201, 201):
        return f"they are answered {first.status} and {second.status}"
    return None if first.document == second.document else f"{first.document} and {second.document}"


def _foreign(token: str, site: Site) -> str | None:
    filled = token.format(half=site.token[: len(site.token) // 2])
    header = {"Authorization": f"Bearer {filled}"} if token else {}
    return site.complaint(site.request("POST", "/api/weights", np.ones(4, "<f4").tobytes(), header, bearer=False), {401, 429})


def _wrong(make: Callable[[], bytes], site: Site) -> str | None:
    return site.complaint(_send(site, make()), {415, 422})


def _large(more: int, site: Site) -> str | None:
    try:
        answer = _send(site, bytes(BODY_BYTES + more))
    except (OSError, http.client.HTTPException):  # refused before all was sent
        return site.is_well()
    if "json" not in answer.headers.get("content-type", ""):
        return f"it is answered {answer.status} without a problem: {answer.body[:100]!r}"
    return site.complaint(answer, {413})


def _largest(site: Site) -> str | None:
    sent = _send(site, bytes(BODY_BYTES))
    return None if sent.status == 201 else f"they are answered {sent.status}: {sent.sentence[:200]}"


def _named_first(site: Site) -> str | None:
    """Refused, and the log as before; the same edit is taken once they are there."""
    data, session = _painted(site, 2), site.session()
    file, path = f"weights/{hashlib.sha256(data).hexdigest()[:32]}.f32", f"/api/sessions/{session}/edits"
    if complaint := site.complaint(site.send("POST", path, _edit(file)), {422}):
        return complaint
    if (sent := _send(site, data)).status != 201 or sent.document["file"] != file:
        return f"they are answered {sent.status}: {sent.sentence[:200]}"
    answer = site.send("POST", path, _edit(file))
    if answer.status != 200 or answer.document["revision"] != 1:
        return f"the edit is then answered {answer.status}: {answer.sentence[:200]}"
    return finite_picture(site, session)


def _other_mesh(site: Site) -> str | None:
    sent, session = _send(site, np.ones(5, "<f4").tobytes()), site.session()
    if sent.status != 201:
        return f"they are answered {sent.status}: {sent.sentence[:200]}"
    answer = site.send("POST", f"/api/sessions/{session}/edits", _edit(sent.document["file"]))
    return site.complaint(answer, {422}) or finite_picture(site, session)


def _unknown(name: str, site: Site) -> str | None:
    return site.complaint(site.send("POST", f"/api/sessions/{site.session()}/edits", _edit(name)), {422})


def _read_unknown(name: str, site: Site) -> str | None:
    return site.complaint(site.request("GET", f"/api/weights/{name}"), {400, 404, 414, 422})
