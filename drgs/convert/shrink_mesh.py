"""A mesh with fewer faces: shape by quadric edge collapse, materials and normals as means of what they stand for.

In and out: a TriangleMesh. Corners at one place are joined first, so that faces which share none can shrink too.
"""

from collections.abc import Sequence

import fast_simplification
import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from scipy.spatial import cKDTree
from torch import Tensor

from drgs.maths.unique_rows import unique_rows
from drgs.scene.mesh import TriangleMesh

AGGRESSIVENESS = 5
"""Of fast_simplification: smaller keeps shape better, and takes longer."""


def shrink_mesh(mesh: TriangleMesh, most_faces: int) -> TriangleMesh:
    """The mesh with about `most_faces` faces or fewer; the mesh itself where it has no more."""
    return shrink_worn([mesh], most_faces)[0]


def shrink_worn(worn: Sequence[TriangleMesh], most_faces: int) -> list[TriangleMesh]:
    """`shrink_mesh` of one mesh in several materials, which still have their shape in common: what is left of it depends on nothing else."""
    mesh = worn[0]
    if len(mesh.faces) <= most_faces:
        return list(worn)
    points = mesh.vertices.double().numpy()
    low, extent = points.min(0), max(float(np.ptp(points, axis=0).max()), 1e-12)
    joined, place_of = (found.numpy() for found in unique_rows(torch.from_numpy(points)))
    corners = place_of[mesh.faces.numpy()]
    # In a box of length 1: the library takes small areas for none.
    simple, faces = fast_simplification.simplify(
        ((joined - low) / extent).astype(np.float32), corners.astype(np.int32), target_count=most_faces, agg=AGGRESSIVENESS
    )
    used, faces = np.unique(faces[_has_three_corners(faces)], return_inverse=True)
    vertices = simple[used].astype(np.float64) * extent + low
    materials = [torch.cat([one.albedo, one.roughness[:, None], one.metallic[:, None]], -1) for one in worn]
    values = torch.cat([mesh.normals, *materials], -1)
    normals, *means = torch.from_numpy(_means_around(vertices, points, values.double().numpy())).float().split([3, *[5] * len(worn)], dim=1)
    small = TriangleMesh(
        torch.from_numpy(vertices).float(),
        torch.from_numpy(faces.reshape(-1, 3)).int(),
        torch.nn.functional.normalize(normals, dim=-1),
        *_channels(means[0]),
    )
    return [small, *(TriangleMesh(small.vertices, small.faces, small.normals, *_channels(mean)) for mean in means[1:])]


def _channels(material: Float[Tensor, "vertex 5"]) -> tuple[Tensor, Tensor, Tensor]:
    """Albedo, roughness and metallic."""
    return material[:, :3].contiguous(), material[:, 3].contiguous(), material[:, 4].contiguous()


def _has_three_corners(faces: ndarray) -> ndarray:
    return (faces != np.roll(faces, 1, axis=1)).all(1)


def _means_around(
    vertices: Float[ndarray, "vertex 3"], points: Float[ndarray, "point 3"], values: Float[ndarray, "point channel"]
) -> Float[ndarray, "vertex channel"]:
    """Of each vertex the mean of the points that are nearest to it; the value of the nearest point where it is nearest to none."""
    _, owner = cKDTree(vertices).query(points)
    count = np.bincount(owner, minlength=len(vertices))
    sums = np.stack([np.bincount(owner, weights=channel, minlength=len(vertices)) for channel in values.T], -1)
    lonely = count == 0
    means = sums / np.maximum(count, 1)[:, None]
    if lonely.any():
        means[lonely] = values[cKDTree(points).query(vertices[lonely])[1]]
    return means
