"""The character as a skinned glTF in one file: mesh with materials on its vertices, joints, weights and the dance.

In: how fine. Out: a .glb that `drgs import` takes for an object and pose edits for a rig ("character.glb#dance"). glTF is y up: (x, y, z) -> (x, z, -y), which
is what its readers undo. Source: glTF 2.0 specification, Khronos.
"""

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.spatial.transform import Rotation

from benchmarks.paper.cells import write_whole
from benchmarks.paper.character.body import model_body
from benchmarks.paper.character.dance import DURATION, FPS, dance_pose
from benchmarks.paper.character.skeleton import INDEX, JOINTS, PARENTS, rest_positions
from benchmarks.paper.character.skin_weights import skin_weights

CLIP = "dance"
CELL = 0.0105
"""Width of the cells that the body is modelled with: 24 000 vertices [world units]."""
_FILE_FROM_WORLD = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
_SHAPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}
_CODES = {"u1": 5121, "u4": 5125, "f4": 5126}


class _Buffer:
    """What a file holds behind its description; accessors as they are added. Final."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.views: list[dict] = []
        self.accessors: list[dict] = []

    def add(self, values: np.ndarray, dtype: str = "f4", **keys: Any) -> int:
        """Index of an accessor of (count,) or (count, k) values."""
        array = np.ascontiguousarray(values).astype(f"<{dtype}").reshape(len(values), -1)
        self.data += b"\0" * (-len(self.data) % 4)
        self.views.append({"buffer": 0, "byteOffset": len(self.data), "byteLength": array.nbytes})
        self.data += array.tobytes()
        described = {
            "bufferView": len(self.views) - 1,
            "componentType": _CODES[dtype],
            "count": len(array),
            "type": _SHAPES[array.shape[1]],
        }
        self.accessors.append(described | keys)
        return len(self.accessors) - 1


def write_character(path: Path, cell: float = CELL) -> None:
    """Make the character and write it whole.

    Args:
        cell: of the grid that its body is modelled with [world units].

    Raises:
        ValueError: the cells are too wide.
    """
    body, buffer = model_body(cell), _Buffer()
    mesh, skin = body.mesh, skin_weights(body)
    vertices = mesh.vertices.numpy() @ _FILE_FROM_WORLD.T
    attributes = {
        "POSITION": buffer.add(vertices, min=vertices.min(0).tolist(), max=vertices.max(0).tolist()),
        "NORMAL": buffer.add(mesh.normals.numpy() @ _FILE_FROM_WORLD.T),
        "COLOR_0": buffer.add(mesh.albedo.numpy()),
        "JOINTS_0": buffer.add(np.where(skin.weights > 0, skin.joints, 0), "u1"),
        "WEIGHTS_0": buffer.add(skin.weights),
        "_ALBEDO": buffer.add(mesh.albedo.numpy()),
        "_ROUGHNESS": buffer.add(mesh.roughness.numpy()),
        "_METALLIC": buffer.add(mesh.metallic.numpy()),
    }
    primitive = {"attributes": attributes, "indices": buffer.add(mesh.faces.numpy().reshape(-1), "u4"), "material": 0}
    document = {
        "asset": {"version": "2.0", "generator": "drgs", "copyright": "CC0 1.0"},
        "scene": 0,
        "scenes": [{"nodes": [INDEX["hips"], len(JOINTS)]}],
        "nodes": [*_joint_nodes(), {"name": "character", "mesh": 0, "skin": 0}],
        "meshes": [{"name": "character", "primitives": [primitive]}],
        "materials": [{"name": "character", "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 0.6}}],
        "skins": [{"joints": list(range(len(JOINTS))), "skeleton": INDEX["hips"], "inverseBindMatrices": _inverse_binds(buffer)}],
        "animations": [_animation(buffer)],
        "accessors": buffer.accessors,
        "bufferViews": buffer.views,
        "buffers": [{"byteLength": len(buffer.data) + -len(buffer.data) % 4}],
    }
    write_whole(path, _glb(document, bytes(buffer.data)))


def _glb(document: dict, data: bytes) -> bytes:
    text = json.dumps(document).encode()
    text, data = text + b" " * (-len(text) % 4), data + b"\0" * (-len(data) % 4)
    head = struct.pack("<4s2I", b"glTF", 2, 28 + len(text) + len(data))
    return b"".join([head, struct.pack("<I4s", len(text), b"JSON"), text, struct.pack("<I4s", len(data), b"BIN\0"), data])


def _joint_nodes() -> list[dict]:
    """Joints stand unturned, each at its place beside its parent."""
    rest = rest_positions() @ _FILE_FROM_WORLD.T
    nodes: list[dict] = []
    for place, (joint, parent) in enumerate(zip(JOINTS, PARENTS, strict=True)):
        beside = rest[place] - (0.0 if parent < 0 else rest[parent])
        children = [child for child, above in enumerate(PARENTS) if above == place]
        nodes.append({"name": joint.name, "translation": beside.tolist()} | ({"children": children} if children else {}))
    return nodes


def _inverse_binds(buffer: _Buffer) -> int:
    matrices = np.tile(np.eye(4), (len(JOINTS), 1, 1))
    matrices[:, :3, 3] = -rest_positions() @ _FILE_FROM_WORLD.T
    return buffer.add(matrices.transpose(0, 2, 1).reshape(-1, 16))  # columns first


def _animation(buffer: _Buffer) -> dict:
    """A key a frame, so that what lies between keys is as good as straight."""
    seconds = np.arange(round(DURATION * FPS) + 1) / FPS
    poses = [dance_pose(time) for time in seconds]
    times = buffer.add(seconds, min=[float(seconds[0])], max=[float(seconds[-1])])
    turns = np.stack([_file_quaternions(pose.turns) for pose in poses])
    outputs = [(INDEX["hips"], "translation", np.stack([pose.hips for pose in poses]) @ _FILE_FROM_WORLD.T)]
    outputs += [(joint, "rotation", turns[:, joint]) for joint in range(len(JOINTS))]
    return {
        "name": CLIP,
        "samplers": [{"input": times, "output": buffer.add(values), "interpolation": "LINEAR"} for _, _, values in outputs],
        "channels": [{"sampler": place, "target": {"node": node, "path": path}} for place, (node, path, _) in enumerate(outputs)],
    }


def _file_quaternions(turns: Rotation) -> Float[ndarray, "joint 4"]:
    """xyzw, in the file's axes."""
    quats = turns.as_quat(canonical=True)
    return np.concatenate([quats[:, :3] @ _FILE_FROM_WORLD.T, quats[:, 3:]], 1)
