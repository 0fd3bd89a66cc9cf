"""The integrator of any device and any tracer: sample, trace, follow and sum, each for a whole batch of rays before the next.

For CUDA; and on the CPU the specification of fused_embree.py, ray by ray in plain kernels. drgs/reference/shade.py and
drgs/reference/scatter_hits.py say the same in float64.
"""

from typing import Any

import torch
import warp as wp

from drgs.maths.constants import VOID_ORIGIN
from drgs.render.integrate.brdf_warp import alpha_of, specular_brdf
from drgs.render.integrate.environment_pool import AT_POINTS, block_of, candidate_direction, choose_candidate, pool_place
from drgs.render.integrate.environment_table import lookup_radiance, uv_from_world_direction
from drgs.render.integrate.integrator import AbstractIntegrator, Estimate
from drgs.render.integrate.random_warp import sobol_2d
from drgs.render.integrate.ray_scene import RayScene
from drgs.render.integrate.sample_arrays import PointArrays, SampleSet, StartArrays
from drgs.render.integrate.sample_rays import (
    balance_weight,
    point_at,
    pool_round_at,
    round_at,
    sampled_direction,
    split_at,
    strategy_of,
    strategy_seed,
)
from drgs.render.integrate.sum_samples import RaySamples, ray_samples, sum_samples
from drgs.render.integrate.trace_indirect import add_contributions, paths_of_hits, read_known_light, scatter_hits, trace_indirect
from drgs.render.intersect.mesh_surface import face_limit, far_along
from drgs.render.intersect.ray_memory import note_directions, rays_of_points, trace_batch
from drgs.warp_torch import load_kernel, warp_array, warp_device

wp.set_module_options({"enable_backward": False})

RAYS_A_BATCH = 65536
"""Rays of one CPU batch: its 4 MB of ray data stay in the cache between sampling, tracing and shading."""
RAYS_A_BATCH_GPU = 1 << 23


@wp.kernel
def start_rays(
    first: int,
    bounces: int,
    points: PointArrays,
    starts: StartArrays,
    scene: RayScene,
    samples: SampleSet,
    # outputs
    origin: wp.array[wp.vec3],
    direction: wp.array[wp.vec3],
    rays: RaySamples,
):
    i = wp.tid()
    count = samples.cosine + samples.ggx + samples.environment
    point = point_at(points, (first + i) // count)
    n = points.normal[point]
    wo = points.wo[point]
    roughness = points.roughness[point]
    alpha = alpha_of(roughness)
    start = wp.vec3(VOID_ORIGIN, VOID_ORIGIN, VOID_ORIGIN)  # void rays leave from far outside and miss at the root of the tree
    wi = wp.vec3(0.57735027, 0.57735027, 0.57735027)
    w = wp.float32(0.0)
    f = wp.vec3(0.0, 0.0, 0.0)
    seen = wp.vec3(0.0, 0.0, 0.0)
    if wp.dot(n, wo) > 0.0:
        split = split_at(samples, points, point)
        round_ = round_at(samples, points, point)
        slot = (first + i) % count
        surface_normal = starts.surface_normal[point]
        chosen = wp.float32(1.0)
        candidate = wp.vec3(0.0, 0.0, 0.0)
        strategy = strategy_of(split, round_, slot)
        if samples.candidates > 1 and strategy[0] == 2:
            stream = strategy_seed(samples, points.pixel[point], 2)
            pool_round = pool_round_at(samples, points, point)
            at = pool_place(pool_round - scene.pools.first_round, AT_POINTS, block_of(stream, wp.uint32(strategy[1])))
            shares = wp.vec3(float(split[0]), float(split[1]), float(split[2] * samples.candidates))
            floor = 1.0  # without bounces too: the same rays with and without them say what they add
            u = sobol_2d(wp.uint32(strategy[1]), stream)
            choice = choose_candidate(
                scene.pools, at, shares, floor, u[0], wo, n, surface_normal, alpha, points.albedo[point], points.metallic[point]
            )
            chosen = choice[1]
            if chosen > 0.0:
                candidate = candidate_direction(scene.pools, at, int(choice[0]))
        else:
            candidate = sampled_direction(samples, split, scene.light, points.pixel[point], round_, slot, wo, n, alpha)
        if wp.dot(n, candidate) > 0.0 and wp.dot(surface_normal, candidate) > 0.0:
            uv = uv_from_world_direction(scene.light, candidate)
            seen = lookup_radiance(scene.light, uv)
            if bounces > 0 or wp.max(seen) > 0.0:
                limit = wp.float32(2.0)
                if starts.face.shape[0] > 0:
                    limit = face_limit(scene.mesh, starts.face[point], surface_normal, candidate)
                start = wp.where(wp.dot(surface_normal, candidate) <= limit, starts.origin[point], far_along(candidate))
                wi = candidate
                w = balance_weight(samples, split, scene.light, wi, wo, n, alpha, uv) * wp.dot(n, wi) * chosen
                f = w * specular_brdf(wi, wo, n, alpha, points.albedo[point], points.metallic[point])
    origin[i] = start
    direction[i] = wi
    rays.cosine_weight[i] = w
    rays.specular[i] = f
    rays.radiance[i] = seen


class WavefrontIntegrator(AbstractIntegrator):
    """Final."""

    def load_kernels(self) -> None:
        for kernel in (start_rays, note_directions, read_known_light, scatter_hits, add_contributions, sum_samples):
            load_kernel(kernel, self._device())

    def rays_a_slice(self) -> int:
        return RAYS_A_BATCH_GPU if self._device().is_cuda else RAYS_A_BATCH

    def shade_slice(self, estimate: Estimate, first: int, last: int) -> int:
        device, first_ray, count = self.tracer.mesh.vertices.device, first * estimate.rays_a_point, (last - first) * estimate.rays_a_point
        origin, direction, rays = torch.empty(count, 3, device=device), torch.empty(count, 3, device=device), ray_samples(count, device)
        wp.launch(
            start_rays,
            dim=count,
            inputs=[first_ray, estimate.bounces, estimate.points, estimate.starts, estimate.scene, estimate.samples],
            outputs=[warp_array(origin, wp.vec3), warp_array(direction, wp.vec3), rays],
            device=self._device(),
        )
        known, first_known = estimate.known, first_ray
        if known is not None and estimate.order is not None:
            known, first_known = rays_of_points(known, estimate.order[first:last], estimate.rays_a_point), 0
        hits, traced = trace_batch(origin, direction, first_known, self.tracer, estimate.bounces > 0, known, estimate.kept)
        rays.blocked = warp_array(hits.hit)
        if estimate.bounces > 0:
            indirect, further = trace_indirect(estimate, paths_of_hits(hits, direction), count, first, self.tracer)
            rays.indirect = warp_array(indirect, wp.vec3)
            traced += further
        wp.launch(
            sum_samples,
            dim=last - first,
            inputs=[first, estimate.points, estimate.samples, rays, estimate.bounces],
            outputs=[estimate.sums],
            device=self._device(),
        )
        return traced

    def _device(self) -> Any:
        return warp_device(self.tracer.mesh.vertices)
