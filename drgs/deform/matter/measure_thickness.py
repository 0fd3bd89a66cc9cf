"""How thick an object is below its surface, and which parts of it are thin.

In: a triangle mesh whose faces look outwards. Out: for each face the length of the ray that goes straight inwards from its middle to the other
side. Knows nothing of what thinness means for who asks.
"""

from dataclasses import dataclass

import numpy as np
import torch
import warp as wp
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from drgs.maths.constants import UNBOUNDED
from drgs.maths.unique_rows import unique_rows
from drgs.warp_torch import launch, warp_array, warp_device

wp.set_module_options({"enable_backward": False})

LEAST_SHARE = 0.005
"""Of the surface's area: thin parts that are smaller are edges and flaws of the mesh."""


@dataclass(frozen=True)
class ThinPart:
    """A connected part of a surface below which the object is thin."""

    middle: tuple[float, float, float]
    """By area, world units."""
    thickness: float
    """Median by face, world units."""
    share: float
    """Of the whole surface's area."""


@wp.kernel
def find_other_side(
    first: int,
    mesh: wp.uint64,
    points: wp.array[wp.vec3],
    inward: wp.array[wp.vec3],
    lift: float,
    reach: float,
    # outputs
    thickness: wp.array[float],
):
    i = first + wp.tid()
    query = wp.mesh_query_ray(mesh, points[i] + lift * inward[i], inward[i], reach)
    found = wp.float32(UNBOUNDED)
    if query.result:
        found = query.t + lift
    thickness[i] = found


def measure_thickness(
    tree: wp.Mesh, vertices: Float[Tensor, "vertex 3"], faces: Int[Tensor, "face 3"], reach: float
) -> Float[Tensor, "face"]:
    """(face,) length of the ray inwards from the middle of each face; UNBOUNDED where it meets nothing within `reach`.

    Args:
        tree: of the same vertices (vertex, 3) and faces (face, 3).
    """
    corners = vertices[faces.long()]
    inward = -torch.nn.functional.normalize(
        torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), dim=-1, eps=1e-30
    )
    centers, thickness = corners.mean(1).contiguous(), torch.empty(len(faces), device=vertices.device)
    lift = 1e-4 * reach  # off the face itself
    inputs = [tree.id, warp_array(centers, wp.vec3), warp_array(inward.contiguous(), wp.vec3), lift, reach]
    launch(find_other_side, len(centers), inputs, [warp_array(thickness)], warp_device(vertices))
    return thickness


def share_of_area(vertices: Float[Tensor, "vertex 3"], faces: Int[Tensor, "face 3"], chosen: Bool[Tensor, "face"]) -> float:
    """Area of the chosen (face,) faces as a part of that of all."""
    area = _areas(vertices, faces)
    return float(area[chosen].sum() / area.sum())


def thin_parts(
    vertices: Float[Tensor, "vertex 3"], faces: Int[Tensor, "face 3"], thickness: Float[Tensor, "face"], thinner_than: float
) -> tuple[ThinPart, ...]:
    """Connected parts of the surface where the object is thinner, the largest first; none below LEAST_SHARE."""
    thin = thickness < thinner_than
    if share_of_area(vertices, faces, thin) < LEAST_SHARE:
        return ()
    area = _areas(vertices, faces)
    shares = (area[thin] / area.sum()).cpu().numpy()
    middles, lengths = vertices.double()[faces[thin].long()].mean(1).cpu().numpy(), thickness[thin].cpu().numpy()
    linked = welded(vertices)[faces[thin].long().cpu().numpy()]
    pairs = np.concatenate([linked[:, [0, 1]], linked[:, [1, 2]]])
    count = int(linked.max()) + 1
    graph = coo_matrix((np.ones(len(pairs), np.int8), (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    _, label = connected_components(graph, directed=False)
    part = label[linked[:, 0]]
    total = np.bincount(part, shares)
    found = []
    for index in np.argsort(-total, kind="stable"):
        if total[index] < LEAST_SHARE:
            break
        held = part == index
        x, y, z = np.average(middles[held], axis=0, weights=shares[held]).tolist()
        found.append(ThinPart((x, y, z), float(np.median(lengths[held])), float(total[index])))
    return tuple(found)


def welded(vertices: Float[Tensor, "vertex 3"]) -> Int[ndarray, "vertex"]:
    """(vertex,) a number for each place: vertices at one place have one number."""
    where = vertices.double().cpu().numpy()
    extent = float(np.ptp(where, axis=0).max()) or 1.0
    return unique_rows(torch.from_numpy(np.round((where - where.min(0)) / (extent * 1e-6)).astype(np.int64)))[1].numpy()


def _areas(vertices: Float[Tensor, "vertex 3"], faces: Int[Tensor, "face 3"]) -> Float[Tensor, "face"]:
    """(face,) float64"""
    a, b, c = vertices.double()[faces.long()].unbind(1)
    return torch.linalg.cross(b - a, c - a).norm(dim=-1) / 2
