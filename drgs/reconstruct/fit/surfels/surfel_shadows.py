"""Shadows in stage 1, where light turns with the camera.

Under light that stands still a shadow is part of what is painted, and the surface's fit parts the two. Under light that turns it wanders over the object,
no paint explains it, and surfels move to where it seems to lie. So a coarse mesh is taken from the surfels a few times, and each of them has the share
of the open sky's irradiance that arrives at the mesh's vertex nearest to it (turned_light). No gradient goes through the share.

In: parameters of surfels, cameras. Out: SurfelShadows, and by it (surfel, 3) for a photograph.
"""

from dataclasses import dataclass, fields, replace
from functools import cached_property

import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from drgs.maths.frames import rotation_from_quat_wxyz
from drgs.reconstruct.capture.hull_rays import surface_of
from drgs.reconstruct.fit.light.turned_light import SeenSky, arriving_share, seen_sky
from drgs.reconstruct.geometry.extract_mesh import FAST_MESH, extract_mesh
from drgs.reconstruct.geometry.mesh_from_gaussians import median_depths
from drgs.scene.camera import Camera, scaled_camera

SHADOW_MESH = replace(FAST_MESH, resolution=120, face_limit=12_000, keep_component_fraction=0.01)
"""Of all that stands apart; bits that float cast shadows only until the next look."""
SHADOW_PICTURES = 0.5
"""Of the cameras' size."""
UNPAINTED = 0.5
"""Albedo of vertices that are nearest to no surfel."""


@dataclass(frozen=True, eq=False)
class SurfelShadows:
    """A shape that the surfels had, and where they lie on it."""

    vertices: Float[Tensor, "vertex 3"]
    faces: Int[Tensor, "face 3"]
    nearest: Int[Tensor, "surfel"]
    """Vertex, of each surfel."""

    @property
    def columns(self) -> dict[str, Tensor]:
        """What it is made of, by name."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    @cached_property
    def _sky(self) -> SeenSky:
        return seen_sky(surface_of(self.vertices, self.faces))

    @torch.no_grad()
    def share(
        self, albedo: Float[Tensor, "surfel 3"], tables: Float[Tensor, "texel 3"], light_from_world: Float[Tensor, "3 3"]
    ) -> Float[Tensor, "surfel 3"]:
        """Of the open sky's irradiance that arrives at each surfel under the light turned so.

        Args:
            albedo: of the surfels. tables: of filter_environment.
        """
        sums = torch.zeros(len(self.vertices), 4, device=albedo.device)
        sums.index_add_(0, self.nearest, torch.cat([albedo, torch.ones_like(albedo[:, :1])], 1))
        paint = torch.where(sums[:, 3:] > 0, sums[:, :3] / sums[:, 3:].clamp(min=1), UNPAINTED)
        return arriving_share(self._sky, paint.contiguous(), tables.detach(), light_from_world)[self.nearest]

    def of_surfels(self, centers: Float[Tensor, "surfel 3"]) -> "SurfelShadows":
        """The same shape with other surfels on it."""
        moved = SurfelShadows(self.vertices, self.faces, _nearest(self.vertices, centers))
        moved.__dict__["_sky"] = self._sky  # what is seen is the shape's
        return moved


@torch.no_grad()
def shadows_of_surfels(
    parameters: dict[str, Tensor], cameras: tuple[Camera, ...], center: Float[Tensor, "3"], radius: float
) -> SurfelShadows | None:
    """By the mesh around the surfels as they are; None where their depths make none.

    Args:
        center, radius: of the object's bounding sphere [world units].
    """
    centers = parameters["centers"].detach()
    tangents = rotation_from_quat_wxyz(parameters["quats"])[:, :, :2] * parameters["log_scales"].exp()[:, None, :]
    smaller = tuple(scaled_camera(camera, SHADOW_PICTURES) for camera in cameras)
    maps = median_depths(centers, tangents, torch.sigmoid(parameters["opacity_logits"]), smaller, radius)
    try:
        vertices, faces = extract_mesh(maps, center, radius, SHADOW_MESH)
    except ValueError:  # fog: nothing casts a shadow yet
        return None
    return SurfelShadows(vertices.float().contiguous(), faces, _nearest(vertices, centers))


def _nearest(vertices: Tensor, centers: Tensor) -> Int[Tensor, "surfel"]:
    return torch.from_numpy(cKDTree(vertices.cpu().numpy()).query(centers.detach().cpu().numpy())[1]).to(centers.device)
