"""Rays against a mesh by Embree, on the CPU. Kernels call it by address, so threads scale and nothing is copied.

Rays are traced one by one: packets of sixteen were 5 % faster for first hits, but their answers could depend on a ray's neighbours. What a moving
picture sees takes four by four pixels at once (embree_block.h): it is its own first and last pass.
Void rays, which leave from far outside, never reach the tree.
"""

import copy
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
import warp as wp
from torch import Tensor

from drgs.maths.constants import VOID_BEYOND
from drgs.render.intersect.embree_library import EmbreeScene, function_address
from drgs.render.intersect.tracer import AbstractTracer, FirstHit, KernelQuery, MiddleView, mesh_extent
from drgs.render.native_source import native_source
from drgs.render.records import Hits
from drgs.scene.mesh import TriangleMesh
from drgs.warp_torch import load_kernel, warp_argument

wp.set_module_options({"enable_backward": False})

EMBREE_RAY = Path(__file__).with_name("embree_ray.h")
"""What a native function body needs to trace a ray."""


def _source(name: str) -> str:
    return native_source(Path(__file__).with_name(name), EMBREE_RAY, constants={"VOID_BEYOND": VOID_BEYOND})


@wp.struct
class EmbreeHandles:
    """How kernels reach Embree: addresses of its functions, and of a scene."""

    intersect_fn: wp.uint64
    """rtcIntersect1."""
    intersect_sixteen_fn: wp.uint64
    """rtcIntersect16."""
    occluded_fn: wp.uint64
    """rtcOccluded1."""
    scene: wp.uint64


@wp.func_native(_source("embree_closest.h"))
def embree_first_hit(embree: EmbreeHandles, origin: wp.vec3, direction: wp.vec3, reach: float) -> wp.vec4d: ...


@wp.func_native(_source("embree_occluded.h"))
def embree_occluded(embree: EmbreeHandles, origin: wp.vec3, direction: wp.vec3) -> wp.bool: ...


@wp.func_native(native_source(Path(__file__).with_name("embree_block.h")))
def embree_block(
    embree: EmbreeHandles, view: MiddleView, x: int, y: int, face: wp.array[int], barycentric: wp.array[wp.vec2]
) -> wp.int32: ...


@wp.func
def embree_closest(embree: EmbreeHandles, origin: wp.vec3, direction: wp.vec3, reach: float) -> FirstHit:
    # Doubles: they hold a float's value and a triangle's number exactly.
    found = embree_first_hit(embree, origin, direction, reach)
    hit = FirstHit()
    hit.distance = float(found[0])
    hit.face = int(found[1])
    hit.barycentric = wp.vec2(float(found[2]), float(found[3]))
    return hit


@wp.kernel
def find_closest(
    embree: EmbreeHandles,
    origins: wp.array[wp.vec3],
    directions: wp.array[wp.vec3],
    # outputs
    hit: wp.array[wp.bool],
    distance: wp.array[float],
    face: wp.array[int],
    barycentric: wp.array[wp.vec2],
):
    i = wp.tid()
    found = embree_closest(embree, origins[i], directions[i], wp.inf)
    hit[i] = found.face >= 0
    distance[i] = found.distance
    face[i] = found.face
    barycentric[i] = found.barycentric


@wp.kernel
def find_occluded(
    embree: EmbreeHandles,
    origins: wp.array[wp.vec3],
    directions: wp.array[wp.vec3],
    # outputs
    blocked: wp.array[wp.bool],
):
    i = wp.tid()
    blocked[i] = embree_occluded(embree, origins[i], directions[i])


def _embree_scene(mesh: TriangleMesh, watertight: bool = True) -> EmbreeScene:
    return EmbreeScene(mesh.vertices.detach().float().numpy(), mesh.faces.int().numpy(), watertight)


def _handles_of(scene: EmbreeScene) -> Any:
    handles = EmbreeHandles()
    handles.intersect_fn = function_address("rtcIntersect1")
    handles.intersect_sixteen_fn = function_address("rtcIntersect16")
    handles.occluded_fn = function_address("rtcOccluded1")
    handles.scene = scene.address
    return handles


class EmbreeTracer(AbstractTracer):
    """Final. Holds its own copy of the triangles; build a new one for a moved mesh (24 ms for 120 000 faces)."""

    kernel_query = KernelQuery(embree_closest, EmbreeHandles, embree_block)

    def __init__(self, mesh: TriangleMesh) -> None:
        self.mesh = mesh
        self.extent, self.lift = mesh_extent(mesh)
        self._scene = _embree_scene(mesh)
        self._handles = _handles_of(self._scene)
        for kernel in (find_closest, find_occluded):
            load_kernel(kernel, "cpu")  # before threads race for it

    @property
    def handle(self) -> Any:
        return self._handles

    @cached_property
    def swift(self) -> "EmbreeTracer":
        """With a second tree, built when it is first asked for (60 to 80 ms of a core for 200 000 to 240 000 faces, and 9 MB)."""
        _ = self.face_normals  # which both share
        other = copy.copy(self)
        other._scene = _embree_scene(self.mesh, watertight=False)
        other._handles = _handles_of(other._scene)
        return other

    def closest_hits(self, origins: Tensor, directions: Tensor) -> Hits:
        count = len(origins)
        hit, distance = torch.empty(count, dtype=torch.bool), torch.empty(count)
        face, barycentric = torch.empty(count, dtype=torch.int32), torch.empty(count, 2)
        inputs = [self._handles, warp_argument(origins, wp.vec3), warp_argument(directions, wp.vec3)]
        outputs = [warp_argument(hit), warp_argument(distance), warp_argument(face), warp_argument(barycentric, wp.vec2)]
        wp.launch(find_closest, dim=count, inputs=inputs, outputs=outputs, device="cpu")
        return Hits(hit, distance, face, barycentric)

    def occluded(self, origins: Tensor, directions: Tensor) -> Tensor:
        blocked = torch.empty(len(origins), dtype=torch.bool)
        inputs = [self._handles, warp_argument(origins, wp.vec3), warp_argument(directions, wp.vec3)]
        wp.launch(find_occluded, dim=len(origins), inputs=inputs, outputs=[warp_argument(blocked)], device="cpu")
        return blocked
