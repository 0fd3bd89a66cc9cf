"""A triangle mesh whose vertices carry materials."""

from dataclasses import dataclass, field
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from drgs.scene.albedo_detail import AlbedoDetail
from drgs.scene.edits import LARGEST

MOST_BOXES_MET = 5000
"""Of a scan it is a few, of a lattice of long struts some hundreds."""


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
    detail: AlbedoDetail | None = field(default=None, kw_only=True)
    """Of the albedo between the vertices, as fine as photographs show it; None: there is none."""

    @property
    def columns(self) -> dict[str, Any]:
        """The tensors by name: all but the detail."""
        return {name: values for name, values in vars(self).items() if name != "detail"}


def on_cpu(mesh: TriangleMesh) -> TriangleMesh:
    """The same on the CPU, without gradients."""
    detail = mesh.detail
    if detail is not None:
        detail = AlbedoDetail(detail.codes.cpu(), None if detail.share is None else detail.share.detach().cpu())
    return TriangleMesh(**{key: values.detach().cpu() for key, values in mesh.columns.items()}, detail=detail)


def vertex_normals(vertices: Tensor, faces: Tensor) -> Tensor:
    """(vertex, 3) unit normals: sum of face normals weighted by area."""
    corners = vertices[faces.long()]
    area_normals = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = torch.zeros_like(vertices)
    for corner in range(3):
        normals.index_add_(0, faces[:, corner].long(), area_normals)
    return torch.nn.functional.normalize(normals, dim=-1, eps=1e-30)  # areas of a small object's faces are tiny numbers


def face_areas(vertices: Tensor, faces: Tensor) -> Tensor:
    """(face,), in squared units of the vertices."""
    corners = vertices[faces.long()]
    return torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]).norm(dim=-1) / 2


def refuse_unusable(mesh: TriangleMesh, name: str) -> None:
    """The door for meshes of strangers.

    Raises:
        ValueError: `name` lies too far away for float32, or its triangles in such a heap that rays could not be traced.
    """
    farthest = float(mesh.vertices.abs().max()) if len(mesh.vertices) else 0.0
    if farthest > LARGEST:
        raise ValueError(f"{name}: has a vertex at {farthest:.3g}; expected coordinates up to {LARGEST:g}")
    met = mean_boxes_met(mesh)
    if met > MOST_BOXES_MET:
        raise ValueError(
            f"{name}: its {len(mesh.faces)} triangles lie on one another, so that a ray would have to be tried against {met:.0f} of them "
            f"on the mean; expected at most {MOST_BOXES_MET}, so join those that coincide"
        )


def mean_boxes_met(mesh: TriangleMesh) -> float:
    """How many triangles' bounding boxes a random line through the whole mesh's box meets on the mean.

    By Cauchy and Crofton that is the sum of their areas over its own; no hierarchy of boxes can spare a ray these.
    """
    if not len(mesh.faces):
        return 0.0
    corners = mesh.vertices[mesh.faces.long()]
    sides = (corners.amax(1) - corners.amin(1)).double()
    whole = (corners.amax((0, 1)) - corners.amin((0, 1))).double()
    area = _half_area(whole)
    return float(_half_area(sides).sum() / area) if area > 0 else 0.0


def _half_area(sides: Tensor) -> Tensor:
    return sides[..., 0] * sides[..., 1] + sides[..., 1] * sides[..., 2] + sides[..., 2] * sides[..., 0]
