"""Rigs for tests: a small writer of glTF, and a tower of two bones."""

import base64
import json
import struct
from pathlib import Path

import numpy as np

TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}
CODES = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "u4": 5125, "f4": 5126}


class RigWriter:
    """A glTF document that grows: add arrays, then name them in `document`."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.document = {
            "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [], "meshes": [], "skins": [], "animations": [],
            "accessors": [], "bufferViews": [], "buffers": [{"byteLength": 0}],
        }  # fmt: skip

    def view(self, data: bytes, **keys) -> int:
        self.data += b"\0" * (-len(self.data) % 4)
        self.document["bufferViews"].append({"buffer": 0, "byteOffset": len(self.data), "byteLength": len(data), **keys})
        self.data += data
        return len(self.document["bufferViews"]) - 1

    def array(self, values, dtype: str = "f4", stride: int | None = None, **keys) -> int:
        """Index of an accessor that holds values (count,) or (count, k)."""
        array = np.asarray(values).astype("<" + dtype)
        array = array.reshape(len(array), -1)
        data = array.tobytes()
        if stride is not None:
            element = array.shape[1] * array.itemsize
            data = b"".join(row.tobytes() + b"\xff" * (stride - element) for row in array)[: stride * (len(array) - 1) + element]
        view = self.view(data, **({} if stride is None else {"byteStride": stride}))
        accessor = {"bufferView": view, "componentType": CODES[dtype], "count": len(array), "type": TYPES[array.shape[1]], **keys}
        self.document["accessors"].append(accessor)
        return len(self.document["accessors"]) - 1

    def sparse(self, base, count: int, places, values) -> int:
        """An accessor of (count, 3) floats: `base` or zeros, with `values` at `places`."""
        index = self.array(np.zeros((count, 3)) if base is None else base)
        accessor = self.document["accessors"][index]
        if base is None:
            del accessor["bufferView"]
        accessor["sparse"] = {
            "count": len(places),
            "indices": {"bufferView": self.view(np.asarray(places, "<u2").tobytes()), "componentType": 5123},
            "values": {"bufferView": self.view(np.asarray(values, "<f4").tobytes())},
        }
        return index

    def animate(self, name: str, *channels) -> None:
        """Channels are (node, path, times, values, interpolation)."""
        samplers, targets = [], []
        for node, path, times, values, interpolation in channels:
            flat = np.asarray(values, np.float32)
            flat = flat.reshape(-1) if path == "weights" else flat.reshape(-1, flat.shape[-1])
            samplers.append({"input": self.array(times), "output": self.array(flat), "interpolation": interpolation})
            targets.append({"sampler": len(samplers) - 1, "target": {"node": node, "path": path}})
        self.document["animations"].append({"name": name, "samplers": samplers, "channels": targets})

    def save(self, path: Path, buffer: str = "inside") -> Path:
        """A .glb, or a .gltf with its buffer inside it or beside it."""
        document = json.loads(json.dumps(self.document))
        document["buffers"][0]["byteLength"] = len(self.data)
        if path.suffix == ".gltf":
            content = "data:application/octet-stream;base64," + base64.b64encode(self.data).decode()
            document["buffers"][0]["uri"] = content if buffer == "inside" else "a%20rig.bin"
            if buffer == "beside":
                (path.parent / "a rig.bin").write_bytes(self.data)
            path.write_text(json.dumps(document))
            return path
        text = json.dumps(document).encode()
        text += b" " * (-len(text) % 4)
        binary = bytes(self.data) + b"\0" * (-len(self.data) % 4)
        header = struct.pack("<5I", 0x46546C67, 2, 28 + len(text) + len(binary), len(text), 0x4E4F534A)
        path.write_bytes(header + text + struct.pack("<2I", len(binary), 0x004E4942) + binary)
        return path


def tower(rings: int, height: float, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces of a closed square tower about glTF's y axis, from y = 0; its rings are evenly spaced."""
    square = radius * np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]], np.float64)
    levels = np.linspace(0, height, rings)
    vertices = np.concatenate([np.stack([square[:, 0], np.full(4, y), square[:, 1]], -1) for y in levels])
    faces = []
    for r in range(rings - 1):
        for k in range(4):
            a, b = 4 * r + k, 4 * r + (k + 1) % 4
            faces += [[a, b, b + 4], [a, b + 4, a + 4]]
    top = 4 * (rings - 1)
    faces += [[0, 2, 1], [0, 3, 2], [top, top + 1, top + 2], [top, top + 2, top + 3]]
    faces = np.array(faces)
    middle = vertices.mean(0)
    corners = vertices[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    inwards = ((corners.mean(1) - middle) * normal).sum(1) < 0
    faces[inwards] = faces[inwards][:, [0, 2, 1]]
    return vertices, faces


def quat_xyzw(axis, degrees: float) -> list[float]:
    axis = np.asarray(axis, np.float64) / np.linalg.norm(axis)
    return [*(np.sin(np.radians(degrees) / 2) * axis), np.cos(np.radians(degrees) / 2)]


def two_bones(height: float = 2.0, radius: float = 0.3, rings: int = 9, base=(0.0, 0.0, 0.0)) -> RigWriter:
    """A tower whose upper half follows a second bone. Nodes: 0 root joint at the base, 1 joint halfway up, 2 the mesh.

    Animations: "Bend" turns the second bone by 90 degrees about z within a second; "Turn" turns and moves the root; "Still" does nothing.
    """
    writer = RigWriter()
    vertices, faces = tower(rings, height, radius)
    share = np.clip((vertices[:, 1] / height - 0.25) * 2, 0, 1)
    joints, weights = np.tile([0, 1, 0, 0], (len(vertices), 1)), np.zeros((len(vertices), 4))
    weights[:, 0], weights[:, 1] = 1 - share, share
    bind = np.tile(np.eye(4), (2, 1, 1))
    bind[0, :3, 3] = -np.asarray(base)
    bind[1, :3, 3] = -np.add(base, [0, height / 2, 0])
    attributes = {
        "POSITION": writer.array(vertices + base), "JOINTS_0": writer.array(joints, "u1"), "WEIGHTS_0": writer.array(weights),
    }  # fmt: skip
    writer.document["meshes"] = [
        {"name": "tower", "primitives": [{"attributes": attributes, "indices": writer.array(faces.reshape(-1), "u2")}]}
    ]
    writer.document["skins"] = [{"joints": [0, 1], "inverseBindMatrices": writer.array(bind.transpose(0, 2, 1).reshape(2, 16))}]
    writer.document["nodes"] = [
        {"name": "root", "children": [1], "translation": list(base)},
        {"name": "upper", "translation": [0, height / 2, 0]},
        {"name": "body", "mesh": 0, "skin": 0},
    ]
    writer.document["scenes"] = [{"nodes": [0, 2]}]
    still = [0, 0, 0, 1]
    writer.animate("Bend", (1, "rotation", [0, 1], [still, quat_xyzw([0, 0, 1], 90)], "LINEAR"))
    turned = np.add(base, [0.3, -0.2, 0.5]).tolist()
    writer.animate(
        "Turn",
        (0, "rotation", [0, 1], [still, quat_xyzw([1, 2, 3], 100)], "LINEAR"),
        (0, "translation", [0, 1], [list(base), turned], "LINEAR"),
    )
    writer.animate("Still", (1, "rotation", [0, 1], [still, still], "LINEAR"))
    return writer
