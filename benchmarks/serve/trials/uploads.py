"""Files that are sent: each is refused in a sentence, or becomes something that can be looked at, with little memory and soon."""

import json
import struct
from collections.abc import Callable, Iterator
from functools import partial

import numpy as np

from benchmarks.serve.trials.changes import finite_picture
from benchmarks.serve.trials.shapes import (
    ball,
    claiming_exr,
    claiming_png,
    exr,
    glb,
    hdr,
    hdr_of_repeats,
    obj,
    ply,
    sparse_glb,
    textured_glb,
    zipped,
)
from benchmarks.serve.trials.site import Site, Trial
from benchmarks.serve.trials.watch import MemoryWatch

PATIENCE_SECONDS = 60.0
"""For one file, however it was made."""


def _light(value: float) -> bytes:
    pixels = np.ones((8, 16, 3), np.float32)
    pixels[2, 5] = value
    return exr(pixels)


def _heap() -> bytes:
    vertices, faces = ball(3)
    return ply(vertices, np.repeat(faces, 300_000 // len(faces), axis=0))


def _far(value: float) -> bytes:
    vertices, faces = ball(4)
    vertices[0, 0] = value
    return ply(vertices, faces)


def _latin() -> bytes:
    return obj(*ball(4), head="# Gerät\no Gehäuse\n")


def _triangle_glb(**changes: object) -> bytes:
    document = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}],
        "bufferViews": [{"buffer": 0, "byteLength": 36}],
        "buffers": [{"byteLength": 36}],
    }
    return glb(document | changes, struct.pack("<9f", 0, 0, 0, 1, 0, 0, 0, 1, 0))


LIGHTS: dict[str, tuple[str, Callable[[], bytes], bool]] = {
    "texels of 1e11": ("a.exr", partial(_light, 1e11), False),
    "texels of 1e13": ("a.exr", partial(_light, 1e13), True),
    "texels of 3e38": ("a.exr", partial(_light, 3e38), False),
    "negative texels": ("a.exr", partial(_light, -1e13), False),
    "texels that are no number": ("a.exr", partial(_light, float("nan")), False),
    "texels without bounds": ("a.exr", partial(_light, float("inf")), False),
    "black": ("a.exr", lambda: exr(np.zeros((8, 16, 3), np.float32)), False),
    "texels of 1e-38": ("a.exr", lambda: exr(np.full((8, 16, 3), 1e-38, np.float32)), False),
    "a Radiance picture of 1e13": ("a.hdr", lambda: hdr(16, 8, (200, 200, 200, 171)), False),
    "a Radiance picture of the largest exponent": ("a.hdr", lambda: hdr(16, 8, (255, 255, 255, 255)), False),
    "a size that is not there": ("a.hdr", lambda: b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 8192 +X 16384\n", False),
    "a name that says another format": ("a.hdr", partial(_light, 1.0), False),
    "no picture": ("a.exr", lambda: b"\x00" * 1000, False),
    "a picture cut short": ("a.exr", lambda: _light(1.0)[:-30], False),
    "a square": ("a.exr", lambda: exr(np.ones((8, 8, 3), np.float32)), False),
    "a name in another script": ("日本 ../../x.exr", partial(_light, 1.0), False),
}
TOO_LARGE: dict[str, Callable[[], bytes]] = {
    "98 kB that claim 16384x8192": partial(hdr_of_repeats, 16384, 8192),
    "8 MB that claim 16384x8192": lambda: hdr(16384, 8192, (128, 128, 128, 129)),
    "a row more than 8192x4096": partial(hdr_of_repeats, 8194, 4097),
    "16384x8192 in another spelling": lambda: hdr_of_repeats(16384, 8192).replace(b"-Y 8192 +X 16384\n", b"-Y  8192 +X 16384 \n"),
    "16384x8192 behind a long comment": partial(claiming_exr, 16384, 8192, "x" * 70_000),
    "16384x8192 behind a comment that says otherwise": partial(claiming_exr, 16384, 8192, "dataWindow\0box2i\0\x10\0\0\0" + "\0" * 16),
}
"""Environments beyond the largest one that is taken."""
MOST_GROWTH_BYTES = 384 << 20
"""Of a refusal by size: a process that reads a header, not the picture."""
MESHES: dict[str, tuple[str, Callable[[], bytes], bool]] = {
    "sparse positions": ("a.glb", sparse_glb, True),
    "Latin-1": ("a.obj", _latin, False),
    "300 000 triangles in one place": ("a.ply", _heap, True),
    "a vertex at 1e30": ("a.ply", partial(_far, 1e30), False),
    "a vertex at 3e38": ("a.ply", partial(_far, 3e38), False),
    "a vertex that is no number": ("a.ply", partial(_far, float("nan")), False),
    "a world of 1e-20": ("a.ply", lambda: ply(ball(4)[0] * np.float32(1e-20), ball(4)[1]), False),
    "one point": ("a.ply", lambda: ply(ball(4)[0] * 0, ball(4)[1]), False),
    "a flat sheet": ("a.ply", lambda: ply(ball(4)[0] * np.array([1, 1, 0], np.float32), ball(4)[1]), False),
    "a needle": ("a.ply", lambda: ply(ball(4)[0] * np.array([0, 0, 1], np.float32), ball(4)[1]), False),
    "one triangle": ("a.glb", _triangle_glb, False),
    "a triangle fan": ("a.glb", lambda: _triangle_glb(meshes=[{"primitives": [{"attributes": {"POSITION": 0}, "mode": 6}]}]), False),
    "points": ("a.glb", lambda: _triangle_glb(meshes=[{"primitives": [{"attributes": {"POSITION": 0}, "mode": 0}]}]), False),
    "a node of itself": ("a.glb", lambda: _triangle_glb(nodes=[{"mesh": 0, "children": [0]}]), False),
    "a million instances": ("a.glb", lambda: _triangle_glb(nodes=[{"mesh": 0}] * 20_000, scenes=[{"nodes": list(range(20_000))}]), False),
    "a matrix of nothing": ("a.glb", lambda: _triangle_glb(nodes=[{"mesh": 0, "matrix": [0] * 16}]), False),
    "a scale of 1e300": ("a.glb", lambda: _triangle_glb(nodes=[{"mesh": 0, "scale": [1e300] * 3}]), False),
    "a count of 400 digits": (
        "a.glb", lambda: _triangle_glb(accessors=[{"bufferView": 0, "componentType": 5126, "count": 10**400, "type": "VEC3"}]), False,
    ),
    "a file elsewhere": ("a.glb", lambda: _triangle_glb(buffers=[{"byteLength": 36, "uri": "file:///etc/passwd"}]), False),
    "a texture of 169 megapixels": ("a.glb", lambda: textured_glb(claiming_png(13_000)), False),
    "a texture of 67 megapixels": ("a.glb", lambda: textured_glb(claiming_png(8192)), False),
    "a texture that is none": ("a.glb", lambda: textured_glb(b"<svg/>"), False),
    "nodes in a circle": ("a.glb", lambda: _triangle_glb(nodes=[{"children": [1]}, {"children": [0], "mesh": 0}]), False),
    "corners of an OBJ from 0": ("a.obj", lambda: b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 0 1 2\n", False),
    "deep JSON": ("a.glb", lambda: b"glTF" + struct.pack("<4I", 2, 20 + 200_000, 200_000, 0x4E4F534A) + b"[" * 200_000, False),
    "an OBJ of one line": ("a.obj", lambda: b"f 1 2 3 " * 500_000, False),
    "an OBJ without corners": ("a.obj", lambda: b"v 0 0 0\nf 1 1 1\n", False),
    "an OBJ with a library elsewhere": ("a.obj", lambda: obj(*ball(4), head="mtllib /etc/passwd\n"), False),
    "a bomb": ("a.zip", lambda: zipped({"asset.json": b"{}", "mesh.glb": bytes(500_000_000)}), False),
    "a way out": ("a.zip", lambda: zipped({"../../token": b"x", "asset.json": b"{}"}), False),
    "50 000 entries": ("a.zip", lambda: zipped({f"{k}": b"" for k in range(50_000)}), False),
    "an asset of infinities": ("a.zip", lambda: zipped({"asset.json": json.dumps({"schema_version": 1, "files": {}, "meters_per_unit": 1e999}).encode()}), False),
    "no suffix": ("a", _latin, False),
    "a program": ("a.exe", _latin, False),
}  # fmt: skip


def trials() -> Iterator[Trial]:
    for title, (name, make, quick) in LIGHTS.items():
        yield Trial("lights", title, partial(_environment, name, make), quick)
    for title, make_large in TOO_LARGE.items():
        yield Trial("lights", f"{title} are refused at the door", partial(_too_large, make_large))
    for title, (name, make, quick) in MESHES.items():
        yield Trial("meshes", title, partial(_mesh, name, make), quick)
    for path in ("/api/assets", "/api/environments", "/api/jobs"):
        for title, body, kind in (
            ("no part", b"", "multipart/form-data; boundary=x"),
            ("no boundary", b"--x--", "multipart/form-data"),
            (
                "an open part",
                b'--x\r\nContent-Disposition: form-data; name="file"; filename="a.ply"\r\n\r\n',
                "multipart/form-data; boundary=x",
            ),
            (
                "many fields",
                b"".join(b'--x\r\nContent-Disposition: form-data; name="f"\r\n\r\n1\r\n' for _ in range(2000)) + b"--x--",
                "multipart/form-data; boundary=x",
            ),
            (
                "a long field",
                b'--x\r\nContent-Disposition: form-data; name="name"\r\n\r\n' + b"y" * 3_000_000 + b"\r\n--x--",
                "multipart/form-data; boundary=x",
            ),
            ("another encoding", b"\x1f\x8b" + b"\0" * 100, "application/gzip"),
        ):
            yield Trial("uploads", f"{path}: {title}", partial(_broken_body, path, body, kind))


def _soon(seconds: float) -> str | None:
    return None if seconds <= PATIENCE_SECONDS else f"it took {seconds:.0f} s"


def _environment(name: str, make: Callable[[], bytes], site: Site) -> str | None:
    answer = site.upload("/api/environments", name, make())
    if answer.status != 201:
        return site.complaint(answer) or _soon(answer.seconds)
    session = site.session()
    edit = {"op": "environment", "file": answer.document["name"]}
    changed = site.send("POST", f"/api/sessions/{session}/edits", {"edit": edit})
    if changed.status != 200:
        return f"it was taken, but an edit that names it is answered {changed.status}: {changed.sentence[:200]}"
    return finite_picture(site, session, "width=24&height=24&spp=8&bounces=1") or _soon(answer.seconds)


def _too_large(make: Callable[[], bytes], site: Site) -> str | None:
    """By the header alone: with its largest size in the sentence, soon, and without the memory that the picture would take."""
    assert site.process is not None
    data = make()
    watch = MemoryWatch(site.process.pid)
    before = watch.now()
    answer = site.upload("/api/environments", "large.hdr" if data[:2] == b"#?" else "large.exr", data)
    watch.stop()
    if complaint := site.complaint(answer, {422}):
        return complaint
    if "8192" not in answer.sentence:
        return f"the sentence does not say how large one may be: {answer.sentence[:200]}"
    grown = watch.peak_bytes - before
    return f"memory grew by {grown >> 20} MiB" if grown > MOST_GROWTH_BYTES else _soon(answer.seconds)


def _mesh(name: str, make: Callable[[], bytes], site: Site) -> str | None:
    answer = site.upload("/api/assets", name, make(), seconds=400)
    if answer.status != 201:
        return site.complaint(answer) or _soon(answer.seconds)
    return finite_picture(site, site.session(answer.document["id"])) or _soon(answer.seconds)


def _broken_body(path: str, body: bytes, kind: str, site: Site) -> str | None:
    return site.complaint(site.request("POST", path, body, {"Content-Type": kind}))
