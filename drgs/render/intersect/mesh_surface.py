"""The mesh as kernels see it: the surface at a hit, and the rays that need no tracing."""

from typing import Any

import torch
import warp as wp
from torch import Tensor

from drgs.maths.constants import VOID_ORIGIN
from drgs.render.intersect.horizon_kernels import horizon_sector
from drgs.scene.mesh import TriangleMesh
from drgs.warp_torch import warp_array

wp.set_module_options({"enable_backward": False})


@wp.struct
class MeshArrays:
    """TriangleMesh as kernels see it."""

    vertices: wp.array[wp.vec3]
    faces: wp.array[int]
    normals: wp.array[wp.vec3]
    albedo: wp.array[wp.vec3]
    roughness: wp.array[float]
    metallic: wp.array[float]
    lift: float
    """How far ray origins stand off the surface [world units]."""
    horizon: wp.array[float]
    """Eight of each face (horizon_sector); empty where none is known."""


def mesh_arrays(mesh: TriangleMesh, lift: float, horizon: Tensor | None = None) -> Any:
    """The struct that kernels read; shares memory with the tensors.

    Args:
        horizon: (face, SECTORS) sines; rays above them are not traced.
    """
    arrays = MeshArrays()
    arrays.vertices = warp_array(mesh.vertices.float(), wp.vec3)
    arrays.faces = warp_array(mesh.faces.to(torch.int32).reshape(-1))
    arrays.normals = warp_array(mesh.normals.float(), wp.vec3)
    arrays.albedo = warp_array(mesh.albedo.float(), wp.vec3)
    arrays.roughness = warp_array(mesh.roughness.float())
    arrays.metallic = warp_array(mesh.metallic.float())
    arrays.lift = lift
    arrays.horizon = warp_array(mesh.roughness[:0].float() if horizon is None else horizon.reshape(-1))
    return arrays


@wp.struct
class Surface:
    """A point on the mesh with its interpolated attributes."""

    position: wp.vec3
    normal: wp.vec3
    """Shading normal."""
    face_normal: wp.vec3
    albedo: wp.vec3
    roughness: float
    metallic: float


@wp.func
def surface_at(mesh: MeshArrays, face: int, barycentric: wp.vec2) -> Surface:
    a = mesh.faces[3 * face]
    b = mesh.faces[3 * face + 1]
    c = mesh.faces[3 * face + 2]
    y = barycentric[0]
    z = barycentric[1]
    x = 1.0 - y - z
    pa = mesh.vertices[a]
    pb = mesh.vertices[b]
    pc = mesh.vertices[c]
    surface = Surface()
    surface.position = x * pa + y * pb + z * pc
    surface.normal = wp.normalize(x * mesh.normals[a] + y * mesh.normals[b] + z * mesh.normals[c])
    surface.face_normal = wp.normalize(wp.cross(pb - pa, pc - pa))
    surface.albedo = x * mesh.albedo[a] + y * mesh.albedo[b] + z * mesh.albedo[c]
    surface.roughness = x * mesh.roughness[a] + y * mesh.roughness[b] + z * mesh.roughness[c]
    surface.metallic = x * mesh.metallic[a] + y * mesh.metallic[b] + z * mesh.metallic[c]
    return surface


@wp.func
def far_along(direction: wp.vec3) -> wp.vec3:
    """An origin far outside from which a ray leads away: it misses at the root of the tree."""
    return wp.vec3(
        wp.where(direction[0] < 0.0, -VOID_ORIGIN, VOID_ORIGIN),
        wp.where(direction[1] < 0.0, -VOID_ORIGIN, VOID_ORIGIN),
        wp.where(direction[2] < 0.0, -VOID_ORIGIN, VOID_ORIGIN),
    )


@wp.func
def face_limit(mesh: MeshArrays, face: int, normal: wp.vec3, direction: wp.vec3) -> float:
    """Sine of elevation above which a ray from a face meets nothing; 2 where that is not known, nor the face (-1)."""
    if mesh.horizon.shape[0] == 0 or face < 0:
        return 2.0
    return mesh.horizon[8 * face + horizon_sector(normal, direction)]
