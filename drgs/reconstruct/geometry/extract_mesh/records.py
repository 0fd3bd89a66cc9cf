"""What mesh extraction is given: depth maps, and settings with every default in one place."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from drgs.scene.camera import Camera


@dataclass(frozen=True, eq=False)
class DepthMap:
    """One view's geometry, as the rasteriser gives it (median depth: mean depth duplicates sheets)."""

    camera: Camera
    depth: Float[Tensor, "height width"]
    """Along the viewing axis [world units]; 0, +inf or NaN where there is none."""
    coverage: Float[Tensor, "height width"]
    """Accumulated opacity, 0..1. Below 0.5 the pixel shows background and carves."""
    normal_world: Float[Tensor, "height width 3"] | None = None
    """Unit; either side. When None, normals come from differences of the depth."""


@dataclass(frozen=True)
class MeshSettings:
    """Defaults suit 40 to 200 views around one object; lengths follow from the bounds, so scale does not matter."""

    resolution: int = 256
    """Voxels along twice the bounds' radius."""
    voxel_size: float | None = None
    """[world units]; overrides `resolution`."""
    truncation_voxels: float = 4.0
    """Half width of the band where distance is averaged. Structures thinner than this lean outward; wider averages more noise away."""
    minimum_free_views: int = 2
    """A point is outside only if this many views look through it (1 where only one or two views see it), so one bad depth map digs no hole."""
    minimum_free_fraction: float = 0.05
    """... and this share of the views that have it in frame. Hollows seen by fewer are filled."""
    keep_component_fraction: float = 1.0
    """Keep components whose area is at least this share of the largest one's; 1 keeps the largest only."""
    smoothing_passes: int = 5
    """Taubin passes before simplification: they take marching cubes' staircase away and keep the volume. 0 for none."""
    face_limit: int = 60_000
    """Simplify to at most this many faces."""


FAST_MESH = MeshSettings()
"""For the draft and fast presets."""
FULL_MESH = MeshSettings(resolution=384, face_limit=120_000)
"""For the full preset."""
