"""Whatever a file's bytes are, a reader either reads them or refuses them with a ValueError."""

import hashlib
import io
import json
import warnings
import zipfile

import numpy as np
import pytest

from drgs.convert.import_mesh import import_mesh
from drgs.convert.import_splats import import_splats
from drgs.exchange.exr import decode_environment
from drgs.exchange.glb import GlbMesh, decode_glb, encode_glb
from drgs.exchange.npz import read_npz_frames
from drgs.exchange.package import read_package
from drgs.exchange.ply import encode_ply, parse_ply, triangles_from_faces
from tests.exchange.write_splats import glb_with_splats

CORNERS, FACES = np.eye(4, 3, dtype=np.float32), np.array([[0, 1, 2], [1, 3, 2]], np.int32)
BINARY_PLY = encode_ply({"vertex": {axis: CORNERS[:, k] for k, axis in enumerate("xyz")}}, FACES)
ASCII_PLY = b"ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\nelement face 1\n"
ASCII_PLY += b"property list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"
GLB = encode_glb(GlbMesh({"POSITION": CORNERS, "NORMAL": CORNERS, "_ROUGHNESS": CORNERS[:, 0].copy()}, FACES))
LISTED = {"mesh.glb": {"bytes": len(GLB), "sha256": hashlib.sha256(GLB).hexdigest()}}
OBJ = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nvn 0 0 1\nf 1//1 2//1 3//1\n"
ROW = b"\x02\x02\x00\x08" + 4 * b"\x83\x80\x05\x81\x82\x83\x84\x85"  # a run of three and five literals, four times
HDR = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 4 +X 8\n" + 4 * ROW


def read_ply(data, _folder):
    triangles_from_faces(parse_ply(data), 4)


def packed(**files: bytes) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in files.items():
            archive.writestr(name.replace("_", "."), data)
    return stream.getvalue()


def npz() -> bytes:
    stream = io.BytesIO()
    np.savez_compressed(stream, vertices=np.stack([CORNERS, 2 * CORNERS]))
    return stream.getvalue()


def read_npz(data, folder):
    (folder / "a.npz").write_bytes(data)
    read_npz_frames(folder / "a.npz", "vertices", CORNERS.shape, lambda count: range(count))


def read_asset(data, folder):
    (folder / "a.zip").write_bytes(data)
    read_package(folder / "a.zip", ("mesh.glb",), ("mesh.glb",), 1)


def read_mesh(suffix):
    def read(data, folder):
        (folder / f"a{suffix}").write_bytes(data)
        import_mesh(folder / f"a{suffix}")

    return read


def read_splats(data, folder):
    (folder / "a.glb").write_bytes(data)
    import_splats(folder / "a.glb")


READERS = {
    "ascii ply": (read_ply, ASCII_PLY), "binary ply": (read_ply, BINARY_PLY), "own glb": (lambda data, _: decode_glb(data), GLB),
    "hdr": (lambda data, _: decode_environment(data), HDR), "imported glb": (read_mesh(".glb"), GLB), "imported obj": (read_mesh(".obj"), OBJ),
    "imported ply": (read_mesh(".ply"), BINARY_PLY), "npz": (read_npz, npz()),
    "splats": (read_splats, glb_with_splats()),
    "zipped asset": (read_asset, packed(asset_json=json.dumps({"schema_version": 1, "files": LISTED}).encode(), mesh_glb=GLB)),
}  # fmt: skip


@pytest.mark.parametrize("name", READERS)
def test_mutated_bytes_are_read_or_refused(name, tmp_path):
    read, good = READERS[name]
    random = np.random.default_rng(0)
    read(good, tmp_path)
    refused = 0
    for _ in range(80):
        data = bytearray(good)
        for _ in range(random.integers(1, 5)):
            place = int(random.integers(len(data)))
            match int(random.integers(4)):
                case 0:
                    data[place] = random.integers(256)
                case 1:
                    data = data[: max(place, 1)]
                case 2:
                    data[place:place] = random.bytes(3)
                case _:
                    data[place] = random.choice(list(b"0123456789-. \n"))
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                read(bytes(data), tmp_path)
        except ValueError:
            refused += 1
    assert refused > 10
