"""Files that trials send, made here from nothing: meshes, environments, archives. In: numbers. Out: bytes."""

import io
import json
import struct
import zipfile
import zlib

import numpy as np
import OpenEXR


def ball(rings: int = 10) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (n, 3) and triangles (m, 3) of a closed unit sphere."""
    polar = np.pi * np.arange(1, rings) / rings
    around = 2 * np.pi * np.arange(2 * rings) / (2 * rings)
    z = np.repeat(np.cos(polar), 2 * rings)
    x, y = (np.outer(np.sin(polar), turn).reshape(-1) for turn in (np.cos(around), np.sin(around)))
    vertices = np.concatenate([np.stack([x, y, z], -1), [[0, 0, 1], [0, 0, -1]]])
    wide, top = 2 * rings, len(vertices) - 2
    faces = []
    for ring in range(rings - 2):
        for k in range(wide):
            a, b = ring * wide + k, ring * wide + (k + 1) % wide
            faces += [[a, a + wide, b], [b, a + wide, b + wide]]
    last = (rings - 2) * wide
    for k in range(wide):
        faces += [[top, k, (k + 1) % wide], [top + 1, last + (k + 1) % wide, last + k]]
    return vertices.astype(np.float32), np.array(faces, np.int32)


def obj(vertices: np.ndarray, faces: np.ndarray, head: str = "") -> bytes:
    lines = [f"v {x:.7g} {y:.7g} {z:.7g}" for x, y, z in vertices] + [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in faces]
    return (head + "\n".join(lines) + "\n").encode("latin-1")


def ply(vertices: np.ndarray, faces: np.ndarray) -> bytes:
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(vertices)}\nproperty float x\nproperty float y\nproperty float z\n"
    head += f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    rows = np.zeros(len(faces), [("count", "u1"), ("corner", "<i4", 3)])
    rows["count"], rows["corner"] = 3, faces
    return head.encode() + vertices.astype("<f4").tobytes() + rows.tobytes()


def exr(pixels: np.ndarray) -> bytes:
    """(height, width, 3) float32."""
    stream = io.BytesIO()
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, {name: np.ascontiguousarray(pixels[..., k], np.float32) for k, name in enumerate("RGB")}).write(stream)
    return stream.getvalue()


def claiming_exr(width: int, height: int, comment: str) -> bytes:
    """Small, behind a comment in its header a picture that claims a size, and nothing of it."""
    stream = io.BytesIO()
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, "a comment": comment}
    OpenEXR.File(header, {name: np.ones((2, 4), np.float32) for name in "RGB"}).write(stream)
    data = bytearray(stream.getvalue())
    for name in (b"dataWindow\0box2i\0", b"displayWindow\0box2i\0"):
        struct.pack_into("<4i", data, data.rindex(name) + len(name) + 4, 0, 0, width - 1, height - 1)
    return bytes(data) + bytes(2 << 20)


def read_exr(data: bytes) -> dict[str, np.ndarray]:
    """Channel name -> (height, width)."""
    with OpenEXR.File(io.BytesIO(data), separate_channels=True) as file:
        return {name: np.asarray(channel.pixels) for name, channel in file.channels().items()}


def hdr(width: int, height: int, rgbe: tuple[int, int, int, int]) -> bytes:
    """A Radiance picture of one colour in run lengths, which is small however large it claims to be."""
    runs, left = [], width
    while left:
        runs.append(min(left, 127))
        left -= runs[-1]
    row = bytes([2, 2, width >> 8, width & 255]) + b"".join(bytes([128 + run, value]) for value in rgbe for run in runs)
    return f"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y {height} +X {width}\n".encode() + row * height


def hdr_of_repeats(width: int, height: int) -> bytes:
    """The same in the old run lengths, each of which may stand for thousands of pixels: some bytes a row."""
    left, row, shift = width - 1, bytes([128, 128, 128, 129]), 0
    while left:
        row += bytes([1, 1, 1, left & 255])
        left, shift = left >> 8, shift + 8
    return f"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y {height} +X {width}\n".encode() + row * height


def glb(document: dict, binary: bytes) -> bytes:
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    binary += b"\0" * (-len(binary) % 4)
    chunks = struct.pack("<2I", len(text), 0x4E4F534A) + text + struct.pack("<2I", len(binary), 0x004E4942) + binary
    return struct.pack("<3I", 0x46546C67, 2, 12 + len(chunks)) + chunks


def claiming_png(side: int) -> bytes:
    """A square picture of nothing, a thousandth of what it takes in memory."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    packer, rows = zlib.compressobj(1), side
    packed, many = b"", bytes(100 * (1 + 3 * side))
    while rows:
        packed += packer.compress(many[: min(rows, 100) * (1 + 3 * side)])
        rows -= min(rows, 100)
    head = struct.pack(">IIBBBBB", side, side, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", packed + packer.flush()) + chunk(b"IEND", b"")


def textured_glb(picture: bytes) -> bytes:
    """A ball under a picture, whatever that is."""
    vertices, faces = ball(6)
    views = [
        vertices.tobytes(),
        (vertices[:, :2] / 2 + 0.5).tobytes(),
        faces.astype("<u4").tobytes(),
        picture + b"\0" * (-len(picture) % 4),
    ]
    ends = np.cumsum([0, *(len(view) for view in views)]).tolist()
    document = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "indices": 2, "material": 0}]}],
        "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
        "textures": [{"source": 0}],
        "images": [{"bufferView": 3, "mimeType": "image/png"}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": len(vertices), "type": "VEC3"},
            {"bufferView": 1, "componentType": 5126, "count": len(vertices), "type": "VEC2"},
            {"bufferView": 2, "componentType": 5125, "count": int(faces.size), "type": "SCALAR"},
        ],
        "bufferViews": [{"buffer": 0, "byteOffset": start, "byteLength": len(view)} for start, view in zip(ends, views, strict=False)],
        "buffers": [{"byteLength": ends[-1]}],
    }
    return glb(document, b"".join(views))


def sparse_glb() -> bytes:
    """A ball whose positions are all sparse: a reader that knows nothing of that finds one point."""
    vertices, faces = ball(6)
    count = len(vertices)
    views = [vertices.tobytes(), np.arange(count, dtype="<u4").tobytes(), faces.astype("<u4").tobytes()]
    ends = np.cumsum([0, *(len(view) for view in views)]).tolist()
    sparse = {"count": count, "indices": {"bufferView": 1, "componentType": 5125}, "values": {"bufferView": 0}}
    document = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "accessors": [
            {"componentType": 5126, "count": count, "type": "VEC3", "sparse": sparse},
            {"bufferView": 2, "componentType": 5125, "count": int(faces.size), "type": "SCALAR"},
        ],
        "bufferViews": [{"buffer": 0, "byteOffset": start, "byteLength": len(view)} for start, view in zip(ends, views, strict=False)],
        "buffers": [{"byteLength": ends[-1]}],
    }
    return glb(document, b"".join(views))


def zipped(entries: dict[str, bytes]) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in entries.items():
            archive.writestr(name, data)
    return stream.getvalue()
