"""What moves in an FBX file, as the same records that `gltf_rig.py` makes of glTF.

In: a .fbx file, text or binary. Out: a `Rig`, y up and in metres whatever the file has: its root node turns and scales. Animations are baked
by ufbx (curves, layers, pivots, Euler angles in any order) into keys that lines join, thirty a second where they turn. Constraints are not
solved, materials, cameras and lights passed over. Needs the optional package ufbx, which runs in a process of its own (`fbx_process.py`).
"""

import json
import subprocess
import sys
import tempfile
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from drgs.exchange.rig import MAX_NODES, MAX_VERTICES, Rig, RigAnimation, RigChannel, RigMesh, RigNode, RigSkin
from drgs.installation import missing_package

MAX_BYTES = 1 << 30
SECONDS = 600
"""That a file may take to be read."""
_PROCESS = Path(__file__).with_name("fbx_process.py")
_REFUSED = 3
"""Exit status of a process that says why, as it has it."""


def read_fbx_rig(path: Path | str) -> Rig:
    """Read a file.

    Raises:
        ValueError: one sentence that names the file: missing, damaged, moved by what is not read (dual quaternions, shapes in between, caches
            of vertices), without any triangles; or the package ufbx is not there.
    """
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"{path}: does not exist")
    if path.stat().st_size > MAX_BYTES:
        raise ValueError(f"{path}: has {path.stat().st_size} bytes; at most {MAX_BYTES} are read")
    if find_spec("ufbx") is None:
        raise ValueError(missing_package(f"{path}: reading FBX", "ufbx", "fbx"))
    with tempfile.TemporaryDirectory() as folder:
        arrays = _arrays(path, Path(folder) / "rig.npz")
    try:
        return _rig(arrays)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def _arrays(path: Path, out: Path) -> dict[str, np.ndarray]:
    # -P: the folder of the script is no place to import from.
    command = [sys.executable, "-P", str(_PROCESS), str(path.resolve()), str(out)]
    try:
        done = subprocess.run(command, capture_output=True, text=True, errors="replace", timeout=SECONDS, check=False)
    except subprocess.TimeoutExpired as error:
        raise ValueError(f"{path}: is not read within {SECONDS} s") from error
    if done.returncode == _REFUSED:
        raise ValueError(f"{path}: {done.stderr.strip()[:300]}")
    if done.returncode != 0:
        last = (done.stderr.strip().splitlines() or ["no word"])[-1][:200]
        raise ValueError(f"{path}: ufbx gave up on it with status {done.returncode} ({last})")
    with np.load(out, allow_pickle=False) as stored:
        return dict(stored)


def _rig(arrays: dict[str, np.ndarray]) -> Rig:
    table = json.loads(arrays["table"].tobytes())
    if len(table["nodes"]) > MAX_NODES:
        raise ValueError(f"holds {len(table['nodes'])} nodes; expected at most {MAX_NODES}")
    meshes = tuple(
        RigMesh(
            name,
            *(arrays.get(f"mesh {k} {part}") for part in ("vertices", "faces", "joints", "weights", "targets", "morph_weights")),  # type: ignore[arg-type]
        )
        for k, name in enumerate(table["meshes"])
    )
    if not meshes:
        raise ValueError("holds no triangles that could drive an object")
    if sum(len(mesh.vertices) for mesh in meshes) > MAX_VERTICES:
        raise ValueError(f"its meshes have more than {MAX_VERTICES:,} vertices together")
    for name, values in arrays.items():
        if values.dtype.kind == "f" and not name.endswith("values") and not np.isfinite(values).all():
            raise ValueError(f"holds numbers that are not finite ({name})")
    skins = tuple(RigSkin(arrays[f"skin {k} joints"], arrays[f"skin {k} joint_from_mesh"]) for k in range(table["skins"]))
    placed = zip(table["nodes"], arrays["translations"], arrays["quats_xyzw"], arrays["scales"], strict=True)
    nodes = tuple(
        RigNode(
            entry["name"] or f"node {index}", entry["parent"], translation, quat, scale, None, entry["mesh"], entry["skin"], None, entry["shown"]
        )
        for index, (entry, translation, quat, scale) in enumerate(placed)
    )  # fmt: skip
    animations = tuple(_animation(arrays, nodes, meshes, number, entry) for number, entry in enumerate(table["animations"]))
    return Rig(nodes, _order(nodes), meshes, skins, animations)


def _order(nodes: tuple[RigNode, ...]) -> tuple[int, ...]:
    children: dict[int, list[int]] = {}
    for index, node in enumerate(nodes):
        children.setdefault(node.parent, []).append(index)
    order = list(children.get(-1, []))
    for index in order:  # grows while it is walked
        order.extend(children.get(index, []))
    return tuple(order)


def _animation(
    arrays: dict[str, np.ndarray], nodes: tuple[RigNode, ...], meshes: tuple[RigMesh, ...], number: int, entry: dict
) -> RigAnimation:
    channels = []
    for k, (node, path) in enumerate(entry["channels"]):
        times, values = arrays[f"channel {number} {k} times"], arrays[f"channel {number} {k} values"]
        if path == "weights":  # what no curve moves keeps its place
            shape = nodes[node].mesh
            assert shape is not None
            values = np.where(np.isnan(values), meshes[shape].morph_weights, values)
        if not np.isfinite(values).all() or not np.isfinite(times).all():
            raise ValueError(f"holds an animation whose numbers are not finite ({entry['name'][:40]!r})")
        channels.append(RigChannel(node, path, "LINEAR", times, values))
    return RigAnimation(entry["name"] or f"animation {number}", tuple(channels))
