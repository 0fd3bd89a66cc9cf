"""Slow torch twin of drgs/render/intersect/mesh_surface.py, at the precision of the mesh."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from drgs.scene.albedo_detail import detailed_albedo
from drgs.scene.mesh import TriangleMesh


@dataclass(frozen=True, eq=False)
class Surfaces:
    """Points on the mesh with its interpolated attributes."""

    position: Float[Tensor, "point 3"]
    normal: Float[Tensor, "point 3"]
    """Unit shading normal."""
    face_normal: Float[Tensor, "point 3"]
    albedo: Float[Tensor, "point 3"]
    roughness: Float[Tensor, "point"]
    metallic: Float[Tensor, "point"]


def surfaces_at(mesh: TriangleMesh, face: Tensor, barycentric: Tensor) -> Surfaces:
    """The surface at weights (point, 2) of the second and third vertex of faces (point,)."""
    corners = mesh.faces[face.long()].long()
    weights = torch.stack([1 - barycentric.sum(-1), barycentric[:, 0], barycentric[:, 1]], -1)

    def blend(values: Tensor) -> Tensor:
        return torch.einsum("pc,pc...->p...", weights, values[corners])

    a, b, c = mesh.vertices[corners].unbind(1)
    normal, face_normal = blend(mesh.normals), torch.linalg.cross(b - a, c - a)
    unit = torch.nn.functional.normalize
    return Surfaces(
        blend(mesh.vertices),
        unit(normal, dim=-1),
        unit(face_normal, dim=-1),
        detailed_albedo(blend(mesh.albedo), mesh.detail, mesh.faces, face, barycentric),
        blend(mesh.roughness),
        blend(mesh.metallic),
    )


def mesh_in(dtype: torch.dtype, mesh: TriangleMesh) -> TriangleMesh:
    """The same mesh at another precision."""
    vertices, normals, albedo, roughness, metallic = (
        values.to(dtype) for values in (mesh.vertices, mesh.normals, mesh.albedo, mesh.roughness, mesh.metallic)
    )
    return TriangleMesh(vertices, mesh.faces, normals, albedo, roughness, metallic, detail=mesh.detail)
