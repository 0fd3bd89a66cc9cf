"""Files made to harm: each is refused with a sentence, soon, with little memory, and leaves nothing on disk.

Assets, meshes and environments go through the file tool as an upload does; it runs in this process here, since forty starts of an
interpreter would take minutes, and its limit of address space is tested once in a process of its own. Archives are in test_zip_guard.py.
"""

import io
import json
import pickle
import resource
import struct
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from drgs_worker.jobs import file_tool
from tests.patience import PATIENCE_SECONDS

MOST_BYTES = 1 << 30
"""Resident memory that refusing one file may add."""


class Evil:
    def __reduce__(self) -> tuple:
        return (print, ("unpickled",))


PICKLE = pickle.dumps(Evil(), protocol=4)


def exr(
    width: int = 4,
    height: int = 2,
    window: tuple[int, int, int, int] | None = None,
    value: float = 1.0,
    keys: str = "RGB",
    comment: str = "",
) -> bytes:
    stream = io.BytesIO()
    channels = {key: np.full((height, width), value, np.float32) for key in keys}
    OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, "a comment": comment}, channels).write(stream)
    data = bytearray(stream.getvalue())
    if window is not None:
        for name in (b"dataWindow\0box2i\0", b"displayWindow\0box2i\0"):
            at = data.rindex(name) + len(name) + 4
            struct.pack_into("<4i", data, at, *window)
    return bytes(data)


def hdr(first: bytes = b"-Y 2 +X 4\n", body: bytes = b"\1\1\1\x81" * 8) -> bytes:
    return b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n" + first + body


def ply(vertices: int, faces: int = 0, body: bytes = b"", form: str = "binary_little_endian", more: str = "") -> bytes:
    head = f"ply\nformat {form} 1.0\nelement vertex {vertices}\nproperty float x\nproperty float y\nproperty float z\n{more}"
    head += f"element face {faces}\nproperty list uchar int vertex_indices\nend_header\n"
    return head.encode() + body


def triangle(a: tuple = (0.0, 0.0, 0.0), indices: tuple = (0, 1, 2)) -> bytes:
    corners = struct.pack("<9f", *a, 1, 0, 0, 0, 1, 0)
    return ply(3, 1, corners + struct.pack(f"<B{len(indices)}i", len(indices), *indices))


def glb(document: object, binary: bytes = b"", declared: int | None = None) -> bytes:
    text = document if isinstance(document, bytes) else json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    binary += b"\0" * (-len(binary) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    chunks += struct.pack("<I4s", len(binary), b"BIN\0") + binary if binary else b""
    return struct.pack("<4sII", b"glTF", 2, declared if declared is not None else 12 + len(chunks)) + chunks


def mesh_gltf(count: int = 3, offset: int = 0, uri: str | None = None, index: int | None = None, component: int = 5126) -> dict:
    buffers = [{"byteLength": 48} | ({"uri": uri} if uri else {})]
    document: dict = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "accessors": [{"bufferView": 0, "componentType": component, "count": count, "type": "VEC3", "byteOffset": offset}],
        "bufferViews": [{"buffer": 0, "byteLength": 36, "byteOffset": 0}],
        "buffers": buffers,
    }
    if index is not None:
        document["accessors"].append({"bufferView": 1, "componentType": 5125, "count": 3, "type": "SCALAR"})
        document["bufferViews"].append({"buffer": 0, "byteLength": 12, "byteOffset": 36})
        document["meshes"][0]["primitives"][0]["indices"] = 1
    return document


CORNERS = struct.pack("<9f", 0, 0, 0, 1, 0, 0, 0, 1, 0)


def zipped(entries: dict[str, bytes], method: int = zipfile.ZIP_DEFLATED) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", method) as archive:
        for name, data in entries.items():
            archive.writestr(name, data)
    return stream.getvalue()


def manifest(**changes: object) -> bytes:
    return json.dumps({"format": "drgs asset", "schema_version": 1, "counts": {}, "files": {}} | changes).encode()


ENVIRONMENTS: dict[str, bytes] = {
    "nothing.exr": b"",
    "a pickle.exr": PICKLE,
    "a zip.exr": zipped({"a": b"1"}),
    "magic alone.exr": b"\x76\x2f\x31\x01",
    "truncated header.exr": exr()[:60],
    "truncated pixels.exr": exr(64, 32)[:-40],
    "a window of a million squared.exr": exr(window=(0, 0, 999_999, 999_999)),
    "a window turned inside out.exr": exr(window=(10, 10, 0, 0)),
    "a window at the end of the numbers.exr": exr(window=(-(2**31), -(2**31), 2**31 - 1, 2**31 - 1)),
    "not a number.exr": exr(value=float("nan")),
    "infinite.exr": exr(value=float("inf")),
    "square.exr": exr(4, 4),
    "nothing.hdr": b"",
    "a pickle.hdr": PICKLE,
    "a million squared.hdr": hdr(b"-Y 1000000 +X 2000000\n", b""),
    "no size.hdr": hdr(b"\n"),
    "negative size.hdr": hdr(b"-Y -2 +X 4\n"),
    "truncated.hdr": hdr(body=b"\1\1"),
    "sixteen thousand in twelve bytes a row.hdr": hdr(b"-Y 8192 +X 16384\n", b"\12\24\36\200\1\1\1\377\1\1\1\77" * 8192),
    "larger than a service takes.hdr": hdr(b"-Y 5000 +X 10000\n", bytes(1 << 20)),
    "a run longer than its row.hdr": hdr(b"-Y 8 +X 16\n", b"\2\2\0\x10" + b"\xff\1" * 400),
}
LARGE: dict[str, bytes] = {
    "plain.hdr": hdr(b"-Y 5000 +X 10000\n", bytes(1 << 20)),
    "with more blanks.hdr": hdr(b"-Y  5000   +X 10000 \n", bytes(1 << 20)),
    "plain.exr": exr(window=(0, 0, 9999, 4999)) + bytes(1 << 20),
    "behind a long comment.exr": exr(window=(0, 0, 9999, 4999), comment="x" * 70_000) + bytes(1 << 20),
    "behind a comment that says otherwise.exr": exr(window=(0, 0, 9999, 4999), comment="dataWindow\0box2i\0\x10\0\0\0" + "\0" * 16)
    + bytes(1 << 20),
    "in five channels.exr": exr(window=(0, 0, 8191, 4095), keys="RGBAZ") + bytes(1 << 20),
}
"""Environments beyond the largest one that a service takes, which other doors read."""
MESHES: dict[str, bytes] = {
    "nothing.ply": b"",
    "a pickle.ply": PICKLE,
    "a billion vertices.ply": ply(1_000_000_000, 1),
    "a billion faces.ply": ply(3, 1_000_000_000, CORNERS),
    "a billion written out.ply": ply(1_000_000_000, 1, b"0 0 0\n", "ascii"),
    "negative count.ply": ply(-5, 1),
    "endless header.ply": b"ply\nformat ascii 1.0\n" + b"comment x\n" * 200_000,
    "a thousand properties.ply": ply(1, 0, b"", more="".join(f"property float p{k}\n" for k in range(1000))),
    "truncated.ply": triangle()[:-3],
    "not a number.ply": triangle((float("nan"), 0.0, 0.0)),
    "index out of range.ply": triangle(indices=(0, 1, 3)),
    "negative index.ply": triangle(indices=(0, 1, -1)),
    "no faces.ply": ply(3, 0, CORNERS),
    "nothing.glb": b"",
    "a pickle.glb": PICKLE,
    "truncated.glb": glb(mesh_gltf(), CORNERS)[:-20],
    "no json.glb": glb(b"{", CORNERS),
    "deep json.glb": glb(b"[" * 100_000 + b"]" * 100_000),
    "a file elsewhere.glb": glb(mesh_gltf(uri="file:///etc/passwd")),
    "a file beside it.glb": glb(mesh_gltf(uri="../secret.bin")),
    "a url.glb": glb(mesh_gltf(uri="http://127.0.0.1:9/x")),
    "count beyond the buffer.glb": glb(mesh_gltf(count=1_000_000_000), CORNERS),
    "offset beyond the buffer.glb": glb(mesh_gltf(offset=1 << 30), CORNERS),
    "index out of range.glb": glb(mesh_gltf(index=9), CORNERS + struct.pack("<3I", 0, 1, 900)),
    "not a number.glb": glb(mesh_gltf(), struct.pack("<9f", *[float("nan")] * 9)),
    "wrong component.glb": glb(mesh_gltf(component=99), CORNERS),
    "nothing.obj": b"",
    "a pickle.obj": PICKLE,
    "not a number.obj": b"v nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n",
    "index out of range.obj": b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 7\n",
    "a library elsewhere.obj": b"mtllib /etc/passwd\nv 0 0 0\n",
    "no asset.zip": zipped({"readme.txt": b"hello"}),
    "a path out of it.zip": zipped({"../asset.json": manifest()}),
    "a pickle inside.zip": zipped({"asset.json": PICKLE}),
    "a newer asset.zip": zipped({"asset.json": manifest(schema_version=10**6)}),
    "a truncated asset.zip": zipped({"asset.json": manifest()})[:-30],
    "a list.zip": zipped({"asset.json": b"[]"}),
}


@pytest.fixture
def refuse(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Callable[[str, str, bytes], str]:
    monkeypatch.setattr(resource, "setrlimit", lambda *_: None)  # this process goes on after the tool

    def run(command: str, name: str, data: bytes) -> str:
        source, out = tmp_path / f"upload{Path(name).suffix}", tmp_path / "out"
        source.write_bytes(data)
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        code = file_tool.main([command, str(source), str(out)])
        said = capsys.readouterr()
        assert code == 2, f"{name} was taken"
        assert "unpickled" not in said.out and "Traceback" not in said.err
        assert [path.name for path in tmp_path.iterdir()] == [source.name], f"{name} left something"
        assert (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * 1024 < MOST_BYTES, f"{name} swallowed memory"
        sentence = said.err.strip().splitlines()[-1]  # a library may have said something before
        assert " " in sentence, sentence
        assert "root:" not in sentence  # nothing of /etc/passwd
        return sentence

    return run


@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_a_hostile_environment_is_refused(refuse: Callable[[str, str, bytes], str], name: str) -> None:
    refuse("environment", name, ENVIRONMENTS[name])


@pytest.mark.parametrize("name", LARGE)
def test_an_environment_beyond_what_a_service_takes_is_refused_by_its_header(refuse: Callable[[str, str, bytes], str], name: str) -> None:
    assert "the limit is" in refuse("environment", name, LARGE[name])


@pytest.mark.parametrize("name", MESHES)
def test_a_hostile_asset_or_mesh_is_refused(refuse: Callable[[str, str, bytes], str], name: str) -> None:
    refuse("asset", name, MESHES[name])


@pytest.mark.slow
def test_a_bomb_of_an_asset_is_refused(refuse: Callable[[str, str, bytes], str]) -> None:
    # Made here and not above: packing it takes each process that collects these tests a second.
    refuse("asset", "a bomb.zip", zipped({"asset.json": manifest(), "mesh.glb": bytes(300_000_000)}))


def test_the_memory_of_an_environment_is_estimated_by_what_its_header_claims(tmp_path: Path) -> None:
    (tmp_path / "small.hdr").write_bytes(hdr())
    (tmp_path / "large.hdr").write_bytes(hdr(b"-Y 4096 +X 8192\n", b""))
    (tmp_path / "spaced.hdr").write_bytes(hdr(b"-Y  4096 +X 8192 \n", b""))
    (tmp_path / "unclear.hdr").write_bytes(hdr(b"-Y many +X 8192\n", b""))
    small, *large = (file_tool.file_tool_bytes(tmp_path / f"{name}.hdr") for name in ("small", "large", "spaced", "unclear"))
    assert small < 128 << 20 and all(1 << 30 < one < 2 << 30 for one in large)


def test_the_tool_cannot_take_more_memory_than_its_limit() -> None:
    code = "import resource\nfrom drgs_worker.jobs import file_tool\nfile_tool.make_asset = lambda *_: bytearray(1 << 36)\nimport sys\nsys.exit(file_tool.main(['asset', 'a', 'b']))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=PATIENCE_SECONDS)
    assert done.returncode == 2 and "more memory than the 16 GiB" in done.stderr
