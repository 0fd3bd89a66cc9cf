"""Which joints move which vertex, and how much: heat that flows from the bones into the skin and stays where it came in.

In: a closed surface, and of whose part each vertex is. Out: four joints a vertex and their weights. For each joint, -L w + M H w = M H p with L the
cotangent Laplacian, M the vertices' areas, p 1 where the joint's part is nearest, and H the inverse square of the distance to that joint's bones: near
bones hold their skin, and between them weights pass smoothly along the surface, so that one leg knows nothing of the other. Source: Baran and Popović
2007, section 4 (docs/sources.md: baran2007); there a bone holds what it sees through the body, here the part that was modelled around it.
"""

from dataclasses import dataclass

import igl
import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from scipy import sparse
from scipy.sparse.linalg import splu

from benchmarks.paper.character.body import Body
from benchmarks.paper.character.skeleton import JOINTS, Point, bones

HELD = 3.0
"""How firmly bones hold their skin; the source's is 1, with which a head bends with its neck."""
INFLUENCES = 4
"""Joints a vertex at most, which is what programs read."""
NEAREST = 0.02
"""Of distances to bones [world units]: a vertex on a bone would be held infinitely firmly."""


@dataclass(frozen=True, eq=False)
class SkinWeights:
    """Most weight first."""

    joints: Int[ndarray, "vertex 4"]
    """Places in JOINTS."""
    weights: Float[ndarray, "vertex 4"]
    """Not negative; each row sums to 1."""


def skin_weights(body: Body) -> SkinWeights:
    """Of each vertex of the body at rest."""
    vertices, faces = body.mesh.vertices.double().numpy(), body.mesh.faces.numpy().astype(np.int64)
    areas = igl.massmatrix(vertices, faces, igl.MASSMATRIX_TYPE_BARYCENTRIC)
    held = np.zeros(len(vertices))
    for place in np.unique(body.joint):
        own = body.joint == place
        away = np.min([distance_to_line(vertices[own], bone) for bone in bones(JOINTS[place].name)], axis=0)
        held[own] = HELD / np.maximum(away, NEAREST) ** 2
    inflow = areas @ sparse.diags(held)
    owned = np.eye(len(JOINTS))[body.joint]
    solved = splu((inflow - igl.cotmatrix(vertices, faces)).tocsc()).solve(inflow @ owned)
    # Obtuse triangles leave values a little below zero.
    solved = solved.clip(0)
    joints = np.argsort(-solved, axis=1, kind="stable")[:, :INFLUENCES]
    weights = np.take_along_axis(solved, joints, 1)
    return SkinWeights(joints, weights / weights.sum(1, keepdims=True))


def distance_to_line(points: Float[ndarray, "point 3"], bone: tuple[Point, Point]) -> Float[ndarray, "point"]:
    """To a line with two ends [world units]."""
    start, along = np.array(bone[0]), np.subtract(bone[1], bone[0])
    share = ((points - start) @ along / (along @ along)).clip(0, 1)
    return np.linalg.norm(points - start - share[:, None] * along, axis=1)
