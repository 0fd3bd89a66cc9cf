"""The inside of a closed triangle mesh, as signed distances on a lattice: what matter collides with. And what lies near some points: what holds it.

In: a mesh as arrays or as a file, or points. Out: a Solid (drgs/deform/matter/mpm/records.py). Inside is where the winding number exceeds a half, so small
holes and flipped faces do no harm. Planes are kept exactly; edges and parts thinner than the spacing are rounded off.
"""

from pathlib import Path

import numpy as np
import torch
import warp as wp
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from drgs.deform.matter.fill_particles import depths
from drgs.deform.matter.mpm.records import Solid
from drgs.exchange.obj import parse_obj
from drgs.exchange.ply import parse_ply, triangles_from_faces
from drgs.warp_torch import warp_array

MOST_NODES = 1_000_000
"""Of a lattice; a larger mesh gets a larger spacing."""
MARGIN = 1.5
"""Cells around the mesh."""


def measure_solid(vertices: Float[Tensor, "vertex 3"], faces: Int[Tensor, "face 3"], spacing: float) -> Solid:
    """Distances from the mesh of vertices (vertex, 3) and faces (face, 3), on a lattice of this spacing, or a larger one if need be.

    Raises:
        ValueError: one sentence: values that are not finite, faces that name no vertex, or a mesh that encloses no node of the lattice.
    """
    vertices, faces = vertices.detach().float().contiguous(), faces.to(torch.int32).contiguous()
    if not len(faces) or not bool(torch.isfinite(vertices).all()):
        raise ValueError("a mesh that matter collides with has faces, and vertices that are finite")
    if int(faces.min()) < 0 or int(faces.max()) >= len(vertices):
        raise ValueError(f"faces name vertices 0 to {len(vertices) - 1}; found {int(faces.min())} to {int(faces.max())}")
    used = vertices[faces.long().unique()].double().cpu()
    low, high = used.amin(0), used.amax(0)
    nodes, spacing, counts = _lattice(low, high, spacing)
    tree = wp.Mesh(warp_array(vertices, wp.vec3), warp_array(faces.reshape(-1)), support_winding_number=True)
    distances = -depths(tree, nodes.float().contiguous().to(vertices.device)).reshape(counts)
    if not bool((distances <= 0).any()):
        raise ValueError(
            f"a mesh that matter collides with encloses a volume and is thicker than a cell of {spacing:.3g}; this one is neither or not"
        )
    return Solid(tuple((low - MARGIN * spacing).tolist()), spacing, distances)


def solid_around(points: Float[Tensor, "n 3"], radius: float, spacing: float) -> Solid:
    """What lies within a radius of some points (n, 3), at least one; on a lattice of this spacing, or a larger one if need be."""
    places = points.detach().double().cpu()
    low, high = places.amin(0) - radius, places.amax(0) + radius
    nodes, spacing, counts = _lattice(low, high, spacing)
    distances, _ = cKDTree(places.numpy()).query(nodes.numpy())
    return Solid(tuple((low - MARGIN * spacing).tolist()), spacing, torch.from_numpy(distances - radius).float().reshape(counts))


def distances_from_solid(solid: Solid, points: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
    """(n,) trilinear distances of points (n, 3), negative inside; inf beyond the lattice."""
    grid = solid.distances.to(points)
    place = (points - points.new_tensor(solid.minimum)) / solid.spacing
    limit = points.new_tensor(grid.shape) - 1
    outside = ((place < 0) | (place > limit)).any(1)
    base = torch.minimum(place.floor().clamp(min=0), limit - 1)
    share, base = place - base, base.long()
    found = points.new_zeros(len(points))
    for corner in torch.cartesian_prod(*3 * [torch.arange(2, device=points.device)]):
        at = base + corner
        weight = torch.where(corner.bool(), share, 1 - share).prod(1)
        found = found + weight * grid[at[:, 0], at[:, 1], at[:, 2]]
    return torch.where(outside, torch.full_like(found, torch.inf), found)


def _lattice(low: Float[Tensor, "3"], high: Float[Tensor, "3"], spacing: float) -> tuple[Float[Tensor, "n 3"], float, list[int]]:
    """Nodes (n, 3) float64 around a box, their spacing, and how many there are along each axis."""
    while float(((high - low) / spacing + 2 * MARGIN + 1).ceil().prod()) > MOST_NODES:
        spacing *= 1.1
    counts = ((high - low) / spacing + 2 * MARGIN + 1).ceil().long().tolist()
    origin = low - MARGIN * spacing
    axes = [origin[k] + spacing * torch.arange(counts[k], dtype=torch.float64) for k in range(3)]
    return torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3), spacing, counts


def read_collider(path: Path) -> tuple[Float[Tensor, "vertex 3"], Int[Tensor, "face 3"]]:
    """Vertices (vertex, 3) and faces (face, 3) of an OBJ or PLY file [world units, z up], or of an asset's folder.

    Raises:
        ValueError: one sentence: no such file, another kind of file, or a damaged one.
    """
    if path.is_dir():
        from drgs.scene.asset import load_asset

        mesh = load_asset(path).mesh
        return mesh.vertices, mesh.faces
    suffix = path.suffix.lower()
    if suffix not in (".obj", ".ply"):
        raise ValueError(f"{path}: a mesh that matter collides with is an OBJ or PLY file, or an asset's folder")
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ValueError(f"{path}: cannot be read ({error.strerror})") from error
    if suffix == ".obj":
        points, faces = parse_obj(data, str(path))
    else:
        ply = parse_ply(data, str(path))
        vertex = ply.elements.get("vertex")
        if vertex is None or not {"x", "y", "z"} <= set(vertex.scalars):
            raise ValueError(f"{path}: has no vertices with x, y, z")
        points = np.stack([vertex.scalars[axis] for axis in "xyz"], -1)
        faces = triangles_from_faces(ply, len(points), str(path))
    return torch.from_numpy(points.astype(np.float32)), torch.from_numpy(faces.astype(np.int32))
