"""What a ray from the surface brings back besides the sky: its transmittance, and the radiance of what it hits.

Two tracers behind one interface. Mesh: Embree (CPU) or Warp (CUDA) finds the first face, whose vertices carry the surfels' outgoing
radiance as harmonics. Surfels: the paper's 2D Gaussian ray tracing, blended in order. The mesh is several times faster, the surfels need
no mesh. Neither passes a gradient on: light that was reflected twice is taken as known (its own gradient is measured to matter little).
"""

from abc import ABC, abstractmethod

import torch
from jaxtyping import Float
from torch import Tensor

from drgs.maths.spherical_harmonics import radiance_from_sh
from drgs.reconstruct.geometry.bake_materials import average_surfels, vertex_weights
from drgs.render.intersect.trace_rays import build_tracer, trace_rays
from drgs.render.intersect.tracer_surfels import build_surfel_scene, trace_surfel_radiance
from drgs.scene.gaussians import Gaussians, surfel_tangents
from drgs.scene.materials import Materials
from drgs.scene.mesh import TriangleMesh
from drgs.scene.posed_scene import PosedSurfels

HIT_CHUNK = 1 << 15
"""Hits whose harmonics are evaluated at once: bounds memory."""
SURFEL_START = 0.01
"""Surfel rays ignore what lies nearer than this share of the mesh's extent: the surface they start on is a few surfels thick."""


class AbstractIncidentLight(ABC):
    """Answers for rays (ray, 3) with unit directions."""

    @abstractmethod
    def incident(
        self, origins: Float[Tensor, "ray 3"], directions: Float[Tensor, "ray 3"]
    ) -> tuple[Float[Tensor, "ray"], Float[Tensor, "ray 3"]]:
        """(ray,) transmittance to the sky and (ray, 3) hit radiance, already times 1 - transmittance."""


class MeshIncidentLight(AbstractIncidentLight):
    """First hit on the mesh; harmonics of the outgoing radiance interpolated from its vertices."""

    def __init__(self, mesh: TriangleMesh, gaussians: Gaussians) -> None:
        self.mesh = mesh
        self.tracer = build_tracer(mesh)
        self.vertex_sh = average_surfels(gaussians.sh, *vertex_weights(mesh.vertices, mesh.normals, gaussians))

    def incident(
        self, origins: Float[Tensor, "ray 3"], directions: Float[Tensor, "ray 3"]
    ) -> tuple[Float[Tensor, "ray"], Float[Tensor, "ray 3"]]:
        hits = trace_rays(origins, directions, self.tracer)
        hit_radiance = torch.zeros_like(directions)
        for chunk in hits.hit.nonzero().squeeze(1).split(HIT_CHUNK):
            corners = self.mesh.faces[hits.face[chunk].long()].long()
            second, third = hits.barycentric[chunk].unbind(-1)
            weights = torch.stack([1 - second - third, second, third], -1)
            sh = (self.vertex_sh[corners] * weights[:, :, None, None]).sum(1)
            hit_radiance[chunk] = radiance_from_sh(sh, directions[chunk])
        return (~hits.hit).float(), hit_radiance


class SurfelIncidentLight(AbstractIncidentLight):
    """Alpha-blended outgoing radiance of the surfels along the ray (2DGRT)."""

    def __init__(self, mesh: TriangleMesh, gaussians: Gaussians) -> None:
        surfels = PosedSurfels(
            gaussians.centers,
            surfel_tangents(gaussians),
            torch.sigmoid(gaussians.opacity_logits),
            Materials(gaussians.albedo, gaussians.roughness, gaussians.metallic),
        )
        self.scene = build_surfel_scene(surfels, gaussians.sh)
        low, high = mesh.vertices.amin(0), mesh.vertices.amax(0)
        self.start = SURFEL_START * float((high - low).norm())

    def incident(
        self, origins: Float[Tensor, "ray 3"], directions: Float[Tensor, "ray 3"]
    ) -> tuple[Float[Tensor, "ray"], Float[Tensor, "ray 3"]]:
        radiance, opacity, _ = trace_surfel_radiance(origins, directions, self.scene, self.start)
        return 1 - opacity, radiance


def build_incident_light(kind: str, mesh: TriangleMesh, gaussians: Gaussians) -> AbstractIncidentLight:
    """`kind`: mesh or surfels.

    Raises:
        ValueError: another kind.
    """
    if kind not in ("mesh", "surfels"):
        raise ValueError(f"indirect light is traced against 'mesh' or 'surfels'; found {kind!r}")
    return MeshIncidentLight(mesh, gaussians) if kind == "mesh" else SurfelIncidentLight(mesh, gaussians)
