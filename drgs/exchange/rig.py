"""What moves in a file: nodes, skins, meshes with joints and weights, morph targets and animations, as plain arrays.

`gltf_rig.py` and `fbx_rig.py` read them, drgs/deform/rig/skeleton.py evaluates them. Axes and units are glTF's: y up, metres.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

MAX_VERTICES = 2_000_000
"""Of all meshes together; a rig that drives an object has some thousand."""
MAX_NODES = 100_000
Property = Literal["translation", "rotation", "scale", "weights"]


@dataclass(frozen=True, eq=False)
class RigNode:
    """A place in the hierarchy. Arrays are float64."""

    name: str
    parent: int
    """Index of a node; -1 for a root."""
    translation: np.ndarray
    """(3,)"""
    quat_xyzw: np.ndarray
    """(4,), unit."""
    scale: np.ndarray
    """(3,)"""
    matrix: np.ndarray | None
    """(4, 4) parent from node, where the file gives a matrix and not its parts; such a node is not animated."""
    mesh: int | None
    skin: int | None
    morph_weights: np.ndarray | None
    """(target,) instead of the mesh's own."""
    shown: bool
    """Belongs to the scene; joints need not."""


@dataclass(frozen=True, eq=False)
class RigMesh:
    """Triangles of one mesh, its primitives joined. Arrays are float64 unless said otherwise."""

    name: str
    vertices: np.ndarray
    """(vertex, 3)"""
    faces: np.ndarray
    """(face, 3) int32"""
    joints: np.ndarray | None
    """(vertex, influence) int32 into a skin's joints; None for a mesh that no skin may move."""
    weights: np.ndarray | None
    """(vertex, influence), each row sums to 1."""
    targets: np.ndarray
    """(target, vertex, 3) displacements; (0, vertex, 3) without morph targets."""
    morph_weights: np.ndarray
    """(target,) at rest."""


@dataclass(frozen=True, eq=False)
class RigSkin:
    joints: np.ndarray
    """(joint,) int32 node indices."""
    joint_from_mesh: np.ndarray
    """(joint, 4, 4) float64: inverse bind matrices."""


@dataclass(frozen=True, eq=False)
class RigChannel:
    """How one property of one node changes."""

    node: int
    path: Property
    interpolation: Literal["STEP", "LINEAR", "CUBICSPLINE"]
    times: np.ndarray
    """(key,) float64 seconds, not falling."""
    values: np.ndarray
    """(key, width) float64; (key, 3, width) in-tangent, value, out-tangent for CUBICSPLINE."""


@dataclass(frozen=True, eq=False)
class RigAnimation:
    name: str
    channels: tuple[RigChannel, ...]

    @property
    def duration(self) -> float:
        """Seconds to the last key."""
        return max((float(channel.times[-1]) for channel in self.channels), default=0.0)


@dataclass(frozen=True, eq=False)
class Rig:
    nodes: tuple[RigNode, ...]
    order: tuple[int, ...]
    """Every node after its parent."""
    meshes: tuple[RigMesh, ...]
    skins: tuple[RigSkin, ...]
    animations: tuple[RigAnimation, ...]
