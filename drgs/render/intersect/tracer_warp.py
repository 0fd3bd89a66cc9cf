"""Rays against a mesh by Warp's BVH, on the device of the mesh's tensors."""

from typing import Any

import torch
import warp as wp
from torch import Tensor

from drgs.maths.constants import UNBOUNDED
from drgs.render.intersect.tracer import AbstractTracer, FirstHit, KernelQuery, mesh_extent
from drgs.render.records import Hits
from drgs.scene.mesh import TriangleMesh
from drgs.warp_torch import load_kernel, warp_array, warp_device

wp.set_module_options({"enable_backward": False})

LEAF_SIZE = 1
"""Triangles in a leaf of the tree: rays take 0.8 of the time that they take with Warp's own four (240 000 faces, an H100)."""


@wp.func
def mesh_closest(mesh: wp.uint64, origin: wp.vec3, direction: wp.vec3, reach: float) -> FirstHit:
    hit = FirstHit()
    hit.distance = wp.inf
    hit.face = -1
    query = wp.mesh_query_ray(mesh, origin, direction, reach)
    if query.result:
        hit.distance = query.t
        hit.face = query.face
        # Warp weighs the first and second corner; the project's records hold the second and third.
        hit.barycentric = wp.vec2(query.v, 1.0 - query.u - query.v)
    return hit


@wp.kernel
def query_closest(
    mesh: wp.uint64,
    origins: wp.array[wp.vec3],
    directions: wp.array[wp.vec3],
    # outputs
    distance: wp.array[float],
    face: wp.array[int],
    barycentric: wp.array[wp.vec2],
):
    i = wp.tid()
    found = mesh_closest(mesh, origins[i], directions[i], UNBOUNDED)
    distance[i] = found.distance
    face[i] = found.face
    barycentric[i] = found.barycentric


@wp.kernel
def query_any(
    mesh: wp.uint64,
    origins: wp.array[wp.vec3],
    directions: wp.array[wp.vec3],
    # outputs
    blocked: wp.array[wp.bool],
):
    i = wp.tid()
    blocked[i] = wp.mesh_query_ray_anyhit(mesh, origins[i], directions[i], UNBOUNDED)


class WarpTracer(AbstractTracer):
    """Final."""

    kernel_query = KernelQuery(mesh_closest, wp.uint64)

    def __init__(self, mesh: TriangleMesh) -> None:
        self.mesh = mesh
        self.extent, self.lift = mesh_extent(mesh)
        self._device = warp_device(mesh.vertices)
        self._vertices = mesh.vertices.detach().float().contiguous().clone()
        self._faces = mesh.faces.to(torch.int32).reshape(-1).contiguous()
        self._mesh = wp.Mesh(warp_array(self._vertices, wp.vec3), warp_array(self._faces), bvh_leaf_size=LEAF_SIZE)
        for kernel in (query_closest, query_any):
            load_kernel(kernel, self._device)  # before threads race for it

    @property
    def handle(self) -> Any:
        return self._mesh.id

    def refit(self, vertices: Tensor) -> None:
        """Move the vertices (vertex, 3) without rebuilding the tree."""
        self._vertices.copy_(vertices)
        self._mesh.refit()

    def closest_hits(self, origins: Tensor, directions: Tensor) -> Hits:
        count = len(origins)
        distance, barycentric = origins.new_empty(count), origins.new_empty(count, 2)
        face = torch.empty(count, dtype=torch.int32, device=origins.device)
        inputs = [self._mesh.id, warp_array(origins, wp.vec3), warp_array(directions, wp.vec3)]
        outputs = [warp_array(distance), warp_array(face), warp_array(barycentric, wp.vec2)]
        wp.launch(query_closest, dim=count, inputs=inputs, outputs=outputs, device=self._device)
        return Hits(face >= 0, distance, face, barycentric)

    def occluded(self, origins: Tensor, directions: Tensor) -> Tensor:
        blocked = torch.empty(len(origins), dtype=torch.bool, device=origins.device)
        inputs = [self._mesh.id, warp_array(origins, wp.vec3), warp_array(directions, wp.vec3)]
        wp.launch(query_any, dim=len(origins), inputs=inputs, outputs=[warp_array(blocked)], device=self._device)
        return blocked
