"""Means over neighbourhoods of a mesh, as a sparse matrix."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from drgs.reconstruct.geometry.mesh_edges import MeshEdges
from drgs.reconstruct.geometry.symmetric_systems import SymmetricPlaces


@dataclass(frozen=True, eq=False)
class Averaging:
    """Takes the mean over each vertex and its neighbours; on the CPU."""

    neighbours: Tensor
    """(vertex, vertex) sparse: weights of neighbours, float64."""
    total: Float64[Tensor, "vertex 1"]
    """Of their weights and the vertex's own, 1."""


def averaging_matrix(edges: MeshEdges, count: int, weight: Float[Tensor, "edge"] | None = None) -> Averaging:
    """Of a mesh's vertices.

    Args:
        weight: of a neighbour at the other end of each edge, against 1 of the vertex itself; None: 1.
    """
    values = torch.ones(len(edges.vertices)) if weight is None else weight.cpu()
    neighbours = SymmetricPlaces.of(edges.vertices, count).filled(values.double())
    return Averaging(neighbours, 1 + neighbours @ torch.ones(count, 1, dtype=torch.float64))


def rings_as_wide_as(width: float, edges: MeshEdges, vertices: Float[Tensor, "vertex 3"]) -> int:
    """How often to average for a mean that is `width` wide (standard deviation along each axis, in units of the vertices); at least once."""
    start, end = vertices[edges.vertices].unbind(1)
    # A mean over neighbours is as wide as 0.65 edges along each axis, and squares of widths add.
    return max(1, round((width / (0.65 * float((start - end).norm(dim=1).mean()))) ** 2))


def averaged(around: Averaging, values: Tensor, rings: int) -> Tensor:
    """Values (vertex, k), averaged `rings` times by an averaging_matrix."""
    result = values.cpu().double()
    for _ in range(rings):
        result = (result + around.neighbours @ result) / around.total
    return result.to(values)
