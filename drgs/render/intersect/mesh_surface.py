"""The mesh as kernels see it: the surface at a hit, and the rays that need no tracing."""

from typing import Any
from weakref import WeakKeyDictionary

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
    detail_parts: int
    """Of each side of a face, AlbedoDetail's grid; 0: there is no detail."""
    detail_codes: wp.array[wp.uint8]
    """Three of each sample."""
    detail_share: wp.array[float]
    """Of each vertex; empty: all wear all of it."""


_known: WeakKeyDictionary[TriangleMesh, tuple[tuple[float, Tensor | None, Any], ...]] = WeakKeyDictionary()
"""What mesh_arrays gave for meshes that live: a moving picture asks six times for the same two."""


def mesh_arrays(mesh: TriangleMesh, lift: float, horizon: Tensor | None = None) -> Any:
    """The struct that kernels read; shares memory with the tensors. Nobody writes to it.

    Args:
        horizon: (face, SECTORS) sines; rays above them are not traced.
    """
    known = _known.get(mesh, ())
    for given_lift, given_horizon, arrays in known:
        if given_lift == lift and given_horizon is horizon:
            return arrays
    arrays = _mesh_arrays(mesh, lift, horizon)
    _known[mesh] = (*known[-1:], (lift, horizon, arrays))
    return arrays


def _mesh_arrays(mesh: TriangleMesh, lift: float, horizon: Tensor | None) -> Any:
    arrays = MeshArrays()
    arrays.vertices = warp_array(mesh.vertices.float(), wp.vec3)
    arrays.faces = warp_array(mesh.faces.to(torch.int32).reshape(-1))
    arrays.normals = warp_array(mesh.normals.float(), wp.vec3)
    arrays.albedo = warp_array(mesh.albedo.float(), wp.vec3)
    arrays.roughness = warp_array(mesh.roughness.float())
    arrays.metallic = warp_array(mesh.metallic.float())
    arrays.lift = lift
    none = mesh.roughness[:0].float()
    arrays.horizon = warp_array(none if horizon is None else horizon.reshape(-1))
    detail = mesh.detail
    arrays.detail_parts = 0 if detail is None else detail.parts
    arrays.detail_codes = warp_array(none.to(torch.uint8) if detail is None else detail.codes.reshape(-1))
    arrays.detail_share = warp_array(none if detail is None or detail.share is None else detail.share.float())
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
def detail_factor(mesh: MeshArrays, face: int, sample: int) -> wp.vec3:
    """Of one sample of a face; twin of factors_of."""
    parts = mesh.detail_parts
    at = 3 * (face * (((parts + 1) * (parts + 2)) / 2) + sample)
    root = wp.vec3(float(mesh.detail_codes[at]), float(mesh.detail_codes[at + 1]), float(mesh.detail_codes[at + 2])) / 128.0
    return wp.cw_mul(root, root)


@wp.func
def detailed_albedo(mesh: MeshArrays, face: int, y: float, z: float, albedo: wp.vec3, share: float) -> wp.vec3:
    """Twin of drgs/scene/albedo_detail.py's."""
    parts = mesh.detail_parts
    row = parts + 1
    u = wp.clamp(y, 0.0, 1.0) * float(parts)
    v = wp.clamp(z, 0.0, 1.0) * float(parts)
    i = wp.min(int(u), parts - 1)
    j = wp.min(wp.min(int(v), parts - 1), parts - 1 - i)
    f = u - float(i)
    g = v - float(j)
    beside = j * row - (j * (j - 1)) / 2 + i + 1
    above = (j + 1) * row - (j * (j + 1)) / 2 + i
    factor = wp.vec3(0.0, 0.0, 0.0)
    if f + g > 1.0 and i + j < parts - 1:
        factor = (
            (f + g - 1.0) * detail_factor(mesh, face, above + 1)
            + (1.0 - g) * detail_factor(mesh, face, beside)
            + (1.0 - f) * detail_factor(mesh, face, above)
        )
    else:
        factor = (
            (1.0 - f - g) * detail_factor(mesh, face, beside - 1)
            + f * detail_factor(mesh, face, beside)
            + g * detail_factor(mesh, face, above)
        )
    one = wp.vec3(1.0, 1.0, 1.0)
    detailed = wp.cw_mul(albedo, one + share * (factor - one))
    return wp.min(wp.max(detailed, wp.vec3(0.0, 0.0, 0.0)), one)


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
    if mesh.detail_parts > 0:
        share = float(1.0)
        if mesh.detail_share.shape[0] > 0:
            share = x * mesh.detail_share[a] + y * mesh.detail_share[b] + z * mesh.detail_share[c]
        surface.albedo = detailed_albedo(mesh, face, y, z, surface.albedo, share)
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
