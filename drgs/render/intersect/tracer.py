"""What every ray tracer against a mesh offers. Implementations: tracer_embree (CPU), tracer_warp (CPU and CUDA)."""

import copy
from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, Self

import torch
import warp as wp
from torch import Tensor

from drgs.render.intersect.horizon import Horizons
from drgs.render.records import Hits
from drgs.scene.mesh import TriangleMesh

LIFT_OF_EXTENT = 1e-5
"""Ray origins stand this share of the mesh's extent off its surface ..."""
LIFT_OF_COORDINATE = 1e-6
"""... plus this share of the largest coordinate: about eight float32 steps, for meshes far from the origin."""


@wp.struct
class FirstHit:
    """What a ray meets first, inside a kernel."""

    distance: float
    """[world units]."""
    face: int
    """-1 where nothing is met; then the others mean nothing."""
    barycentric: wp.vec2
    """Weights of the face's second and third vertex."""


@wp.struct
class MiddleView:
    """A camera that looks through the middles of pixels."""

    image_width: int
    image_height: int
    camera_from_pixel: wp.mat33
    world_from_camera: wp.mat33
    center: wp.vec3
    axis: wp.vec3
    """Unit viewing axis [world]."""


@wp.func
def middle_direction(view: MiddleView, x: int, y: int) -> wp.vec3:
    """Unit, through a pixel's middle [world]."""
    return wp.normalize(view.world_from_camera * (view.camera_from_pixel * wp.vec3(float(x) + 0.5, float(y) + 0.5, 1.0)))


@dataclass(frozen=True)
class KernelQuery:
    """How a kernel finds first hits itself; a kernel is made for each tracer's."""

    closest_fn: Any
    """wp.func of a handle, a ray's origin and direction and its reach [world units] -> FirstHit."""
    handle_type: Any
    """Of its first argument."""
    block_fn: Any = None
    """wp.func of a handle, a MiddleView, the first x and y of four by four pixels, faces and barycentrics of all pixels, which it writes where
    there is something to see -> how many of them see something. One ray's answer may depend on its neighbours' (on a common edge, which
    face). None: the rays go one by one, by closest_fn."""


class AbstractTracer(ABC):
    """Answers ray queries on the calling thread; callers may use it from several threads at once.

    Rays are (ray, 3) float32 tensors on the mesh's device; directions are unit. A void ray is one whose origin is far
    outside (see sample_rays): it misses at the root.
    """

    mesh: TriangleMesh
    lift: float
    """How far ray origins must stand off the surface [world units]."""
    extent: float
    """Diagonal of the mesh's box [world units]."""
    horizons: Horizons | None = None
    """Rays that leave a face above its horizon need no tracing; None until they are looked for."""

    @cached_property
    def face_normals(self) -> Tensor:
        """(face, 3) unit normals of the triangles."""
        a, b, c = self.mesh.vertices.detach()[self.mesh.faces.long()].unbind(1)
        return torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a), dim=-1, eps=1e-30)

    def with_materials(self, mesh: TriangleMesh) -> Self:
        """A tracer of a mesh of the same shape with other materials; shares the tree."""
        other = copy.copy(self)
        other.mesh = mesh
        if "swift" in other.__dict__:
            other.__dict__["swift"] = other.swift.with_materials(mesh)
        return other

    @property
    def swift(self) -> "AbstractTracer":
        """A tracer of the same mesh that may let a ray pass between triangles with a common edge, where that is faster. Made once."""
        return self

    @property
    def swift_if_made(self) -> "AbstractTracer":
        """`swift`, or this one where that would have to be made first."""
        return self.__dict__.get("swift", self)

    kernel_query: ClassVar[KernelQuery]

    @property
    @abstractmethod
    def handle(self) -> Any:
        """This tracer's mesh, for kernel_query."""

    @abstractmethod
    def closest_hits(self, origins: Tensor, directions: Tensor) -> Hits:
        """First surface along each ray."""

    @abstractmethod
    def occluded(self, origins: Tensor, directions: Tensor) -> Tensor:
        """(ray,) bool: whether anything at all lies along each ray."""


def mesh_extent(mesh: TriangleMesh) -> tuple[float, float]:
    """Diagonal of the box and the lift of ray origins [world units] of a mesh."""
    low, high = mesh.vertices.amin(0), mesh.vertices.amax(0)
    extent = float(torch.linalg.norm(high - low))
    return extent, LIFT_OF_EXTENT * extent + LIFT_OF_COORDINATE * float(torch.maximum(low.abs(), high.abs()).max())
