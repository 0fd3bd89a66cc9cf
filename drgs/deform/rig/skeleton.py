"""A rig at a time of one of its animations: where the vertices of its meshes are.

In: a `Rig` as its file holds it. Out: all shown meshes as one list of triangles, in the axes and units of the file, float64. Keys are
interpolated as glTF says (step, linear, spherical, cubic spline), nodes follow their parents, morph targets are added, skins blend
linearly. Normals and deformation gradients come from the moved triangles, not from the blend of the joints' matrices, which leaves out how
weights change from vertex to vertex. It does not know what the rig drives (proxy.py). Source: glTF 2.0 specification, appendix C.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy import ndarray
from torch import Tensor

from drgs.deform.carry.drive_mesh import vertex_gradients
from drgs.exchange.rig import Rig, RigAnimation, RigChannel, RigMesh, RigNode
from drgs.maths.unique_rows import unique_rows
from drgs.scene.mesh import face_areas

NEARLY_ALIKE = 1 - 1e-9
"""Cosine of half the angle between rotations above which they are blended straight: the sphere's formula divides by its sine."""


@dataclass(frozen=True, eq=False)
class RigPose:
    """A rig's triangles at one time. float64, in the file's axes and units."""

    vertices: Float[Tensor, "vertex 3"]
    faces: Int[Tensor, "face 3"]
    """int32, the same at all times."""
    parts: Int[Tensor, "vertex"]
    """int32: which of the shown meshes a vertex belongs to."""


def pose_rig(rig: Rig, animation: RigAnimation | None = None, seconds: float = 0.0) -> RigPose:
    """All shown meshes; without an animation, as the nodes stand in the file.

    Before an animation's first key and after its last, that key holds.

    Raises:
        ValueError: the pose is not finite.
    """
    world_from_node, morph_weights = _node_states(rig, animation, seconds)
    vertices, faces, parts, count = [], [], [], 0
    for index, node in enumerate(rig.nodes):
        if node.mesh is None or not node.shown:
            continue
        mesh = rig.meshes[node.mesh]
        shape = mesh.vertices
        weights = morph_weights.get(index, mesh.morph_weights if node.morph_weights is None else node.morph_weights)
        if weights.any():
            shape = shape + np.tensordot(weights, mesh.targets, 1)
        vertices.append(_skinned(rig, mesh, node, index, shape, world_from_node))
        faces.append(mesh.faces + count)
        parts.append(np.full(len(shape), index, np.int32))
        count += len(shape)
    if not count:
        raise ValueError("its scene shows no triangles")
    moved = np.concatenate(vertices)
    if not np.isfinite(moved).all():
        raise ValueError(f"its vertices are not finite at {seconds:g} s")
    return RigPose(*(torch.from_numpy(array) for array in (moved, np.concatenate(faces).astype(np.int32), np.concatenate(parts))))


def rig_gradients(rest: RigPose, moved: RigPose) -> Float[Tensor, "vertex 3 3"]:
    """(vertex, 3, 3) float64 deformation gradients; a part's vertices in one place at rest (seams of texture) share theirs."""
    gradient = vertex_gradients(rest.vertices, moved.vertices, rest.faces)
    area = face_areas(rest.vertices, rest.faces)
    weight = torch.zeros(len(rest.vertices), dtype=torch.float64).index_add_(0, rest.faces.reshape(-1).long(), area.repeat_interleave(3))
    _, place = unique_rows(torch.cat([rest.vertices, rest.parts[:, None].double()], 1))
    total = torch.zeros(int(place.max()) + 1, dtype=torch.float64).index_add_(0, place, weight)
    mean = torch.zeros(len(total), 3, 3, dtype=torch.float64).index_add_(0, place, gradient * weight[:, None, None])
    shared = mean / total.clamp(min=1e-300)[:, None, None]
    return torch.where((total > 0)[place][:, None, None], shared[place], gradient)


def sample_channel(channel: RigChannel, seconds: float) -> Float[ndarray, "width"]:
    """(width,) value at a time; rotations xyzw and of unit length."""
    times, values = channel.times, channel.values
    turns = channel.path == "rotation"
    key = int(np.searchsorted(times, seconds, side="right")) - 1
    cubic = channel.interpolation == "CUBICSPLINE"
    if key < 0 or key == len(times) - 1 or channel.interpolation == "STEP":
        value = values[max(key, 0), 1] if cubic else values[max(key, 0)]
        return _unit(value) if turns else value
    span = times[key + 1] - times[key]
    t = (seconds - times[key]) / span
    if cubic:
        value = _hermite(values[key, 1], span * values[key, 2], values[key + 1, 1], span * values[key + 1, 0], t)
        return _unit(value) if turns else value
    if turns:
        return slerp(_unit(values[key]), _unit(values[key + 1]), t)
    return (1 - t) * values[key] + t * values[key + 1]


def slerp(first_quat: Float[ndarray, "4"], second_quat: Float[ndarray, "4"], t: float) -> Float[ndarray, "4"]:
    """(4,) between unit quaternions (4,), the shorter way and at even speed."""
    cosine = float(first_quat @ second_quat)
    if cosine < 0:
        cosine, second_quat = -cosine, -second_quat
    if cosine > NEARLY_ALIKE:
        return _unit((1 - t) * first_quat + t * second_quat)
    angle = np.arccos(cosine)
    return _unit((np.sin((1 - t) * angle) * first_quat + np.sin(t * angle) * second_quat) / np.sin(angle))


def _hermite(
    start: Float[ndarray, "width"],
    start_slope: Float[ndarray, "width"],
    end: Float[ndarray, "width"],
    end_slope: Float[ndarray, "width"],
    t: float,
) -> Float[ndarray, "width"]:
    """The cubic with these values and slopes (a span, not a second) at t = 0 and 1."""
    bend = t * t * (3 - 2 * t)
    return (1 - bend) * start + bend * end + t * (1 - t) ** 2 * start_slope - t * t * (1 - t) * end_slope


def _unit(quat: Float[ndarray, "4"]) -> Float[ndarray, "4"]:
    length = np.linalg.norm(quat)
    # Halfway between opposite keys a spline may pass through zero, which is no rotation.
    return quat / length if length > 1e-12 else np.array([0.0, 0, 0, 1])


def _node_states(rig: Rig, animation: RigAnimation | None, seconds: float) -> tuple[np.ndarray, dict[int, np.ndarray]]:
    """(node, 4, 4) world from node, and morph weights of the nodes whose weights are animated."""
    moved: dict[int, dict[str, np.ndarray]] = {}
    for channel in () if animation is None else animation.channels:
        moved.setdefault(channel.node, {})[channel.path] = sample_channel(channel, seconds)
    world = np.empty((len(rig.nodes), 4, 4))
    for index in rig.order:
        node = rig.nodes[index]
        local = _local(node, moved.get(index, {}))
        world[index] = local if node.parent < 0 else world[node.parent] @ local
    return world, {index: parts["weights"] for index, parts in moved.items() if "weights" in parts}


def _local(node: RigNode, moved: dict[str, np.ndarray]) -> Float[ndarray, "4 4"]:
    """(4, 4) parent from node."""
    if node.matrix is not None:
        return node.matrix
    x, y, z, w = moved.get("rotation", node.quat_xyzw)
    rotation = np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip
    local = np.eye(4)
    local[:3, :3] = rotation * moved.get("scale", node.scale)
    local[:3, 3] = moved.get("translation", node.translation)
    return local


def _skinned(
    rig: Rig, mesh: RigMesh, node: RigNode, index: int, shape: Float[ndarray, "vertex 3"], world_from_node: Float[ndarray, "node 4 4"]
) -> Float[ndarray, "vertex 3"]:
    """(vertex, 3) world. A skin's joints alone place its mesh: the node that shows it does not count."""
    if node.skin is None or mesh.joints is None or mesh.weights is None:
        return shape @ world_from_node[index, :3, :3].T + world_from_node[index, :3, 3]
    skin = rig.skins[node.skin]
    world_from_mesh = (world_from_node[skin.joints] @ skin.joint_from_mesh)[:, :3]
    total = np.zeros_like(shape)
    for joint, weight in zip(mesh.joints.T, mesh.weights.T, strict=True):
        matrix = world_from_mesh[joint]
        total += weight[:, None] * (np.einsum("vij,vj->vi", matrix[:, :, :3], shape) + matrix[:, :, 3])
    return total
