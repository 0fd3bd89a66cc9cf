"""Surfels on the faces of a mesh: one each, with the mesh's shading normal and materials, wide enough that together they close the surface.

In: a mesh with materials. Out: Gaussians and their Binding; with a light, their materials and outgoing radiance as harmonics. So the Gaussians are the surface that rays
meet, that is exported and that moves. (mesh_surfels is drgs2026's Alg. 1, which asks surfels fitted elsewhere.)
"""

from dataclasses import replace

import torch

from drgs.maths.constants import MAX_ALPHA
from drgs.maths.frames import quat_wxyz_from_rotation
from drgs.reconstruct.geometry.bake_materials import bake_outgoing_radiance, outward_normals
from drgs.reconstruct.geometry.mesh_surfels import face_frames
from drgs.scene.binding import Binding
from drgs.scene.environment import Environment
from drgs.scene.gaussians import Gaussians
from drgs.scene.mesh import TriangleMesh

WIDTH = 0.85
"""Of the spacing of face centres: at a vertex of a regular mesh the six surfels around it leave 2 % of the light through."""
NO_AREA = 1e-9
"""Faces below this share of the median area get no surfel."""


def surfels_on_faces_of(mesh: TriangleMesh) -> tuple[Gaussians, Binding]:
    """One surfel on each face that has area, at its centre."""
    frames = face_frames(mesh)
    kept = (frames.area > NO_AREA * frames.area.median()).nonzero().squeeze(1)
    corners = mesh.faces[kept].long()
    own = frames.rotation[kept]
    mean = torch.nn.functional.normalize(mesh.normals[corners].sum(1), dim=-1)
    leaning = (mean * own[:, :, 2]).sum(-1, keepdim=True) < 0.5  # at creases, and where normals went wrong: the face's own
    normal = torch.where(leaning, own[:, :, 2], mean)
    t_u = own[:, :, 0] - (own[:, :, 0] * normal).sum(-1, keepdim=True) * normal
    t_u = torch.nn.functional.normalize(t_u, dim=-1)
    rotation = torch.stack([t_u, torch.linalg.cross(normal, t_u), normal], -1)
    count, device = len(kept), mesh.vertices.device
    gaussians = Gaussians(
        centers=frames.center[kept],
        log_scales=(WIDTH * frames.scales[kept]).log(),
        quats_wxyz=quat_wxyz_from_rotation(rotation),
        opacity_logits=torch.full((count,), float(torch.logit(torch.tensor(MAX_ALPHA))), device=device),
        sh=torch.zeros(count, 16, 3, device=device),
        albedo=mesh.albedo[corners].mean(1),
        roughness=mesh.roughness[corners].mean(1),
        metallic=mesh.metallic[corners].mean(1),
    )
    barycentric = torch.full((count, 3), 1 / 3, device=device)
    return gaussians, Binding(kept.int(), barycentric, torch.zeros(count, device=device))


def radiating_surfels(gaussians: Gaussians, binding: Binding, mesh: TriangleMesh, environment: Environment) -> Gaussians:
    """Surfels that sit on the mesh, with its materials and the harmonics of what they send out under the environment, by split sum."""
    corners = mesh.faces[binding.face.long()].long()
    albedo, roughness, metallic = (
        torch.einsum("sk,sk...->s...", binding.barycentric, values[corners]) for values in (mesh.albedo, mesh.roughness, mesh.metallic)
    )
    dressed = replace(gaussians, albedo=albedo, roughness=roughness, metallic=metallic)
    nothing = torch.zeros_like(gaussians.sh)
    return replace(dressed, sh=bake_outgoing_radiance(dressed, nothing, outward_normals(dressed, mesh), environment))
