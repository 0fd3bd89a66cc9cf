"""Rays in, first hits or visibility out: large batches, cut into slices over the CPU's threads.

Knows nothing of shading. Which tracer answers follows the mesh's device: Embree on the CPU, Warp elsewhere.
"""

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor

from drgs.render.intersect.tracer import AbstractTracer
from drgs.render.intersect.tracer_embree import EmbreeTracer
from drgs.render.intersect.tracer_warp import WarpTracer
from drgs.render.records import Hits
from drgs.scene.mesh import TriangleMesh
from drgs.warp_torch import in_thread_pool, share_out, thread_count

SLICE_RAYS = 65536
"""Rays of a CPU slice: long enough to hide Python, short enough to balance threads."""
SHORTEST_SLICE = 4096
"""Fewer rays are not cut up further to give every thread some."""
SLICE_RAYS_GPU = 1 << 24
EXTENTS = (1e-5, 1e9)
"""Diagonals of a mesh's box between which squared areas of triangles neither under- nor overflow [world units]."""
MAX_OFFSET = 1e5
"""Largest coordinate of a mesh, in diagonals of its box."""


def build_tracer(mesh: TriangleMesh) -> AbstractTracer:
    """The fastest tracer of the mesh's device.

    Raises:
        ValueError: float32 cannot hold this mesh (docs/stability.md).
    """
    _check_numbers(mesh)
    return EmbreeTracer(mesh) if mesh.vertices.device.type == "cpu" else WarpTracer(mesh)


def _check_numbers(mesh: TriangleMesh) -> None:
    """Refuse a mesh of which pictures would be wrong without a word."""
    if len(mesh.vertices) == 0:
        raise ValueError("the mesh has no vertices")
    low, high = mesh.vertices.detach().amin(0), mesh.vertices.detach().amax(0)
    extent, reach = float(torch.linalg.norm(high - low)), float(torch.maximum(low.abs(), high.abs()).max())  # NaN where there is one
    if not EXTENTS[0] <= extent <= EXTENTS[1]:
        raise ValueError(f"the mesh spans {extent:g} world units; expected {EXTENTS[0]:g} to {EXTENTS[1]:g}: scale it")
    if reach > MAX_OFFSET * extent:
        raise ValueError(
            f"the mesh spans {extent:g} world units and lies up to {reach:g} from the origin, where float32 keeps too few digits of its "
            f"shape; expected at most {MAX_OFFSET:g} times its span: move it nearer"
        )


def over_slices(
    count: int, device: torch.device, work: Callable[[int, int], Any], slice_length: int | None = None, shortest: int | None = None
) -> list:
    """work(first, last) for slices of range(count): over the thread pool on the CPU; one after the other elsewhere, and in the pool.

    Args:
        shortest: slices shrink towards the end down to this length, so that no thread waits long for another's last one; None: all alike.
    """
    if count == 0:
        return []
    length = slice_length or (min(SLICE_RAYS, max(SHORTEST_SLICE, -(-count // thread_count()))) if device.type == "cpu" else SLICE_RAYS_GPU)
    if shortest is None:
        slices = -(-count // length)
        edges = [count * k // slices for k in range(slices + 1)]
    else:
        edges = [0]
        while edges[-1] < count:
            left = count - edges[-1]
            edges.append(edges[-1] + min(left, length, max(shortest, left // (2 * thread_count()))))
    if device.type != "cpu" or thread_count() == 1 or len(edges) == 2 or in_thread_pool():
        return [work(a, b) for a, b in pairwise(edges)]
    return share_out(work, edges)


def trace_rays(origins: Tensor, directions: Tensor, tracer: AbstractTracer) -> Hits:
    """First hits of rays (ray, 3) with unit directions."""
    origins, directions = origins.detach().float().contiguous(), directions.detach().float().contiguous()
    parts = over_slices(len(origins), origins.device, lambda a, b: tracer.closest_hits(origins[a:b], directions[a:b]))
    if len(parts) == 1:
        return parts[0]
    if not parts:
        return tracer.closest_hits(origins, directions)
    return Hits(*(torch.cat([getattr(part, name) for part in parts]) for name in ("hit", "distance", "face", "barycentric")))
