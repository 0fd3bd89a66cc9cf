"""The scene after edits and deformation: what a frame is rendered from."""

from dataclasses import dataclass
from typing import Literal, get_args

from jaxtyping import Float, Int, UInt8
from torch import Tensor

from drgs.scene.environment import Environment
from drgs.scene.materials import Materials
from drgs.scene.mesh import TriangleMesh

PrimarySurface = Literal["gaussians", "mesh"]
PRIMARY_SURFACES: tuple[PrimarySurface, ...] = get_args(PrimarySurface)


@dataclass(frozen=True, eq=False)
class PosedSurfels:
    """Gaussians in world space, moved by F: tangents need no longer be orthogonal."""

    centers: Float[Tensor, "surfel 3"]
    tangents: Float[Tensor, "surfel 3 2"]
    """B' = F B; columns were s_u t_u and s_v t_v at rest [world units]."""
    opacities: Float[Tensor, "surfel"]
    """0..1."""
    materials: Materials


@dataclass(frozen=True, eq=False)
class PosedScene:
    """Written by pose_scene(asset, edits, state); read by render_frame."""

    surfels: PosedSurfels | None
    mesh: TriangleMesh
    environment: Environment
    environment_rotation_degrees: float = 0.0
    """Counter-clockwise seen from above; applied by turning directions, the table stays as it is."""
    environment_intensity: float = 1.0
    horizons: UInt8[Tensor, "face 8"] | None = None
    """The asset's, while its mesh is at rest."""
    preferred: PrimarySurface | None = None
    """The asset's `primary`."""
    vertex_source: Int[Tensor, "vertex"] | None = None
    """Where matter came apart: the asset's vertex that each vertex of the mesh has its material from, its own ones first. None: the asset's mesh."""
    surfel_source: Int[Tensor, "grain_surfel"] | None = None
    """The same of the surfels behind the asset's own."""

    @property
    def primary(self) -> PrimarySurface:
        """What cameras see unless they are told otherwise."""
        return self.preferred or ("mesh" if self.surfels is None else "gaussians")
