"""What rays met, remembered over an edit: rays that are the same to the bit are not traced again.

Between two frames of an unmoved camera and shape most first rays stay as they are: a new environment changes only those sampled from it, a
new albedo hardly any. The comparison is exact, so nothing need be known about what an edit did to the samples.
Only a frame's first pass is remembered: it is the one that somebody waits for; the picture shown before it, of every other pixel
(progressive/edited_picture.py), reads what it knows. While the camera or the shape moves nothing is, for the next frame's
rays start elsewhere: the first edit after a move traces all its rays.
"""

from dataclasses import dataclass
from typing import Any

import torch
import warp as wp
from torch import Tensor

from drgs.maths.constants import VOID_BEYOND
from drgs.render.intersect.tracer import AbstractTracer
from drgs.render.records import Hits, TracedRays
from drgs.warp_torch import warp_array, warp_device

wp.set_module_options({"enable_backward": False})

MAX_RAYS = 1 << 22
"""More are not remembered: 25 bytes each, 37 with surfaces."""
_NO_FACE = torch.full((1,), -1, dtype=torch.int32)


@dataclass
class RayMemory:
    """Holds the rays of the last estimate that was made with it."""

    rays: TracedRays | None = None
    writes: bool = True
    """Whether an estimate's rays are kept at all."""


@wp.struct
class TracedArrays:
    """TracedRays as kernels see them; empty where there are none."""

    direction: wp.array[wp.vec3]
    hit: wp.array[wp.bool]
    face: wp.array[int]
    barycentric: wp.array[wp.vec2]


def traced_arrays(rays: TracedRays | None) -> Any:
    """The struct that kernels read or write; shares memory with the tensors."""
    arrays = TracedArrays()
    none = torch.empty(0)
    arrays.direction = warp_array(none.view(0, 3) if rays is None else rays.direction_world, wp.vec3)
    arrays.hit = warp_array(none.bool() if rays is None else rays.hit)
    arrays.face = warp_array(none.int() if rays is None or rays.face is None else rays.face)
    arrays.barycentric = warp_array(none.view(0, 2) if rays is None or rays.barycentric is None else rays.barycentric, wp.vec2)
    return arrays


@wp.kernel
def mark_changed_rays(
    origin: wp.array[wp.vec3],
    direction: wp.array[wp.vec3],
    known_direction: wp.array[wp.vec3],
    # outputs
    changed: wp.array[wp.bool],
):
    i = wp.tid()
    d = direction[i]
    k = known_direction[i]
    outside = wp.abs(origin[i][0]) > VOID_BEYOND
    changed[i] = not outside and not (d[0] == k[0] and d[1] == k[1] and d[2] == k[2])


@wp.kernel
def note_directions(
    origin: wp.array[wp.vec3],
    direction: wp.array[wp.vec3],
    # outputs
    noted: wp.array[wp.vec3],
):
    i = wp.tid()
    noted[i] = direction[i]
    if wp.abs(origin[i][0]) > VOID_BEYOND:
        noted[i] = wp.vec3(wp.nan, wp.nan, wp.nan)


def empty_rays(memory: RayMemory | None, count: int, surfaces: bool, device: torch.device) -> TracedRays | None:
    """Unwritten rays; None where they are not remembered, or too many."""
    if memory is None or not memory.writes or count > MAX_RAYS:
        return None
    hit, direction = torch.empty(count, dtype=torch.bool, device=device), torch.empty(count, 3, device=device)
    if not surfaces:
        return TracedRays(direction, hit, None, None)
    return TracedRays(direction, hit, torch.empty(count, dtype=torch.int32, device=device), torch.empty(count, 2, device=device))


def usable_rays(memory: RayMemory | None, count: int, surfaces: bool) -> TracedRays | None:
    """The remembered rays, where they are those of an estimate of this many."""
    rays = None if memory is None else memory.rays
    return None if rays is None or len(rays.hit) != count or (surfaces and rays.face is None) else rays


def rays_of_points(rays: TracedRays, points: Tensor, rays_a_point: int) -> TracedRays:
    """Those of the points (point,), one point's after another's, of rays that are remembered for all of them."""
    chosen = (points.long()[:, None] * rays_a_point + torch.arange(rays_a_point, device=points.device)).flatten()
    face, barycentric = (None if values is None else values[chosen] for values in (rays.face, rays.barycentric))
    return TracedRays(rays.direction_world[chosen], rays.hit[chosen], face, barycentric)


def trace_batch(
    origin: Tensor, direction: Tensor, first: int, tracer: AbstractTracer, surfaces: bool, known: TracedRays | None, kept: TracedRays | None
) -> tuple[Hits, int]:
    """What a batch of rays (ray, 3) meets, and how many of them the tracer was given. Runs on the calling thread.

    Args:
        first: number of the batch's first ray among those known and kept.
        surfaces: False: only whether a ray meets anything; then nothing but `hit` means something.
        known: rays whose answers may be used. kept: where to write these down.
    """
    rays, device = slice(first, first + len(direction)), warp_device(direction)
    vectors = [warp_array(origin, wp.vec3), warp_array(direction, wp.vec3)]
    traced = len(direction)
    if known is None:
        hits = _trace(origin, direction, tracer, surfaces)
    else:
        changed = torch.empty(len(direction), dtype=torch.bool, device=direction.device)
        known_direction = warp_array(known.direction_world[rays], wp.vec3)
        wp.launch(mark_changed_rays, dim=len(direction), inputs=[*vectors, known_direction], outputs=[warp_array(changed)], device=device)
        again = torch.nonzero(changed).squeeze(-1)
        traced = len(again)
        found = _trace(origin[again], direction[again], tracer, surfaces)
        hit = known.hit[rays] & (origin[:, 0].abs() < VOID_BEYOND)
        hit[again] = found.hit
        face, barycentric = found.face, found.barycentric
        if known.face is not None and known.barycentric is not None and surfaces:
            face, barycentric = known.face[rays].clone(), known.barycentric[rays].clone()
            face[again], barycentric[again] = found.face, found.barycentric
        hits = Hits(hit, direction[:, 0], face, barycentric) if surfaces else _visibility(hit, direction)
    if kept is not None:
        noted = warp_array(kept.direction_world[rays], wp.vec3)
        wp.launch(note_directions, dim=len(direction), inputs=vectors, outputs=[noted], device=device)
        kept.hit[rays] = hits.hit
        if kept.face is not None and kept.barycentric is not None:
            kept.face[rays], kept.barycentric[rays] = hits.face, hits.barycentric
    return hits, traced


def _trace(origin: Tensor, direction: Tensor, tracer: AbstractTracer, surfaces: bool) -> Hits:
    return tracer.closest_hits(origin, direction) if surfaces else _visibility(tracer.occluded(origin, direction), direction)


def _visibility(hit: Tensor, direction: Tensor) -> Hits:
    """A record of which nothing but `hit` is true."""
    return Hits(hit, direction[:, 0], _NO_FACE.to(hit.device).expand(len(hit)), direction[:, :2])
