"""What moves in a glTF file.

In: a .glb or .gltf file. Out: a `Rig`, in the file's own axes and units (y up, metres), everything checked: indices exist, the node tree is
a tree, keys rise in time. Materials, textures, cameras, lights, points and lines are passed over. Nothing is evaluated here
(drgs/deform/rig/skeleton.py does that). Source: glTF 2.0 specification, Khronos.
"""

from pathlib import Path

import numpy as np

from drgs.exchange.gltf_accessors import GltfFile, numbers, open_gltf, whole
from drgs.exchange.rig import MAX_NODES, MAX_VERTICES, Property, Rig, RigAnimation, RigChannel, RigMesh, RigNode, RigSkin

_WIDTHS = {"translation": 3, "rotation": 4, "scale": 3}


def read_gltf_rig(path: Path | str) -> Rig:
    """Read a file.

    Raises:
        ValueError: one sentence that names the file: missing, damaged, not glTF 2, compressed, or without any triangles.
    """
    path = Path(path)
    try:
        file = open_gltf(path)
        nodes, order = _nodes(file)
        meshes = _meshes(file)
        skins = tuple(_skin(file, skin, len(nodes)) for skin in file.items("skins"))
        _check_references(nodes, meshes, skins)
        animations = tuple(_animation(file, k, nodes, meshes) for k in range(len(file.items("animations"))))
    except (ValueError, OSError) as error:
        raise ValueError(f"{path}: {error}") from error
    except (KeyError, TypeError, AttributeError, IndexError, OverflowError) as error:
        raise ValueError(f"{path}: is not well-formed glTF ({type(error).__name__}: {str(error)[:80]})") from error
    return Rig(nodes, order, meshes, skins, animations)


def _name(item: dict, fallback: str) -> str:
    name = item.get("name")
    return name if isinstance(name, str) and name else fallback


def _nodes(file: GltfFile) -> tuple[tuple[RigNode, ...], tuple[int, ...]]:
    items = file.items("nodes")
    count = len(items)
    if not 1 <= count <= MAX_NODES:
        raise ValueError(f"holds {count} nodes; expected 1 to {MAX_NODES}")
    parents = [-1] * count
    for index, item in enumerate(items):
        for child in item.get("children", []):
            child = whole(child, count - 1, "a node's child")
            if parents[child] != -1:
                raise ValueError(f"its node {child} has two parents, {parents[child]} and {index}")
            parents[child] = index
    order = [index for index in range(count) if parents[index] == -1]
    for index in order:  # grows while it is walked
        order.extend(items[index].get("children", []))
    if len(order) != count:
        raise ValueError(f"its node {min(set(range(count)) - set(order))} is its own ancestor")
    shown = _shown(file, order, parents)
    return tuple(_node(item, index, parents[index], index in shown, file) for index, item in enumerate(items)), tuple(order)


def _shown(file: GltfFile, order: list[int], parents: list[int]) -> set[int]:
    """Nodes of the scene that the file opens with; all of them where it names no scene."""
    if not file.items("scenes"):
        return set(order)
    roots = file.item("scenes", file.document.get("scene", 0)).get("nodes", [])
    shown = {whole(root, len(order) - 1, "a scene's node") for root in roots}
    for index in order:
        if parents[index] in shown:
            shown.add(index)
    return shown


def _node(item: dict, index: int, parent: int, shown: bool, file: GltfFile) -> RigNode:
    name = _name(item, f"node {index}")
    matrix = None
    if "matrix" in item:
        matrix = numbers(item["matrix"], 16, f"the matrix of node {name[:40]!r}").reshape(4, 4).T
    quat = numbers(item.get("rotation", [0, 0, 0, 1]), 4, f"the rotation of node {name[:40]!r}")
    length = np.linalg.norm(quat)
    if length < 1e-6:
        raise ValueError(f"the rotation of node {name[:40]!r} is zero; expected a quaternion")
    weights = item.get("weights")
    return RigNode(
        name,
        parent,
        numbers(item.get("translation", [0, 0, 0]), 3, f"the translation of node {name[:40]!r}"),
        quat / length,
        numbers(item.get("scale", [1, 1, 1]), 3, f"the scale of node {name[:40]!r}"),
        matrix,
        whole(item["mesh"], len(file.items("meshes")) - 1, "a node's mesh") if "mesh" in item else None,
        whole(item["skin"], len(file.items("skins")) - 1, "a node's skin") if "skin" in item else None,
        None if weights is None else numbers(weights, len(weights), f"the weights of node {name[:40]!r}"),
        shown,
    )


def _meshes(file: GltfFile) -> tuple[RigMesh, ...]:
    meshes = []
    room = MAX_VERTICES
    for index, item in enumerate(file.items("meshes")):
        mesh = _mesh(file, item, index, room)
        room -= len(mesh.vertices)
        meshes.append(mesh)
    if not any(len(mesh.faces) for mesh in meshes):
        raise ValueError("holds no triangles that could drive an object")
    return tuple(meshes)


def _mesh(file: GltfFile, item: dict, index: int, room: int) -> RigMesh:
    name = _name(item, f"mesh {index}")
    parts = []
    for primitive in item["primitives"]:
        part = _primitive(file, primitive, name[:40], room)
        if part is not None:
            parts.append(part)
            room -= len(part.vertices)
    if not parts:
        return RigMesh(name, np.zeros((0, 3)), np.zeros((0, 3), np.int32), None, None, np.zeros((0, 0, 3)), np.zeros(0))
    target_count = len(parts[0].targets)
    if any(len(part.targets) != target_count for part in parts):
        raise ValueError(f"the primitives of its mesh {name[:40]!r} differ in their number of morph targets")
    joints = weights = None
    if all(part.joints is not None for part in parts):
        influences = max(part.joints.shape[1] for part in parts if part.joints is not None)
        joints = np.concatenate([_padded(part.joints, influences) for part in parts])
        weights = np.concatenate([_padded(part.weights, influences) for part in parts])
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    return RigMesh(
        name,
        np.concatenate([part.vertices for part in parts]),
        np.concatenate([part.faces + np.int32(start) for part, start in zip(parts, starts, strict=False)]),
        joints,
        weights,
        np.concatenate([part.targets for part in parts], 1),
        numbers(item.get("weights", [0] * target_count), target_count, f"the weights of mesh {name[:40]!r}"),
    )


def _padded(values: np.ndarray | None, width: int) -> np.ndarray:
    assert values is not None
    return np.pad(values, ((0, 0), (0, width - values.shape[1])))


def _primitive(file: GltfFile, primitive: dict, name: str, room: int) -> RigMesh | None:
    """One part of a mesh; None for points and lines."""
    mode = primitive.get("mode", 4)
    attributes = primitive["attributes"]
    if mode not in (4, 5, 6) or "POSITION" not in attributes:
        return None
    vertices = file.accessor(attributes["POSITION"], ("VEC3",), f"positions of mesh {name!r}").astype(np.float64)
    if len(vertices) > room:
        raise ValueError(f"its meshes have more than {MAX_VERTICES:,} vertices together")
    if "indices" in primitive:
        indices = file.accessor(primitive["indices"], ("SCALAR",), f"indices of mesh {name!r}")
        if indices.dtype.kind != "u" or (len(indices) and indices.max() >= len(vertices)):
            raise ValueError(f"a face of its mesh {name!r} names a vertex that does not exist ({len(vertices)} vertices)")
        indices = indices.astype(np.int32)
    else:
        indices = np.arange(len(vertices), dtype=np.int32)
    joints, weights = _influences(file, attributes, name, len(vertices))
    targets = primitive.get("targets", [])
    file.charge(len(targets) * vertices.size)
    moved = np.zeros((len(targets), len(vertices), 3))
    for k, target in enumerate(targets):
        if "POSITION" in target:
            shift = file.accessor(target["POSITION"], ("VEC3",), f"morph target {k} of mesh {name!r}")
            if len(shift) != len(vertices):
                raise ValueError(f"morph target {k} of its mesh {name!r} has {len(shift)} vertices; expected {len(vertices)}")
            moved[k] = shift
    return RigMesh(name, vertices, _triangles(indices, mode), joints, weights, moved, np.zeros(len(targets)))


def _triangles(indices: np.ndarray, mode: int) -> np.ndarray:
    """(face, 3) from a list (4), strip (5) or fan (6) of triangles; an incomplete last one is dropped."""
    if mode == 4:
        return indices[: len(indices) // 3 * 3].reshape(-1, 3)
    if len(indices) < 3:
        return np.zeros((0, 3), np.int32)
    if mode == 6:
        return np.stack([np.full(len(indices) - 2, indices[0]), indices[1:-1], indices[2:]], -1)
    faces = np.stack([indices[:-2], indices[1:-1], indices[2:]], -1)
    faces[1::2] = faces[1::2][:, [1, 0, 2]]
    return faces


def _influences(file: GltfFile, attributes: dict, name: str, count: int) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Joints and weights of all sets side by side; weights are made to sum to 1, a vertex without any follows its first joint."""
    joints: list[np.ndarray] = []
    weights: list[np.ndarray] = []
    while f"JOINTS_{len(joints)}" in attributes:
        k = len(joints)
        joint = file.accessor(attributes[f"JOINTS_{k}"], ("VEC4",), f"joints of mesh {name!r}")
        weight = file.accessor(attributes[f"WEIGHTS_{k}"], ("VEC4",), f"weights of mesh {name!r}")
        if joint.dtype.kind != "u" or weight.dtype.kind != "f" or len(joint) != count or len(weight) != count:
            raise ValueError(f"its mesh {name!r} has {count} vertices and joints and weights {k} that do not fit them")
        joints.append(joint.astype(np.int32))
        weights.append(weight.astype(np.float64))
    if not joints:
        return None, None
    joint, weight = np.concatenate(joints, 1), np.concatenate(weights, 1)
    if (weight < 0).any():
        raise ValueError(f"its mesh {name!r} has negative weights")
    total = weight.sum(1, keepdims=True)
    weight[total[:, 0] <= 0] = np.eye(1, weight.shape[1])
    weight /= np.where(total > 0, total, 1)
    joint[weight == 0] = 0  # what has no weight may name anything
    return joint, weight


def _skin(file: GltfFile, item: dict, node_count: int) -> RigSkin:
    joints = np.array([whole(joint, node_count - 1, "a skin's joint") for joint in item["joints"]], np.int32)
    if not len(joints):
        raise ValueError("holds a skin without joints")
    matrices = np.tile(np.eye(4), (len(joints), 1, 1))
    if "inverseBindMatrices" in item:
        stored = file.accessor(item["inverseBindMatrices"], ("MAT4",), "inverse bind matrices")
        if len(stored) < len(joints):
            raise ValueError(f"holds a skin of {len(joints)} joints with {len(stored)} inverse bind matrices")
        matrices = stored[: len(joints)].astype(np.float64).reshape(-1, 4, 4).transpose(0, 2, 1).copy()
        matrices[:, 3] = (0, 0, 0, 1)
    return RigSkin(joints, matrices)


def _check_references(nodes: tuple[RigNode, ...], meshes: tuple[RigMesh, ...], skins: tuple[RigSkin, ...]) -> None:
    """What joins nodes, meshes and skins must fit, for every node that shows a mesh."""
    total = 0
    for node in nodes:
        if node.mesh is None:
            continue
        mesh = meshes[node.mesh]
        total += len(mesh.vertices)
        if total > 2 * MAX_VERTICES:
            raise ValueError(f"shows its meshes so often that they have more than {2 * MAX_VERTICES:,} vertices")
        if node.morph_weights is not None and len(node.morph_weights) != len(mesh.targets):
            raise ValueError(f"node {node.name[:40]!r} has {len(node.morph_weights)} weights for {len(mesh.targets)} morph targets")
        if node.skin is not None and mesh.joints is not None and len(mesh.joints):
            used, there = int(mesh.joints.max()), len(skins[node.skin].joints)
            if used >= there:
                raise ValueError(f"its mesh {mesh.name[:40]!r} names joint {used} of a skin that has {there}")


def _animation(file: GltfFile, index: int, nodes: tuple[RigNode, ...], meshes: tuple[RigMesh, ...]) -> RigAnimation:
    item = file.item("animations", index)
    name = _name(item, f"animation {index}")
    samplers = item["samplers"]
    channels = []
    for channel in item["channels"]:
        target = channel["target"]
        path = target.get("path")
        if "node" not in target or path not in (*_WIDTHS, "weights"):
            continue  # what an extension moves is no concern of ours
        node = whole(target["node"], len(nodes) - 1, f"a node of animation {name[:40]!r}")
        sampler = samplers[whole(channel["sampler"], len(samplers) - 1, f"a sampler of animation {name[:40]!r}")]
        width = _WIDTHS.get(path)
        if width is None:
            shape = nodes[node].mesh
            width = 0 if shape is None else len(meshes[shape].targets)
            if width == 0:
                continue
        channels.append(_channel(file, sampler, node, path, width, f"animation {name[:40]!r}"))
    return RigAnimation(name, tuple(channels))


def _channel(file: GltfFile, sampler: dict, node: int, path: Property, width: int, what: str) -> RigChannel:
    interpolation = sampler.get("interpolation", "LINEAR")
    if interpolation not in ("STEP", "LINEAR", "CUBICSPLINE"):
        raise ValueError(f"{what} has the interpolation {str(interpolation)[:20]!r}; expected STEP, LINEAR or CUBICSPLINE")
    times = file.accessor(sampler["input"], ("SCALAR",), f"times of {what}").astype(np.float64)
    kind = {"rotation": "VEC4", "weights": "SCALAR"}.get(path, "VEC3")
    values = file.accessor(sampler["output"], (kind,), f"values of {what}").astype(np.float64)
    if not len(times) or times[0] < 0 or (np.diff(times) < 0).any():
        raise ValueError(f"the times of {what} do not rise from 0")
    parts = 3 if interpolation == "CUBICSPLINE" else 1
    if values.size != len(times) * parts * width:
        raise ValueError(f"{what} has {values.size} numbers for {len(times)} times; expected {len(times) * parts * width}")
    values = values.reshape((len(times), 3, width) if parts == 3 else (len(times), width))
    if path == "rotation" and (np.linalg.norm(values[:, 1] if parts == 3 else values, axis=-1) < 1e-6).any():
        raise ValueError(f"{what} has a rotation that is zero; expected quaternions")
    return RigChannel(node, path, interpolation, times, values)
