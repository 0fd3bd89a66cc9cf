"""Matter that has come apart, as a renderer sees it: cut faces are left out, and grains stand where they were.

In: an object's shape with what has parted, and its faces. Out: its shape with other faces, vertices and surfels, and of each of them the asset's
vertex whose material it has. The asset's own vertices and surfels come first and keep their numbers; a surfel that is gone has no opacity. A grain
is a ball of the particle's volume, as an icosahedron that shades as round.
"""

import math
from dataclasses import dataclass, replace
from functools import cache

import torch
import trimesh
from jaxtyping import Float, Int
from torch import Tensor

from drgs.deform.clip import Parted
from drgs.scene.albedo_detail import chosen_faces
from drgs.scene.materials import Materials
from drgs.scene.mesh import TriangleMesh
from drgs.scene.posed_scene import PosedScene, PosedSurfels

GRAIN_OPACITY = 0.95
"""Of a grain's surfels, which are six: one towards each side."""
GRAIN_SURFEL_DEPTH, GRAIN_SURFEL_SCALE = 0.75, 0.45
"""How far they lie from the middle, and their standard deviation [radii of the ball]."""


@dataclass(frozen=True, eq=False)
class ShownGrains:
    """What replaces a posed scene's shape, and where the materials of what is new come from."""

    vertices: Float[Tensor, "all_vertices 3"]
    normals: Float[Tensor, "all_vertices 3"]
    faces: Int[Tensor, "shown_face 3"]
    """Those of the object that are left, then the grains'."""
    face_source: Int[Tensor, "kept_face"]
    """Of those that are left, the asset's faces."""
    vertex_source: Int[Tensor, "all_vertices"]
    surfels: tuple[Float[Tensor, "all_surfels 3"], Float[Tensor, "all_surfels 3 2"], Float[Tensor, "all_surfels"]] | None
    """Centres, tangents and opacities."""
    surfel_source: Int[Tensor, "new_surfel"]
    """Of the grains' surfels only."""


def grains_of(mesh: TriangleMesh, surfels: PosedSurfels | None, parted: Parted) -> ShownGrains:
    """
    Args:
        mesh, surfels: the asset's, moved, whole.
    """
    corners, triangles, disc_centers, disc_tangents = (values.to(mesh.vertices.device) for values in _grain())
    chosen = parted.shown.nonzero().flatten()
    centers, size = parted.centers[chosen], parted.volumes[chosen] ** (1 / 3)
    own, count = parted.vertex[chosen], len(mesh.vertices)
    placed = (centers[:, None] + size[:, None, None] * corners).reshape(-1, 3)
    offsets = count + len(corners) * torch.arange(len(chosen), device=chosen.device, dtype=mesh.faces.dtype)
    vertices = torch.cat([mesh.vertices, placed])
    normals = torch.cat([mesh.normals, torch.nn.functional.normalize(corners, dim=-1).repeat(len(chosen), 1)])
    kept = (~parted.cut).nonzero().flatten()
    faces = torch.cat([mesh.faces[kept], (offsets[:, None, None] + triangles.to(mesh.faces.dtype)).reshape(-1, 3)])
    vertex_source = torch.cat([torch.arange(count, device=own.device), own.repeat_interleave(len(corners))])
    surfel_source = own.repeat_interleave(len(disc_centers))
    if surfels is None or parted.gone is None:
        return ShownGrains(vertices, normals, faces, kept, vertex_source, None, surfel_source)
    discs = (centers[:, None] + size[:, None, None] * disc_centers).reshape(-1, 3)
    tangents = (size[:, None, None, None] * disc_tangents).reshape(-1, 3, 2)
    opacities = torch.cat([surfels.opacities.masked_fill(parted.gone, 0.0), surfels.opacities.new_full((len(discs),), GRAIN_OPACITY)])
    shown = torch.cat([surfels.centers, discs]), torch.cat([surfels.tangents, tangents]), opacities
    return ShownGrains(vertices, normals, faces, kept, vertex_source, shown, surfel_source)


def show_grains(scene: PosedScene, grains: ShownGrains) -> PosedScene:
    """The scene with its grains, which wear the materials of its mesh."""
    mesh, surfels, source = scene.mesh, scene.surfels, grains.vertex_source
    shown = TriangleMesh(
        grains.vertices, grains.faces, grains.normals, mesh.albedo[source], mesh.roughness[source], mesh.metallic[source],
        detail=None if mesh.detail is None else chosen_faces(mesh.detail, grains.face_source, len(grains.faces), source),
    )  # fmt: skip
    if surfels is not None and grains.surfels is not None:
        new, worn = grains.surfel_source, surfels.materials
        worn = Materials(
            torch.cat([worn.albedo, mesh.albedo[new]]),
            torch.cat([worn.roughness, mesh.roughness[new]]),
            torch.cat([worn.metallic, mesh.metallic[new]]),
        )
        surfels = PosedSurfels(*grains.surfels, worn)
    return replace(scene, mesh=shown, surfels=surfels, vertex_source=source, surfel_source=grains.surfel_source)


@cache
def _grain() -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """An icosahedron of volume 1: vertices (12, 3) and faces (20, 3); and centres (6, 3) and tangents (6, 3, 2) of the discs of a ball of volume 1."""
    solid = trimesh.creation.icosahedron()
    corners = torch.tensor(solid.vertices / solid.volume ** (1 / 3), dtype=torch.float64)
    axes, radius = torch.eye(3), (3 / (4 * math.pi)) ** (1 / 3)
    normals = torch.cat([axes, -axes])
    # The two axes beside a normal, in the order that makes it their product.
    first, second = axes.roll(-1, 0), axes.roll(-2, 0)
    tangents = torch.stack([torch.cat([first, second]), torch.cat([second, first])], -1)
    return corners.float(), torch.tensor(solid.faces), GRAIN_SURFEL_DEPTH * radius * normals, GRAIN_SURFEL_SCALE * radius * tangents
