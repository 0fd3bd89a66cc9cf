"""Light that surfaces are known to send, so that rays which meet them need not look for it.

In: a vertex's light and its standard error, for a path of one more surface. Out: what a hit sends back, where all corners of its face are known.
Who knows it, and how well, is the caller's (progressive/kept_light/light_of_hits.py); the integrators read it at the first surface that a ray meets.
The back of a triangle sends nothing. Twin: drgs/reference/kept_light.py.
"""

from dataclasses import dataclass
from typing import Any

import torch
import warp as wp
from jaxtyping import Bool, Float
from torch import Tensor

from drgs.warp_torch import warp_array

wp.set_module_options({"enable_backward": False})


@dataclass(frozen=True, eq=False)
class SurfaceLight:
    """Of a mesh."""

    vertex: Float[Tensor, "vertex 4"]
    """Radiance that is sent to all sides alike, and 1; 0 where it is not known, -1 where it never will be."""
    face_normal: Float[Tensor, "face 3"]
    """Unit; 0 of faces whose corners cannot speak for what lies between them."""
    asked: Bool[Tensor, "vertex"]
    """Integrators write down here where they missed it."""


@wp.struct
class SurfaceLightArrays:
    """SurfaceLight as kernels see it; empty where nothing is known."""

    vertex: wp.array[wp.vec4]
    face_normal: wp.array[wp.vec3]
    asked: wp.array[wp.bool]
    """Threads may write the same True to one vertex."""


def surface_light_arrays(light: SurfaceLight | None, like: Tensor) -> Any:
    """The struct that kernels read; shares memory with the tensors.

    Args:
        like: a tensor of the mesh's device.
    """
    arrays = SurfaceLightArrays()
    arrays.vertex = warp_array(like.new_empty(0, 4) if light is None else light.vertex, wp.vec4)
    arrays.face_normal = warp_array(like.new_empty(0, 3) if light is None else light.face_normal, wp.vec3)
    arrays.asked = warp_array(like.new_empty(0, dtype=torch.bool) if light is None else light.asked)
    return arrays


@wp.func
def light_of_hit(known: SurfaceLightArrays, faces: wp.array[int], face: int, barycentric: wp.vec2, arriving: wp.vec3) -> wp.vec4:
    """Radiance back along a ray that arrives at a face, and 1; zeros where it is not known."""
    nothing = wp.vec4(0.0, 0.0, 0.0, 0.0)
    normal = known.face_normal[face]
    if wp.dot(normal, normal) == 0.0:
        return nothing
    i = faces[3 * face]
    j = faces[3 * face + 1]
    k = faces[3 * face + 2]
    a = known.vertex[i]
    b = known.vertex[j]
    c = known.vertex[k]
    least = wp.min(a[3], wp.min(b[3], c[3]))
    if least == 0.0:
        known.asked[i] = True
        known.asked[j] = True
        known.asked[k] = True
    if least <= 0.0:
        return nothing
    if wp.dot(normal, arriving) >= 0.0:
        return wp.vec4(0.0, 0.0, 0.0, 1.0)
    y = barycentric[0]
    z = barycentric[1]
    light = (1.0 - y - z) * a + y * b + z * c
    return wp.vec4(light[0], light[1], light[2], 1.0)
