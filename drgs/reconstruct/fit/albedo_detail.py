"""Albedo as fine as the photographs show it: solved for each vertex from all views at once, and put into what stage 2 found.

Stage 2 looks at a few thousand points a step, so it decides what is large and leaves fine patterns blurred. Under its light, and with its
normals, roughness and metallic, split sum's radiance is linear in a vertex's albedo a, channel by channel: L = B + a A. So least squares over
all photographs that show the vertex has a closed form,

    a = (sum w A (photo - B) + HOLD W a0) / (sum w A^2 + HOLD W)        w = (cos / (photo + DARK))^2

with a0 of stage 2 and W the median of sum w A^2. What of a / a0 varies slowly is divided out: it is split sum's error against traced light, or
light that was not the same in all photographs, and stage 2 knows better. Faces are divided first, until edges are about as long as pixels are wide.

In: the mesh through its tracer, photographs, light. Out: albedo. Source: linear least squares; ours.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from drgs.maths.brdf import f0_from_base
from drgs.reconstruct.fit.metal_evidence import DARK
from drgs.reconstruct.fit.seen_vertices import SeenVertices, mirrored_radiance, seen_vertices
from drgs.reconstruct.fit.split_sum import shade_split_sum
from drgs.reconstruct.fit.view_targets import ViewTarget
from drgs.reconstruct.geometry.average_around import averaging_matrix
from drgs.reconstruct.geometry.mesh_edges import MeshEdges
from drgs.render.intersect.tracer import AbstractTracer
from drgs.scene.camera import Camera
from drgs.scene.mesh import TriangleMesh

LEAST, MOST = 0.005, 0.995
"""Albedo, as logits_of_shares keeps it."""
MOST_RATIO = 4.0
"""To stage 2's albedo; what differs more was seen wrongly."""
HOLD = 0.05
"""Weight of stage 2's albedo, against what a median vertex's photographs say."""


@dataclass(frozen=True)
class DetailSettings:
    """How fine."""

    edge_pixels: float = 1.5
    """Faces are divided while their mean edge is longer [pixels of the photographs] ..."""
    most_faces: int = 250_000
    """... and there are no more than this afterwards."""
    rings: int = 5
    """Neighbourhoods of undivided faces over which slow changes are told from fast ones."""


def divisions(mesh: TriangleMesh, cameras: tuple[Camera, ...], settings: DetailSettings) -> int:
    """How often each face is to be divided into four."""
    corners = mesh.vertices[mesh.faces.long()]
    edge = float((corners - corners.roll(1, 1)).norm(dim=-1).mean())
    middle = mesh.vertices.mean(0)
    pixel = torch.stack([(camera.center_world.to(middle) - middle).norm() / camera.intrinsics[0, 0].to(middle) for camera in cameras])
    times, faces = 0, len(mesh.faces)
    while edge / 2**times > settings.edge_pixels * float(pixel.median()) and 4 * faces <= settings.most_faces:
        times, faces = times + 1, 4 * faces
    return times


@torch.no_grad()
def albedo_detail(
    tracer: AbstractTracer, targets: list[ViewTarget], open_share: Tensor, tables: Tensor, edges: MeshEdges, rings: int
) -> Float[Tensor, "vertex 3"]:
    """Of the tracer's mesh: its albedo with what the photographs show finer than `rings` neighbourhoods.

    Args:
        open_share: (vertex, 3) of irradiance_share. tables: of filter_environment.
    """
    mesh = tracer.mesh
    explained, weight = torch.zeros_like(mesh.albedo), torch.zeros_like(mesh.albedo)
    for target in targets:
        seen = seen_vertices(tracer, target)
        if len(seen.index) == 0:
            continue
        black, slope = _linear_in_albedo(tracer, seen, open_share, tables)
        trust = ((mesh.normals[seen.index] * seen.wo).sum(-1, keepdim=True) / (seen.photo + DARK)) ** 2
        explained.index_add_(0, seen.index, trust * slope * (seen.photo - black))
        weight.index_add_(0, seen.index, trust * slope * slope)
    known = weight > 0
    if not bool(known.any()):
        return mesh.albedo
    hold = HOLD * weight[known].median()
    solved = (explained + hold * mesh.albedo) / (weight + hold)
    ratio = (solved / mesh.albedo).clamp(1 / MOST_RATIO, MOST_RATIO).cpu().double().numpy()
    around, slow = averaging_matrix(edges, len(ratio)), ratio
    for _ in range(rings):
        slow = around @ slow
    return (mesh.albedo * torch.from_numpy(ratio / slow).to(mesh.albedo)).clamp(LEAST, MOST)


def _linear_in_albedo(tracer: AbstractTracer, seen: SeenVertices, open_share: Tensor, tables: Tensor) -> tuple[Tensor, Tensor]:
    """(seen, 3) radiance towards the camera of vertices without albedo, and (seen, 3) what a unit of albedo adds."""
    mesh, index = tracer.mesh, seen.index
    metallic, transmittance_and_met = mesh.metallic[index], mirrored_radiance(tracer, seen, open_share, tables)

    def shown(albedo: Tensor) -> Tensor:
        return shade_split_sum(
            albedo * (1 - metallic)[:, None], torch.zeros_like(albedo), f0_from_base(albedo, metallic), mesh.roughness[index],
            mesh.normals[index], seen.wo, tables, *transmittance_and_met, open_share[index],
        )  # fmt: skip

    black = shown(torch.zeros_like(seen.photo))
    return black, shown(torch.ones_like(seen.photo)) - black
