"""Which part of an object a material edit reaches, as a weight 0..1 for each mesh vertex and each surfel, at rest.

Sphere and box are evaluated where a vertex or surfel lies. Region, similar and painted weights live on the mesh; a surfel takes them
from the face it is bound to (barycentric), or from the nearest vertex where there is no binding.
"""

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from drgs.scene.binding import Binding
from drgs.scene.edits import SMALLEST, Box, Selection, Similar, Sphere
from drgs.scene.mesh import TriangleMesh

REGION_STEP = 0.1
"""Neighbouring vertices whose materials differ by more lie in different regions (Euclidean over albedo, roughness, metallic)."""


def select_vertices(mesh: TriangleMesh, selection: Selection) -> Tensor:
    """(vertex,) weights 0..1; those of a file are read_weights'.

    Raises:
        ValueError: a region that does not exist, or painted weights for another mesh.
    """
    if selection.all:
        return torch.ones_like(mesh.roughness)
    solid = selection.sphere or selection.box
    if solid is not None:
        return _weights_at_points(mesh.vertices, solid)
    if selection.similar is not None:
        return _flood(mesh, selection.similar)
    if selection.vertex_weights is not None:
        if len(selection.vertex_weights) != len(mesh.vertices):
            raise ValueError(f"vertex_weights has {len(selection.vertex_weights)} entries, the mesh has {len(mesh.vertices)} vertices")
        return torch.tensor(selection.vertex_weights, dtype=mesh.roughness.dtype, device=mesh.roughness.device)
    regions = mesh_regions(mesh)
    count = int(regions.max()) + 1
    if selection.region is None or not 0 <= selection.region < count:
        raise ValueError(f"region {selection.region} does not exist; the object has regions 0 to {count - 1}")
    return (regions == selection.region).to(mesh.roughness.dtype)


def read_weights(path: Path, mesh: TriangleMesh) -> Tensor:
    """(vertex,) painted weights of a selection's `weights_file`.

    Raises:
        ValueError: they are another mesh's, or not in 0..1.
    """
    count = len(mesh.vertices)
    if (size := path.stat().st_size) != 4 * count:
        raise ValueError(f"{path}: has {size} bytes; expected {4 * count}, a float32 for each of the mesh's {count} vertices")
    weights = np.fromfile(path, "<f4")
    if not ((weights >= 0) & (weights <= 1)).all():
        raise ValueError(f"{path}: expected weights in 0..1; found others")
    return torch.from_numpy(weights.astype(np.float32)).to(mesh.roughness)


def select_surfels(centers: Tensor, mesh: TriangleMesh, binding: Binding | None, selection: Selection, vertex_weights: Tensor) -> Tensor:
    """(surfel,) weights 0..1 of surfels at rest centres (surfel, 3), given what `select_vertices` found on the mesh."""
    if selection.all:
        return torch.ones_like(centers[:, 0])
    solid = selection.sphere or selection.box
    if solid is not None:
        return _weights_at_points(centers, solid)
    if binding is not None:
        weights = (vertex_weights[mesh.faces[binding.face.long()].long()] * binding.barycentric).sum(-1)
        # Barycentrics that sum to 1 up to rounding must not leave a fully selected face at 0.9999999.
        return torch.where(weights > 1 - 1e-5, torch.ones_like(weights), weights.clamp(min=0))
    from scipy.spatial import cKDTree  # here, like SciPy's graphs below: most edits that are posed need none of it

    _, nearest = cKDTree(mesh.vertices.cpu().numpy()).query(centers.detach().cpu().numpy())
    return vertex_weights[torch.as_tensor(nearest, device=vertex_weights.device)]


def mesh_regions(mesh: TriangleMesh) -> Tensor:
    """(vertex,) int64 region of each vertex: connected patches without a jump in material, the largest first."""
    edges = _edges(mesh)
    features = _features(mesh)
    smooth = (features[edges[:, 0]] - features[edges[:, 1]]).norm(dim=-1) <= REGION_STEP
    labels = _components(len(mesh.vertices), edges[smooth])
    order = torch.argsort(torch.bincount(labels), descending=True, stable=True)  # of equal ones, the one found first
    rank = torch.empty_like(order)
    rank[order] = torch.arange(len(order), device=order.device)
    return rank[labels]


def _weights_at_points(points: Tensor, shape: Sphere | Box) -> Tensor:
    """1 inside, falling smoothly (cubic) to 0 over the falloff outside."""
    if isinstance(shape, Sphere):
        outside = (points - points.new_tensor(shape.center)).norm(dim=-1) - shape.radius
    else:
        low, high = points.new_tensor(shape.minimum), points.new_tensor(shape.maximum)
        outside = torch.maximum(low - points, points - high).clamp(min=0).norm(dim=-1)
    if shape.falloff < SMALLEST:
        return (outside <= 0).to(points.dtype)
    t = (1 - outside / shape.falloff).clamp(0, 1)
    return t * t * (3 - 2 * t)


def _flood(mesh: TriangleMesh, similar: Similar) -> Tensor:
    """1 on the connected patch around the picked point whose material at rest is within the tolerance of the picked one."""
    seed = int((mesh.vertices - mesh.vertices.new_tensor(similar.point)).square().sum(-1).argmin())
    features, edges = _features(mesh), _edges(mesh)
    alike = (features - features[seed]).norm(dim=-1) <= similar.tolerance
    labels = _components(len(mesh.vertices), edges[alike[edges].all(-1)])
    return (labels == labels[seed]).to(mesh.roughness)


def _features(mesh: TriangleMesh) -> Tensor:
    return torch.cat([mesh.albedo, mesh.roughness[:, None], mesh.metallic[:, None]], -1)


def _edges(mesh: TriangleMesh) -> Tensor:
    """(edge, 2) int64; an inner edge stands twice."""
    faces = mesh.faces.long()
    return torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])


def _components(count: int, edges: Tensor) -> Tensor:
    """(vertex,) int64 label of each vertex's connected component."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    ends = edges.cpu().numpy()
    graph = coo_matrix((np.ones(len(ends), bool), (ends[:, 0], ends[:, 1])), shape=(count, count))
    _, labels = connected_components(graph, directed=False)
    return torch.from_numpy(labels).long().to(edges.device)
