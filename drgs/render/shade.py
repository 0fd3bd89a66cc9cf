"""Light at shading points: L_o = sum over samples of f L_i (n.wi) weight, by batches of rays.

In: points with the places their rays start from, the environment, a tracer. Out: diffuse and specular radiance, the variance
of the luminance, and the open share of the sky, per point. L_i is the environment where a ray escapes, else the outgoing
light of what it meets: nothing with 0 bounces, otherwise trace_indirect's estimate.
Rays that cannot carry light (below the true surface, black sky with no bounce) are void and cost next to nothing.

Source: Veach 1995 (balance heuristic). Twin: drgs/reference/shade.py.
"""

from dataclasses import dataclass
from typing import Any

import torch
import warp as wp
from jaxtyping import Float, Int
from torch import Tensor

from drgs.render.brdf_warp import alpha_of, specular_brdf
from drgs.render.environment_table import EnvironmentLight, lookup_radiance, table_place
from drgs.render.horizon import horizon_sector
from drgs.render.ray_memory import RayMemory, note_directions, room_for_rays, trace_batch, usable_rays
from drgs.render.records import ShadingPoints
from drgs.render.sample_rays import (
    PointArrays,
    SampleCounts,
    SampleSet,
    balance_weight,
    point_arrays,
    round_at,
    sample_set,
    sampled_direction,
    split_at,
)
from drgs.render.shade_embree import shade_chunks, shade_slice
from drgs.render.sum_samples import sum_samples
from drgs.render.trace_indirect import far_along, mesh_arrays, paths_of_hits, ray_source, scatter_kernel, trace_indirect
from drgs.render.trace_rays import over_slices
from drgs.render.tracer import AbstractTracer
from drgs.render.tracer_embree import EmbreeTracer
from drgs.render.tracer_warp import query_any
from drgs.warp_torch import in_thread_pool, load_kernel, thread_count, warp_array, warp_device

wp.set_module_options({"enable_backward": False})

RAYS_A_BATCH = 65536
"""Rays of one CPU batch: its 4 MB of ray data stay in the cache between sampling, tracing and shading."""
MIN_RAYS_A_BATCH = 8192
"""Fewer are not cut up further to balance threads: launches cost half a millisecond a batch."""
RAYS_A_BATCH_GPU = 1 << 23
RAYS_A_SLICE = 1 << 18
"""Rays of a launch of shade_embree, which keeps none of them."""


@dataclass(frozen=True, eq=False)
class RayStarts:
    """Where the rays of shading points leave from. Written by trace_primary or lift_points."""

    origin_world: Float[Tensor, "point 3"]
    """On the outer side of the mesh, the tracer's lift away from it."""
    surface_normal_world: Float[Tensor, "point 3"]
    """Unit normal of the triangle itself: light from below it is blocked by the surface, whatever the shading normal says."""
    face: Int[Tensor, "point"] | None = None
    """That triangle; -1 where a point stands on none."""


@dataclass(frozen=True, eq=False)
class PointLight:
    """Outgoing radiance of shading points."""

    diffuse: Float[Tensor, "point 3"]
    specular: Float[Tensor, "point 3"]
    variance: Float[Tensor, "point 3"]
    """Of the luminance of this one estimate, from the scatter of its samples within each strategy: whole, diffuse, specular."""
    visibility: Float[Tensor, "point"]
    """Open share of the cosine-weighted sky, 0..1."""


@wp.kernel
def start_rays(
    first: int,
    points: PointArrays,
    starts: wp.array[wp.vec3],
    surface_normals: wp.array[wp.vec3],
    start_face: wp.array[int],
    horizon: wp.array[float],
    light: EnvironmentLight,
    samples: SampleSet,
    keep_dark: int,
    # outputs
    origin: wp.array[wp.vec3],
    direction: wp.array[wp.vec3],
    cosine_weight: wp.array[float],
    specular: wp.array[wp.vec3],
    radiance: wp.array[wp.vec3],
):
    i = wp.tid()
    count = samples.cosine + samples.ggx + samples.environment
    point = (first + i) // count
    n = points.normal[point]
    wo = points.wo[point]
    roughness = points.roughness[point]
    alpha = alpha_of(roughness)
    start = wp.vec3(1.0e15, 1.0e15, 1.0e15)  # void rays leave from far outside and miss at the root of the tree
    wi = wp.vec3(0.57735027, 0.57735027, 0.57735027)
    w = wp.float32(0.0)
    f = wp.vec3(0.0, 0.0, 0.0)
    seen = wp.vec3(0.0, 0.0, 0.0)
    if wp.dot(n, wo) > 0.0:
        split = split_at(samples, points, point)
        candidate = sampled_direction(
            samples, split, light, points.pixel[point], round_at(samples, points, point), (first + i) % count, wo, n, alpha
        )
        if wp.dot(n, candidate) > 0.0 and wp.dot(surface_normals[point], candidate) > 0.0:
            place = table_place(light, candidate)
            seen = lookup_radiance(light, place)
            if keep_dark != 0 or wp.max(seen) > 0.0:
                limit = wp.float32(2.0)
                if horizon.shape[0] > 0:
                    face = start_face[point]
                    if face >= 0:
                        limit = horizon[8 * face + horizon_sector(surface_normals[point], candidate)]
                start = wp.where(wp.dot(surface_normals[point], candidate) <= limit, starts[point], far_along(candidate))
                wi = candidate
                w = balance_weight(split, light, wi, wo, n, alpha, place) * wp.dot(n, wi)
                f = w * specular_brdf(wi, wo, n, alpha, points.albedo[point], points.metallic[point])
    origin[i] = start
    direction[i] = wi
    cosine_weight[i] = w
    specular[i] = f
    radiance[i] = seen


@wp.func_native(ray_source("start_rays.h", 0, 1))
def start_sixteen_rays(
    base: int, ray_count: int, first: int,
    points: PointArrays, starts: wp.array(dtype=wp.vec3), surface_normals: wp.array(dtype=wp.vec3),
    start_face: wp.array(dtype=int), horizon: wp.array(dtype=float),
    light: EnvironmentLight, samples: SampleSet, keep_dark: int,
    origin: wp.array(dtype=wp.vec3), direction: wp.array(dtype=wp.vec3), cosine_weight: wp.array(dtype=float),
    specular: wp.array(dtype=wp.vec3), radiance: wp.array(dtype=wp.vec3),
): ...  # fmt: skip


@wp.kernel(enable_backward=False, module="unique")
def start_rays_simd(
    ray_count: int,
    first: int,
    points: PointArrays,
    starts: wp.array[wp.vec3],
    surface_normals: wp.array[wp.vec3],
    start_face: wp.array[int],
    horizon: wp.array[float],
    light: EnvironmentLight,
    samples: SampleSet,
    keep_dark: int,
    # outputs
    origin: wp.array[wp.vec3],
    direction: wp.array[wp.vec3],
    cosine_weight: wp.array[float],
    specular: wp.array[wp.vec3],
    radiance: wp.array[wp.vec3],
):
    """start_rays for sixteen rays a launch index, on the CPU."""
    start_sixteen_rays(
        16 * wp.tid(), ray_count, first, points, starts, surface_normals, start_face, horizon, light, samples, keep_dark,
        origin, direction, cosine_weight, specular, radiance,
    )  # fmt: skip


def shade(
    points: ShadingPoints,
    starts: RayStarts,
    light: Any,
    tracer: AbstractTracer,
    counts: SampleCounts,
    bounces: int,
    seed: int,
    samples_round: int | Tensor = 0,
    by_material: bool = False,
    memory: RayMemory | None = None,
    horizon: Tensor | None = None,
) -> PointLight:
    """Outgoing light of all points, one estimate of `counts.total` rays each.

    Args:
        light: EnvironmentLight struct (environment_table.environment_light).
        bounces: surfaces that light may meet between the environment and the points.
        by_material: each point shares its samples out by its material (sample_rays.split_at).
        samples_round: how many estimates of the same counts and seed came before; continues their sequences. (point,) int32 where it differs.
        memory: of an estimate of the same counts from the same starts: rays that are known are not traced, and it then knows these.
        horizon: (face, SECTORS) sines (horizon.Horizons); rays above them are not traced.
    """
    device = points.normal_world.device
    point_count = len(points.pixel)
    ray_count = point_count * counts.total
    result = PointLight(
        torch.zeros(point_count, 3, device=device),
        torch.zeros(point_count, 3, device=device),
        torch.zeros(point_count, 3, device=device),
        torch.zeros(point_count, device=device),
    )
    if ray_count == 0:
        return result
    known = usable_rays(memory, ray_count, bounces > 0)
    kept = room_for_rays(memory, ray_count, bounces > 0, device)
    warp_dev = warp_device(result.diffuse)
    rounds, samples_round = (samples_round, 0) if isinstance(samples_round, Tensor) else (None, samples_round)
    arrays, samples = point_arrays(points, rounds), sample_set(counts, seed, samples_round, by_material)
    start_arrays = [
        warp_array(starts.origin_world, wp.vec3),
        warp_array(starts.surface_normal_world, wp.vec3),
        *(warp_array(values) for values in _horizons_at(starts, horizon)),
    ]
    mesh = mesh_arrays(tracer.mesh, tracer.lift, horizon)
    sums = [
        warp_array(result.diffuse, wp.vec3),
        warp_array(result.specular, wp.vec3),
        warp_array(result.variance, wp.vec3),
        warp_array(result.visibility),
    ]
    at_once = isinstance(tracer, EmbreeTracer)
    for kernel in (
        start_rays_simd if device.type == "cpu" else start_rays,
        note_directions,
        sum_samples,
        scatter_kernel(device),
        query_any,
        *((shade_chunks,) if at_once else ()),
    ):
        load_kernel(kernel, warp_dev)

    def batch(first: int, last: int) -> None:
        if isinstance(tracer, EmbreeTracer):
            given = [arrays, *start_arrays, light]
            shade_slice(tracer, first, last, given, mesh, samples, counts.total, bounces, known, kept, sums)
            return
        rays = (last - first) * counts.total
        specular, radiance = (torch.empty(rays, 3, device=device) for _ in range(2))
        cosine_weight = torch.empty(rays, device=device)
        vectors = [warp_array(t, wp.vec3) for t in (specular, radiance)]
        inputs = [first * counts.total, arrays, *start_arrays, light, samples, int(bounces > 0)]
        origin, direction = (torch.empty(rays, 3, device=device) for _ in range(2))
        outputs = [warp_array(origin, wp.vec3), warp_array(direction, wp.vec3), warp_array(cosine_weight), *vectors]
        if device.type == "cpu":
            wp.launch(start_rays_simd, dim=-(-rays // 16), inputs=[rays, *inputs], outputs=outputs, device=warp_dev)
        else:
            wp.launch(start_rays, dim=rays, inputs=inputs, outputs=outputs, device=warp_dev)
        hits = trace_batch(origin, direction, first * counts.total, tracer, bounces > 0, known, kept)
        paths = paths_of_hits(hits, direction) if bounces > 0 else None
        indirect = radiance
        if paths is not None:
            indirect = trace_indirect(paths, rays, first, arrays, light, mesh, samples, tracer, bounces)
        wp.launch(
            sum_samples,
            dim=last - first,
            inputs=[
                first,
                arrays,
                samples,
                warp_array(cosine_weight),
                *vectors,
                warp_array(hits.hit),
                warp_array(indirect, wp.vec3),
                bounces,
            ],
            outputs=sums,
            device=warp_dev,
        )

    batch_rays = RAYS_A_SLICE if at_once else RAYS_A_BATCH if device.type == "cpu" else RAYS_A_BATCH_GPU
    batch_points = max(1, batch_rays // counts.total)
    shrinking = device.type == "cpu" and thread_count() > 1 and not in_thread_pool()
    over_slices(point_count, device, batch, batch_points, max(1, MIN_RAYS_A_BATCH // counts.total) if shrinking else None)
    if memory is not None:
        memory.rays = kept
    return result


def _horizons_at(starts: RayStarts, of_faces: Tensor | None) -> tuple[Tensor, Tensor]:
    """(point,) faces and (face * SECTORS,) their horizons; both empty where none is known."""
    if of_faces is None or starts.face is None:
        return starts.origin_world.new_empty(0, dtype=torch.int32), starts.origin_world.new_empty(0)
    return starts.face.int(), of_faces.reshape(-1)
