"""Moved vertices of a mesh, from files of other programs: one pose, or a sequence of them played by time.

    NPZ   `vertices` (vertex, 3), or (frame, vertex, 3)
    OBJ, PLY   one pose; a folder of them is a sequence, in the order of the numbers in their names

Positions are world units, z up, taken as they are. A file that has faces must have the asset's, so that a mesh which another program
has cut, welded or renumbered is refused instead of being torn; a different order of the faces does no harm.
"""

import math
import re
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy import ndarray
from torch import Tensor

from drgs.exchange.npz import read_npz_frames
from drgs.exchange.obj import parse_obj
from drgs.exchange.ply import parse_ply, triangles_from_faces
from drgs.scene.mesh import TriangleMesh

MAX_BYTES = 2 << 30


def vertices_at(path: Path, seconds: float, frames_per_second: float, mesh: TriangleMesh) -> Float[Tensor, "vertex 3"]:
    """(vertex, 3) positions at a time, linear between frames; the last frame after the end.

    Args:
        path: an NPZ, OBJ or PLY file, or a folder of OBJ or PLY files.
        mesh: whose vertices they are; decides count, faces, type and device.

    Raises:
        ValueError: one sentence: no such file, damaged, another topology, or a value that is not finite.
    """
    position = max(seconds, 0.0) * frames_per_second

    def frames(count: int) -> tuple[list[int], float]:
        place = min(position, count - 1)
        first = math.floor(place + 1e-6)
        share = place - first
        return ([first], 0.0) if share <= 1e-6 else ([first, first + 1], share)

    if path.is_dir():
        files = _frames_of_folder(path)
        wanted, share = frames(len(files))
        arrays = [_read_pose(files[index], mesh) for index in wanted]
    elif path.suffix.lower() in (".obj", ".ply"):
        arrays, share = [_read_pose(path, mesh)], 0.0
    else:
        arrays = read_npz_frames(path, "vertices", tuple(mesh.vertices.shape), lambda count: frames(count)[0])
        share = position - math.floor(position + 1e-6)
    poses = [torch.from_numpy(array).to(mesh.vertices) for array in arrays]
    return poses[0] if len(poses) == 1 else torch.lerp(poses[0], poses[1], share)


def _frames_of_folder(folder: Path) -> list[Path]:
    """OBJ or PLY files by the numbers in their names, so that pose_10 follows pose_9."""
    files = [path for path in folder.iterdir() if path.suffix.lower() in (".obj", ".ply") and not path.name.startswith(".")]
    if not files:
        raise ValueError(f"{folder}: holds no OBJ or PLY files; expected one for each frame")
    return sorted(files, key=lambda path: [int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", path.name)])


def _read_pose(path: Path, mesh: TriangleMesh) -> Float[ndarray, "vertex 3"]:
    """(vertex, 3) float32 of one OBJ or PLY file that has the mesh's vertices and faces."""
    if path.stat().st_size > MAX_BYTES:
        raise ValueError(f"{path}: has {path.stat().st_size} bytes; the limit is {MAX_BYTES}")
    data = path.read_bytes()
    if path.suffix.lower() == ".obj":
        vertices, faces = parse_obj(data, str(path))
    else:
        ply = parse_ply(data, str(path))
        vertex = ply.elements.get("vertex")
        if vertex is None or not {"x", "y", "z"} <= set(vertex.scalars):
            raise ValueError(f"{path}: has no vertices with x, y, z")
        vertices = np.stack([vertex.scalars[axis].astype(np.float32) for axis in "xyz"], -1)
        faces = triangles_from_faces(ply, len(vertices), str(path)) if "face" in ply.elements else np.zeros((0, 3), np.int32)
    if len(vertices) != len(mesh.vertices):
        raise ValueError(f"{path}: has {len(vertices)} vertices; expected the {len(mesh.vertices)} of the asset's mesh, in its order")
    if not np.isfinite(vertices).all():
        raise ValueError(f"{path}: holds {int((~np.isfinite(vertices)).sum())} coordinates that are not finite")
    if len(faces):
        own = mesh.faces.cpu().numpy()
        if not np.array_equal(_canonical(faces), _canonical(own)):
            flipped = np.array_equal(_canonical(faces[:, ::-1]), _canonical(own))
            found = "its faces turn the other way round" if flipped else "its faces join other vertices"
            raise ValueError(f"{path}: {found} than those of the asset's mesh; expected the same mesh with moved vertices")
    return vertices


def _canonical(faces: Int[ndarray, "face 3"]) -> Int[ndarray, "face 3"]:
    """The same oriented triangles, each from its smallest vertex on, in one order."""
    start = faces.argmin(1)
    turned = np.take_along_axis(faces, (start[:, None] + np.arange(3)) % 3, 1)
    return turned[np.lexsort(turned.T[::-1])]
