"""Light at shading points on the CPU: rays are started, asked about, followed and summed a few points at a time, in one kernel.

The same estimate as shade.py's steps one after the other, which a test holds it to. No ray is written down but in a little memory that
each launch uses over and over, so it stays in the cache, and Python is entered once for tens of thousands of rays.
"""

from typing import Any

import torch
import warp as wp
from torch import Tensor

from drgs.render.environment_table import EnvironmentLight
from drgs.render.ray_memory import TracedRays
from drgs.render.sample_rays import PointArrays, SampleSet
from drgs.render.sum_samples import sum_point
from drgs.render.trace_indirect import MeshArrays, ray_source
from drgs.render.tracer_embree import EMBREE_RAY, EmbreeTracer
from drgs.warp_torch import warp_array

RAYS_A_CHUNK = 2048
"""Rays that a launch index works on: their 60 kB stay in a core's own cache."""


@wp.struct
class PathArrays:
    """Rays that met a surface, packed in their order; `path_count` tells how many there are."""

    ray: wp.array[wp.int64]
    """Number in the chunk."""
    face: wp.array[int]
    barycentric: wp.array[wp.vec2]
    arriving: wp.array[wp.vec3]
    """Unit direction of the ray."""
    throughput: wp.array[wp.vec3]


@wp.struct
class RayAnswers:
    """ray_memory.TracedRays; empty where there are none."""

    direction: wp.array[wp.vec3]
    hit: wp.array[wp.bool]
    face: wp.array[int]
    barycentric: wp.array[wp.vec2]


@wp.func_native(EMBREE_RAY + ray_source("start_rays.h", 0, 2))
def ask_sixteen_rays(
    intersect: wp.uint64, occluded: wp.uint64, tree: wp.uint64, base: int, ray_count: int, first: int,
    points: PointArrays, starts: wp.array(dtype=wp.vec3), surface_normals: wp.array(dtype=wp.vec3),
    start_face: wp.array(dtype=int), horizon: wp.array(dtype=float),
    light: EnvironmentLight, samples: SampleSet, keep_dark: int, known: RayAnswers,
    cosine_weight: wp.array(dtype=float), specular: wp.array(dtype=wp.vec3), radiance: wp.array(dtype=wp.vec3), blocked: wp.array(dtype=wp.bool),
    indirect: wp.array(dtype=wp.vec3), path_count: wp.array(dtype=int), packed: PathArrays, kept: RayAnswers,
): ...  # fmt: skip


@wp.func_native(EMBREE_RAY + ray_source("scatter_hits.h", 0, 2, 3))
def follow_sixteen_paths(
    intersect: wp.uint64, occluded: wp.uint64, tree: wp.uint64, base: int, paths: int,
    path_ray: wp.array(dtype=wp.int64), face: wp.array(dtype=int), barycentric: wp.array(dtype=wp.vec2), ray_direction: wp.array(dtype=wp.vec3),
    throughput: wp.array(dtype=wp.vec3), first_point: int, depth: int, ends: int,
    points: PointArrays, light: EnvironmentLight, mesh: MeshArrays, samples: SampleSet,
    indirect: wp.array(dtype=wp.vec3), path_count: wp.array(dtype=int), packed: PathArrays,
): ...  # fmt: skip


@wp.kernel(enable_backward=False, module="unique")
def shade_chunks(
    intersect: wp.uint64,
    occluded: wp.uint64,
    tree: wp.uint64,
    first: int,
    last: int,
    chunk: int,
    points: PointArrays,
    starts: wp.array[wp.vec3],
    surface_normals: wp.array[wp.vec3],
    start_face: wp.array[int],
    horizon: wp.array[float],
    light: EnvironmentLight,
    mesh: MeshArrays,
    samples: SampleSet,
    bounces: int,
    known: RayAnswers,
    # room for a chunk's rays
    cosine_weight: wp.array[float],
    specular: wp.array[wp.vec3],
    radiance: wp.array[wp.vec3],
    blocked: wp.array[wp.bool],
    indirect: wp.array[wp.vec3],
    path_count: wp.array[int],
    even: PathArrays,
    odd: PathArrays,
    # outputs
    kept: RayAnswers,
    diffuse_out: wp.array[wp.vec3],
    specular_out: wp.array[wp.vec3],
    variance_out: wp.array[wp.vec3],
    visibility_out: wp.array[float],
):
    """A launch runs on one thread from its first index to its last, so all its chunks use the same room."""
    begin = first + wp.tid() * chunk
    end = wp.min(begin + chunk, last)
    count = samples.cosine + samples.ggx + samples.environment
    rays = (end - begin) * count
    path_count[0] = 0
    for group in range((rays + 15) // 16):
        ask_sixteen_rays(
            intersect, occluded, tree, 16 * group, rays, begin * count, points, starts, surface_normals, start_face, horizon, light, samples,
            bounces, known, cosine_weight, specular, radiance, blocked, indirect, path_count, even, kept,
        )  # fmt: skip
    for depth in range(bounces):
        side = depth % 2
        paths = path_count[side]
        path_count[1 - side] = 0
        ends = wp.where(depth + 1 == bounces, 1, 0)
        for group in range((paths + 15) // 16):
            if side == 0:
                follow_sixteen_paths(
                    intersect, occluded, tree, 16 * group, paths, even.ray, even.face, even.barycentric, even.arriving, even.throughput,
                    begin, depth, ends, points, light, mesh, samples, indirect, path_count, odd,
                )  # fmt: skip
            else:
                follow_sixteen_paths(
                    intersect, occluded, tree, 16 * group, paths, odd.ray, odd.face, odd.barycentric, odd.arriving, odd.throughput,
                    begin, depth, ends, points, light, mesh, samples, indirect, path_count, even,
                )  # fmt: skip
    for point in range(begin, end):
        sum_point(
            point, (point - begin) * count, points, samples, cosine_weight, specular, radiance, blocked, indirect, bounces,
            diffuse_out, specular_out, variance_out, visibility_out,
        )  # fmt: skip


def shade_slice(
    tracer: EmbreeTracer, first: int, last: int, given: list[Any], mesh: Any, samples: Any, rays_a_point: int, bounces: int,
    known: TracedRays | None, kept: TracedRays | None, sums: list[Any],
) -> int:  # fmt: skip
    """Points from `first` to `last`, and how many rays Embree was asked about. Runs on the calling thread.

    Args:
        given: PointArrays, starts, surface normals, faces, horizons of all faces and EnvironmentLight. mesh, samples: MeshArrays, SampleSet.
        known: of all points' rays, answers that may be used. kept: where to write theirs down.
        sums: where diffuse and specular light, variance and visibility of all points go.
    """
    chunk = max(1, RAYS_A_CHUNK // rays_a_point)
    rays = min(chunk, last - first) * rays_a_point
    room = [warp_array(torch.empty(rays)), *(warp_array(torch.empty(rays, 3), wp.vec3) for _ in range(2))]
    room += [warp_array(torch.empty(rays, dtype=torch.bool)), warp_array(torch.empty(rays, 3), wp.vec3)]
    paths = rays if bounces > 0 else 0
    counts = torch.zeros(3, dtype=torch.int32)
    wp.launch(
        shade_chunks,
        dim=-(-(last - first) // chunk),
        inputs=[*tracer.questions, first, last, chunk, *given, mesh, samples, bounces, _answers(known)],
        outputs=[*room, warp_array(counts), _path_arrays(paths), _path_arrays(paths if bounces > 1 else 0), _answers(kept), *sums],
        device="cpu",
    )
    return int(counts[2])


def _answers(rays: TracedRays | None) -> Any:
    arrays = RayAnswers()
    none = torch.empty(0)
    arrays.direction = warp_array(none.view(0, 3) if rays is None else rays.direction_world, wp.vec3)
    arrays.hit = warp_array(none.bool() if rays is None else rays.hit)
    has_surfaces = rays is not None and rays.face is not None and rays.barycentric is not None
    arrays.face = warp_array(rays.face if has_surfaces else none.int())
    arrays.barycentric = warp_array(rays.barycentric if has_surfaces else none.view(0, 2), wp.vec2)
    return arrays


def _path_arrays(count: int) -> Any:
    def room(*shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
        return torch.empty(count, *shape, dtype=dtype)

    arrays = PathArrays()
    arrays.ray, arrays.face = warp_array(room(dtype=torch.int64)), warp_array(room(dtype=torch.int32))
    arrays.barycentric = warp_array(room(2), wp.vec2)
    arrays.arriving, arrays.throughput = (warp_array(room(3), wp.vec3) for _ in range(2))
    return arrays
