import io
import json
import struct

import numpy as np
import pytest
import trimesh

from drgs.exchange.glb import GlbMesh, decode_glb, encode_glb

FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], np.int32)


def tetrahedron() -> GlbMesh:
    random = np.random.default_rng(0)
    normals = random.normal(size=(4, 3)).astype(np.float32)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    color = random.random((4, 3), np.float32)
    attributes = {"POSITION": random.normal(size=(4, 3)).astype(np.float32), "NORMAL": normals, "COLOR_0": color, "_ALBEDO": color}
    return GlbMesh(attributes | {"_ROUGHNESS": random.random(4, np.float32)}, FACES, {"roughnessFactor": 0.5})


def document(data: bytes) -> dict:
    return json.loads(data[20 : 20 + struct.unpack_from("<I", data, 12)[0]])


def test_a_mesh_survives_writing_and_reading_bit_for_bit():
    mesh = tetrahedron()
    read = decode_glb(encode_glb(mesh, meters_per_unit=0.37))
    assert read.attributes.keys() == mesh.attributes.keys() and read.material == mesh.material
    assert all(read.attributes[name].tobytes() == values.tobytes() for name, values in mesh.attributes.items())
    assert np.array_equal(read.faces, FACES) and read.faces.dtype == np.int32


def test_other_programs_see_it_y_up_in_metres():
    mesh = tetrahedron()
    scene = trimesh.load_scene(io.BytesIO(encode_glb(mesh, meters_per_unit=0.5)), file_type="glb", process=False)
    x, y, z = mesh.attributes["POSITION"].T
    assert np.allclose(scene.to_geometry().vertices, 0.5 * np.stack([x, z, -y], -1), atol=1e-6)


def test_the_file_is_laid_out_as_gltf_demands():
    data = encode_glb(tetrahedron())
    gltf = document(data)
    assert len(data) == struct.unpack_from("<I", data, 8)[0] and len(data) % 4 == 0
    for accessor in gltf["accessors"]:
        view = gltf["bufferViews"][accessor["bufferView"]]
        assert view["byteOffset"] % 4 == 0 and view["byteOffset"] + view["byteLength"] <= gltf["buffers"][0]["byteLength"]
    attributes = gltf["meshes"][0]["primitives"][0]["attributes"]
    position = gltf["accessors"][attributes["POSITION"]]
    assert np.allclose(position["min"], tetrahedron().attributes["POSITION"].min(0))
    assert attributes["COLOR_0"] == attributes["_ALBEDO"]  # stored once


def test_damaged_and_foreign_files_are_refused_by_name():
    good = encode_glb(tetrahedron())
    length = struct.unpack_from("<I", good, 12)[0]

    def changed(**keys) -> bytes:
        text = json.dumps(document(good) | keys).encode()
        text += b" " * (-len(text) % 4)
        return (
            struct.pack("<5I", 0x46546C67, 2, 20 + len(text) + len(good) - 20 - length, len(text), 0x4E4F534A) + text + good[20 + length :]
        )

    beyond = document(good)["accessors"]
    beyond[0]["count"] = 10**7
    bytes_only = document(good)["accessors"]
    bytes_only[0]["componentType"] = 5121
    for data in (
        b"",
        b"glTF",
        good[:-4],
        good[:30],
        b"x" + good[1:],
        changed(accessors=beyond),
        changed(accessors=bytes_only),
        changed(meshes=[]),
    ):
        with pytest.raises(ValueError, match=r"^mesh\.glb: is not a mesh that drgs wrote, or is damaged"):
            decode_glb(data, "mesh.glb")
