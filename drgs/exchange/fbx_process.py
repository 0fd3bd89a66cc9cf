"""A process of its own that reads one FBX file by ufbx and writes what moves in it as arrays: `fbx_process.py FILE OUT.npz`.

Why a process: ufbx's Python binding (0.0.5, the newest there is) counts too few references to the elements that its lists hand out, and to
lists that numpy reads as buffers. They are freed while they are in use, and the interpreter crashes, now or at the next garbage collection.
Here elements are counted once more, lists are read number by number, no garbage is collected, and the process ends without tidying up.
Besides, a file that breaks a parser written in C then breaks nothing else.

`fbx_rig.py` starts it and makes records of the arrays; the names in the .npz are theirs. Complaints go to stderr, with exit status 3. Runs by
its path: it imports nothing of this package.
"""

import ctypes
import gc
import json
import os
import sys
from collections.abc import Iterator
from typing import Any

import numpy as np
import ufbx

REFUSED = 3
SAMPLES_A_SECOND = 30.0
"""Of what turns, and of curved curves: FBX interpolates Euler angles, a rig its quaternions."""
MOST_SAMPLES_A_KEY = 4096
MAX_TARGET_VALUES = 64_000_000
_count_reference = ctypes.pythonapi.Py_IncRef
_count_reference.argtypes, _count_reference.restype = [ctypes.py_object], None


def main(source: str, out: str) -> None:
    gc.disable()
    try:
        scene = ufbx.load_file(
            source,
            file_format=ufbx.FileFormat.FBX,
            target_axes=ufbx.axes_right_handed_y_up,
            target_unit_meters=1.0,
            inherit_mode_handling=ufbx.InheritModeHandling.HELPER_NODES,
        )
        arrays = read_scene(scene)
    except ufbx.UfbxError as error:
        print(f"is no FBX file, or a damaged one ({error})", file=sys.stderr)
        leave(REFUSED)
    except ValueError as error:
        print(error, file=sys.stderr)
        leave(REFUSED)
    np.savez(out, allow_pickle=False, **arrays)
    leave(0)


def leave(status: int) -> None:
    """End without freeing anything."""
    sys.stderr.flush()
    os._exit(status)


def items(elements: Any) -> Iterator[Any]:
    """What one of ufbx's lists holds, never to be freed."""
    for index in range(len(elements)):
        element = elements[index]
        _count_reference(element)
        yield element


def numbers(values: Any, dtype: Any, width: int = 1) -> np.ndarray:
    """(n,) or (n, width) of a list of numbers or tuples."""
    found = np.array(list(values), dtype)
    return found if width == 1 else found.reshape(-1, width)


def read_scene(scene: Any) -> dict[str, np.ndarray]:
    nodes = list(items(scene.nodes))
    arrays: dict[str, np.ndarray] = {
        "translations": np.array([node.local_transform.translation for node in nodes], np.float64),
        "quats_xyzw": np.array([node.local_transform.rotation for node in nodes], np.float64),
        "scales": np.array([node.local_transform.scale for node in nodes], np.float64),
    }
    table: dict[str, Any] = {"nodes": [], "meshes": [], "skins": 0, "animations": []}
    channels: list[tuple[int, list[int]]] = []
    """Of each mesh: its node, and the elements whose weights its morph targets have."""
    for index, node in enumerate(nodes):
        entry = {"name": node.name, "parent": -1 if node.parent is None else node.parent.typed_id, "mesh": None, "skin": None}
        entry["shown"] = bool(node.visible)
        if node.mesh is not None and len(triangles(node.mesh)):
            entry["mesh"] = len(table["meshes"])
            shape = read_mesh(node.mesh, node)
            skin = shape.pop("skin", None)
            if skin is not None:
                entry["skin"] = table["skins"]
                arrays |= {f"skin {table['skins']} {key}": value for key, value in skin.items()}
                table["skins"] += 1
            channels.append((index, shape.pop("channels")))
            arrays |= {f"mesh {entry['mesh']} {key}": value for key, value in shape.items()}
            table["meshes"].append(node.mesh.name)
        table["nodes"].append(entry)
    for stack in items(scene.anim_stacks):
        moving = read_animation(scene, stack, channels)
        number = len(table["animations"])
        table["animations"].append({"name": stack.name, "channels": [key for key, *_ in moving]})
        for k, (_, times, values) in enumerate(moving):
            arrays |= {f"channel {number} {k} times": times, f"channel {number} {k} values": values}
    arrays["table"] = np.frombuffer(json.dumps(table).encode(), np.uint8)
    return arrays


def triangles(mesh: Any) -> np.ndarray:
    """(face, 3) control points; polygons are cut into fans."""
    faces = numbers(mesh.faces, np.int64, 2)
    cuts = np.maximum(faces[:, 1] - 2, 0)
    start = np.repeat(faces[:, 0], cuts)
    step = np.arange(len(start)) - np.repeat(np.cumsum(cuts) - cuts, cuts)
    corners = np.stack([start, start + step + 1, start + step + 2], -1)
    return numbers(mesh.vertex_indices, np.int64)[corners].astype(np.int32)


def read_mesh(mesh: Any, node: Any) -> dict[str, Any]:
    """The mesh that a node shows: in the node's frame, or where a skin moves it in its own."""
    if len(mesh.cache_deformers):
        raise ValueError(f"moves its mesh {mesh.name[:40]!r} by a cache of vertices; expected a skin or morph targets")
    vertices = numbers(mesh.vertices, np.float64, 3)
    targets, weights, channels = read_targets(mesh, len(vertices))
    shape: dict[str, Any] = {"faces": triangles(mesh), "morph_weights": weights, "channels": channels}
    if len(mesh.skin_deformers):
        shape |= read_skin(mesh, node, len(vertices))
    else:
        node_from_mesh = matrix(node.geometry_to_node)
        vertices = vertices @ node_from_mesh[:3, :3].T + node_from_mesh[:3, 3]
        targets = targets @ node_from_mesh[:3, :3].T
    return shape | {"vertices": vertices, "targets": targets}


def read_targets(mesh: Any, count: int) -> tuple[np.ndarray, np.ndarray, list[int]]:
    """(target, vertex, 3) displacements, (target,) weights at rest, and the elements that hold them."""
    channels = [channel for deformer in items(mesh.blend_deformers) for channel in items(deformer.channels) if len(channel.keyframes)]
    if len(channels) * count * 3 > MAX_TARGET_VALUES:
        raise ValueError(f"its mesh {mesh.name[:40]!r} has {len(channels)} morph targets of {count} vertices; that is more than is read")
    targets = np.zeros((len(channels), count, 3))
    for target, channel in zip(targets, channels, strict=True):
        if len(channel.keyframes) > 1:
            raise ValueError(f"its morph target {channel.name[:40]!r} has shapes in between, which are not read")
        (key,) = items(channel.keyframes)
        target[numbers(key.shape.offset_vertices, np.int64)] = numbers(key.shape.position_offsets, np.float64, 3)
        target /= key.target_weight
    return targets, np.array([channel.weight for channel in channels], np.float64), [channel.element_id for channel in channels]


def read_skin(mesh: Any, node: Any, count: int) -> dict[str, Any]:
    """Joints and weights (vertex, influence), and the skin's own arrays; vertices that no bone holds follow the node."""
    skins = list(items(mesh.skin_deformers))
    if len(skins) > 1:
        raise ValueError(f"its mesh {mesh.name[:40]!r} has {len(skins)} skins; expected one")
    if skins[0].skinning_method not in (ufbx.SkinningMethod.LINEAR, ufbx.SkinningMethod.RIGID):
        raise ValueError(f"skins its mesh {mesh.name[:40]!r} by dual quaternions, which are not read; make the skin linear")
    clusters = [cluster for cluster in items(skins[0].clusters) if cluster.bone_node is not None]
    held = [numbers(cluster.vertices, np.int64) for cluster in clusters]
    vertex = np.concatenate([*held, np.zeros(0, np.int64)])
    weight = np.concatenate([*(numbers(cluster.weights, np.float64) for cluster in clusters), np.zeros(0)])
    joint = np.repeat(np.arange(len(clusters)), [len(vertices) for vertices in held])
    known = (vertex < count) & (weight > 0)
    vertex, weight, joint = vertex[known], weight[known], joint[known]
    free = np.setdiff1d(np.arange(count), vertex)
    vertex = np.concatenate([vertex, free])
    weight = np.concatenate([weight, np.ones(len(free))])
    joint = np.concatenate([joint, np.full(len(free), len(clusters))])
    order = np.argsort(vertex, kind="stable")
    vertex, weight, joint = vertex[order], weight[order], joint[order]
    influences = np.bincount(vertex, minlength=count)
    column = np.arange(len(vertex)) - np.repeat(np.cumsum(influences) - influences, influences)
    joints, weights = np.zeros((count, influences.max(initial=1)), np.int32), np.zeros((count, influences.max(initial=1)))
    joints[vertex, column], weights[vertex, column] = joint, weight
    skin = {
        "joints": np.array([*(cluster.bone_node.typed_id for cluster in clusters), node.typed_id], np.int32),
        "joint_from_mesh": np.stack([*(matrix(cluster.geometry_to_bone) for cluster in clusters), matrix(node.geometry_to_node)]),
    }
    return {"joints": joints, "weights": weights / weights.sum(1, keepdims=True), "skin": skin}


def matrix(columns: Any) -> np.ndarray:
    """(4, 4)"""
    return np.concatenate([np.array(columns, np.float64).T, [[0, 0, 0, 1]]])


def read_animation(scene: Any, stack: Any, channels: list[tuple[int, list[int]]]) -> list[tuple[list, np.ndarray, np.ndarray]]:
    """[node, property], times and values of all that moves, to be joined by lines."""
    baked = ufbx.bake_anim(
        scene,
        stack.anim,
        trim_start_time=True,
        resample_rate=SAMPLES_A_SECOND,
        max_keyframe_segments=MOST_SAMPLES_A_KEY,
        # A step becomes two keys as close as numbers can be: times rise, and lines join them.
        step_handling=ufbx.BakeStepHandling.ADJACENT_DOUBLE,
    )
    duration = baked.playback_duration
    moving = []
    for node in items(baked.nodes):
        for path, keys in (("translation", node.translation_keys), ("rotation", node.rotation_keys), ("scale", node.scale_keys)):
            found = list(items(keys))
            if found:
                times, values = np.array([key.time for key in found]), np.array([key.value for key in found])
                moving.append(([node.typed_id, path], *within(times, values, duration)))
    percents = {
        element.element_id: prop for element in items(baked.elements) for prop in items(element.props) if prop.name == "DeformPercent"
    }
    for node, elements in channels:
        known = [list(items(percents[element].keys)) if element in percents else [] for element in elements]
        times = np.unique([key.time for keys in known for key in keys])
        if len(times):
            columns = [
                np.interp(times, [key.time for key in keys], [key.value.x / 100 for key in keys]) if keys else np.full(len(times), np.nan)
                for keys in known
            ]
            moving.append(([node, "weights"], *within(times, np.stack(columns, -1), duration)))
    return moving


def within(times: np.ndarray, values: np.ndarray, duration: float) -> tuple[np.ndarray, np.ndarray]:
    """What lies in the part of the curves that is played, from 0 to `duration`; all of it where the file names no part."""
    if duration <= 0:
        return times, values
    kept = np.concatenate([[0.0], times[(times > 0) & (times < duration)], [duration]])
    return kept, np.stack([np.interp(kept, times, column) for column in values.T], -1)


if __name__ == "__main__":
    main(*sys.argv[1:])
