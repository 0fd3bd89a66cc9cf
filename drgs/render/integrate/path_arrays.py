"""Rays that met a surface, from where their paths go on, as kernels see them."""

from typing import Any

import torch
import warp as wp

from drgs.warp_torch import warp_array


@wp.struct
class PathArrays:
    """Packed in the order of their rays."""

    ray: wp.array[wp.int64]
    """Number of the first ray in the batch."""
    face: wp.array[int]
    barycentric: wp.array[wp.vec2]
    arriving: wp.array[wp.vec3]
    """Unit direction in which the path arrives at the face."""
    throughput: wp.array[wp.vec3]
    """Share of the light from there that reaches the origin of the first ray."""


def path_arrays(count: int) -> Any:
    """Space for this many paths on the CPU."""
    arrays = PathArrays()
    arrays.ray = warp_array(torch.empty(count, dtype=torch.int64))
    arrays.face = warp_array(torch.empty(count, dtype=torch.int32))
    arrays.barycentric = warp_array(torch.empty(count, 2), wp.vec2)
    arrays.arriving, arrays.throughput = (warp_array(torch.empty(count, 3), wp.vec3) for _ in range(2))
    return arrays
