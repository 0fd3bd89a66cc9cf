"""An asset: the relightable object at rest, and what it was made from."""

from dataclasses import dataclass, field

from drgs.scene.binding import Binding
from drgs.scene.camera import Camera
from drgs.scene.environment import Environment
from drgs.scene.gaussians import Gaussians
from drgs.scene.mesh import TriangleMesh

SCHEMA_VERSION = 1
"""Of the asset folder; a reader refuses a larger one."""


@dataclass(frozen=True, eq=False)
class Asset:
    """Everything a renderer or an editor needs. Written by pack_asset, read by everything."""

    gaussians: Gaussians | None
    """None for an asset imported from a mesh: primary visibility is then the mesh."""
    mesh: TriangleMesh
    binding: Binding | None
    environment: Environment
    """The recovered light of the capture (a constant 1 for imported meshes)."""
    cameras: tuple[Camera, ...] = ()
    """Training cameras."""
    meters_per_unit: float = 1.0
    provenance: dict = field(default_factory=dict)
    """Plain JSON: source, preset, seed, versions, seconds per stage, quality."""
