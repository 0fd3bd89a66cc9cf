"""Means over neighbourhoods of a mesh, as a sparse matrix."""

import numpy as np
import torch
from jaxtyping import Float
from scipy.sparse import csr_matrix, diags, identity
from torch import Tensor

from drgs.reconstruct.geometry.mesh_edges import MeshEdges


def averaging_matrix(edges: MeshEdges, count: int, weight: Float[Tensor, "edge"] | None = None) -> csr_matrix:
    """(count, count) matrix that takes the mean over each vertex and its neighbours.

    Args:
        weight: of a neighbour at the other end of each edge, against 1 of the vertex itself; None: 1.
    """
    start, end = edges.vertices.cpu().numpy().T
    weights = np.tile(np.ones(len(start)) if weight is None else weight.cpu().double().numpy(), 2)
    adjacency = csr_matrix((weights, (np.concatenate([start, end]), np.concatenate([end, start]))), shape=(count, count)) + identity(count)
    return diags(1 / np.asarray(adjacency.sum(1)).ravel()) @ adjacency


def rings_as_wide_as(width: float, edges: MeshEdges, vertices: Float[Tensor, "vertex 3"]) -> int:
    """How often to average for a mean that is `width` wide (standard deviation along each axis, in units of the vertices); at least once."""
    start, end = vertices[edges.vertices].unbind(1)
    # A mean over neighbours is as wide as 0.65 edges along each axis, and squares of widths add.
    return max(1, round((width / (0.65 * float((start - end).norm(dim=1).mean()))) ** 2))


def averaged(around: csr_matrix, values: Tensor, rings: int) -> Tensor:
    """Values (vertex, k), averaged `rings` times by an averaging_matrix."""
    result = values.cpu().double().numpy()
    for _ in range(rings):
        result = around @ result
    return torch.from_numpy(result).to(values)
