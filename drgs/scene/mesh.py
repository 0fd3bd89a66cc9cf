"""A triangle mesh whose vertices carry materials."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor


@dataclass(frozen=True, eq=False)
class TriangleMesh:
    """What secondary rays meet. Vertex normals are shading normals, unit, outward."""

    vertices: Float[Tensor, "vertex 3"]
    """World position."""
    faces: Int[Tensor, "face 3"]
    """int32, counter-clockwise seen from outside."""
    normals: Float[Tensor, "vertex 3"]
    albedo: Float[Tensor, "vertex 3"]
    """Base colour, linear, 0..1."""
    roughness: Float[Tensor, "vertex"]
    metallic: Float[Tensor, "vertex"]


def vertex_normals(vertices: Tensor, faces: Tensor) -> Tensor:
    """(vertex, 3) unit normals: sum of face normals weighted by area."""
    corners = vertices[faces.long()]
    area_normals = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = torch.zeros_like(vertices)
    for corner in range(3):
        normals.index_add_(0, faces[:, corner].long(), area_normals)
    return torch.nn.functional.normalize(normals, dim=-1)
