"""Outgoing light of the surfaces that rays meet: a path traced from each hit.

In: first hits of a batch of rays. Out: radiance that each hit sends back along its ray; 0 for rays without a hit.
A hit takes material and shading normal from the mesh's vertices. Its direct light is one sample of the environment table (where samples
choose, one of a block of candidates at the first hit: environment_pool.py) and one of the BRDF under the balance heuristic, each with its
own shadow ray; the BRDF ray carries the path on while bounces are left, ended by Russian roulette from the second hit onwards. Nothing is
clamped or cached.
The back of a triangle sends nothing. Twin of the kernel: drgs/reference/scatter_hits.py.
"""

from dataclasses import dataclass
from typing import Any

import torch
import warp as wp
from jaxtyping import Float, Int
from torch import Tensor

from drgs.maths.constants import F0, VOID_ORIGIN
from drgs.render.integrate.brdf_warp import PI, alpha_of, cosine_direction, ggx_direction, ggx_pdf, specular_brdf
from drgs.render.integrate.environment_pool import AT_SURFACES, block_of, candidate_direction, choose_candidate, pool_place
from drgs.render.integrate.environment_table import environment_direction, lookup_pdf, lookup_radiance, uv_from_world_direction
from drgs.render.integrate.integrator import Estimate
from drgs.render.integrate.path_arrays import PathArrays
from drgs.render.integrate.random_warp import hash_combine, shuffle_index, sobol_2d
from drgs.render.integrate.ray_scene import RayScene
from drgs.render.integrate.sample_arrays import PointArrays, SampleSet
from drgs.render.integrate.sample_rays import point_at, pool_round_at, round_at, split_at, strategy_of, strategy_seed
from drgs.render.integrate.surface_light import light_of_hit
from drgs.render.intersect.mesh_surface import Surface, face_limit, far_along, surface_at
from drgs.render.intersect.tracer import AbstractTracer
from drgs.render.records import Hits
from drgs.warp_torch import warp_array, warp_device

wp.set_module_options({"enable_backward": False})


@wp.struct
class ScatteredRays:
    """Rays from the surfaces of paths: towards the environment, then as many along the BRDF."""

    origin: wp.array[wp.vec3]
    direction: wp.array[wp.vec3]
    contribution: wp.array[wp.vec3]
    """What a ray that meets nothing adds to the radiance of the path's first ray."""
    throughput: wp.array[wp.vec3]
    """Of paths: that of the path if it goes on along its BRDF ray; 0 where it ends."""


@wp.func
def brdf_times_cosine(surface: Surface, wi: wp.vec3, wo: wp.vec3, alpha: float) -> wp.vec3:
    cosine = wp.dot(surface.normal, wi)
    diffuse = surface.albedo * ((1.0 - surface.metallic) / PI)
    return cosine * (diffuse + specular_brdf(wi, wo, surface.normal, alpha, surface.albedo, surface.metallic))


@wp.func
def specular_share(surface: Surface, n_dot_v: float) -> float:
    """Of the reflected energy, Fresnel at the viewing angle; the probability of the specular lobe."""
    c = 1.0 - n_dot_v
    fresnel = c * c * c * c * c
    f0 = wp.max(F0 * (1.0 - surface.metallic) + wp.max(surface.albedo) * surface.metallic, 1.0e-3)
    specular = f0 + (1.0 - f0) * fresnel
    diffuse = (1.0 - surface.metallic) * wp.max(surface.albedo)
    return wp.clamp(specular / (specular + diffuse), 0.1, 1.0)


@wp.func
def direction_to_light(
    scene: RayScene,
    candidates: float,
    pool_round: int,
    seed: wp.uint32,
    index: wp.uint32,
    u: wp.vec2,
    share: float,
    surface: Surface,
    wo: wp.vec3,
    alpha: float,
) -> wp.vec4:
    """Where a ray towards the environment goes, drawn from the table or chosen among candidates, and a factor of its weight; zeros: nowhere."""
    if candidates == 1.0:
        wi = environment_direction(scene.light, u)
        return wp.vec4(wi[0], wi[1], wi[2], 1.0)
    block = pool_place(pool_round - scene.pools.first_round, AT_SURFACES, block_of(seed, index))
    shares = wp.vec3(1.0 - share, share, candidates)
    n = surface.normal
    choice = choose_candidate(scene.pools, block, shares, 0.0, u[0], wo, n, surface.face_normal, alpha, surface.albedo, surface.metallic)
    if choice[0] < 0.0:
        return wp.vec4(0.0, 0.0, 0.0, 0.0)
    chosen = candidate_direction(scene.pools, block, int(choice[0]))
    return wp.vec4(chosen[0], chosen[1], chosen[2], choice[1])


@wp.kernel
def scatter_hits(
    paths: PathArrays,
    path_count: int,
    first_point: int,
    depth: int,
    points: PointArrays,
    scene: RayScene,
    samples: SampleSet,
    # outputs
    scattered: ScatteredRays,
):
    i = wp.tid()
    j = i + path_count
    zero = wp.vec3(0.0, 0.0, 0.0)
    outside = wp.vec3(VOID_ORIGIN, VOID_ORIGIN, VOID_ORIGIN)
    away = wp.vec3(0.57735027, 0.57735027, 0.57735027)
    scattered.origin[i] = outside
    scattered.origin[j] = outside
    scattered.direction[i] = away
    scattered.direction[j] = away
    scattered.contribution[i] = zero
    scattered.contribution[j] = zero
    scattered.throughput[i] = zero
    surface = surface_at(scene.mesh, paths.face[i], paths.barycentric[i])
    wo = -paths.arriving[i]
    n = surface.normal
    n_dot_v = wp.dot(n, wo)
    if n_dot_v <= 0.0 or wp.dot(surface.face_normal, wo) <= 0.0:
        return
    count = samples.cosine + samples.ggx + samples.environment
    ray = int(paths.ray[i])
    point = point_at(points, first_point + ray // count)
    pool_round = pool_round_at(samples, points, point)
    strategy = strategy_of(split_at(samples, points, point), round_at(samples, points, point), ray % count)
    base = strategy_seed(samples, points.pixel[point], strategy[0])
    index = wp.uint32(strategy[1])
    seed_light = hash_combine(base, wp.uint32(16 + 4 * depth))
    seed_brdf = hash_combine(base, wp.uint32(17 + 4 * depth))
    seed_choice = hash_combine(base, wp.uint32(18 + 4 * depth))
    u_light = sobol_2d(shuffle_index(index, seed_light), seed_light)
    u_brdf = sobol_2d(shuffle_index(index, seed_brdf), seed_brdf)
    u_choice = sobol_2d(shuffle_index(index, seed_choice), seed_choice)
    alpha = alpha_of(surface.roughness)
    start = surface.position + scene.mesh.lift * surface.face_normal
    share = specular_share(surface, n_dot_v)
    carried = paths.throughput[i]
    candidates = wp.where(depth == 0, float(samples.candidates), 1.0)
    to_light = direction_to_light(scene, candidates, pool_round, seed_light, index, u_light, share, surface, wo, alpha)
    wi = wp.vec3(to_light[0], to_light[1], to_light[2])
    n_dot_l = wp.dot(n, wi)
    if n_dot_l > 0.0 and wp.dot(surface.face_normal, wi) > 0.0:
        uv = uv_from_world_direction(scene.light, wi)
        density = candidates * lookup_pdf(scene.light, uv) + share * ggx_pdf(wi, wo, n, alpha) + (1.0 - share) * n_dot_l / PI
        if density > 0.0:
            limit = face_limit(scene.mesh, paths.face[i], surface.face_normal, wi)
            scattered.origin[i] = wp.where(wp.dot(surface.face_normal, wi) <= limit, start, far_along(wi))
            scattered.direction[i] = wi
            reflected = wp.cw_mul(carried, wp.cw_mul(brdf_times_cosine(surface, wi, wo, alpha), lookup_radiance(scene.light, uv)))
            scattered.contribution[i] = reflected * to_light[3] / density

    if u_choice[0] < share:  # noqa: SIM108 (a Warp expression would evaluate both)
        wi = ggx_direction(u_brdf, wo, n, alpha)
    else:
        wi = cosine_direction(u_brdf, n)
    n_dot_l = wp.dot(n, wi)
    if n_dot_l > 0.0 and wp.dot(surface.face_normal, wi) > 0.0:
        uv = uv_from_world_direction(scene.light, wi)
        own = share * ggx_pdf(wi, wo, n, alpha) + (1.0 - share) * n_dot_l / PI
        if own > 0.0:
            reflected = wp.cw_mul(carried, brdf_times_cosine(surface, wi, wo, alpha))
            limit = face_limit(scene.mesh, paths.face[i], surface.face_normal, wi)
            scattered.origin[j] = wp.where(wp.dot(surface.face_normal, wi) <= limit, start, far_along(wi))
            scattered.direction[j] = wi
            density = own + candidates * lookup_pdf(scene.light, uv)
            scattered.contribution[j] = wp.cw_mul(reflected, lookup_radiance(scene.light, uv)) / density
            survival = wp.float32(1.0)
            if depth > 0:
                survival = wp.clamp(wp.max(reflected) / own, 0.05, 1.0)
            if u_choice[1] < survival:
                scattered.throughput[i] = reflected / (own * survival)


@wp.kernel
def read_known_light(
    paths: PathArrays,
    scene: RayScene,
    # outputs
    indirect: wp.array[wp.vec3],
    is_known: wp.array[wp.bool],
):
    i = wp.tid()
    light = light_of_hit(scene.known, scene.mesh.faces, paths.face[i], paths.barycentric[i], paths.arriving[i])
    is_known[i] = light[3] > 0.0
    if light[3] > 0.0:
        indirect[int(paths.ray[i])] = wp.vec3(light[0], light[1], light[2])


@wp.kernel
def add_contributions(
    path_ray: wp.array[wp.int64],
    path_count: int,
    contribution: wp.array[wp.vec3],
    blocked: wp.array[wp.bool],
    # outputs
    indirect: wp.array[wp.vec3],
):
    i = wp.tid()
    j = i + path_count
    total = wp.vec3(0.0, 0.0, 0.0)
    if not blocked[i]:
        total += contribution[i]
    if not blocked[j]:
        total += contribution[j]
    ray = int(path_ray[i])
    indirect[ray] = indirect[ray] + total


@dataclass(frozen=True, eq=False)
class Paths:
    """Rays that met a surface, packed in their order: PathArrays as tensors."""

    ray: Int[Tensor, "path"]
    """int64; number of the first ray in the batch."""
    face: Int[Tensor, "path"]
    barycentric: Float[Tensor, "path 2"]
    arriving: Float[Tensor, "path 3"]
    """Unit direction in which the path arrives at the face."""
    throughput: Float[Tensor, "path 3"]


def paths_of_hits(hits: Hits, direction: Tensor) -> Paths:
    """The rays (ray, 3) that met something."""
    ray = torch.nonzero(hits.hit).squeeze(-1)
    return Paths(ray, hits.face[ray], hits.barycentric[ray], direction[ray], torch.ones_like(direction[ray]))


def _arrays_of(paths: Paths) -> Any:
    arrays = PathArrays()
    arrays.ray, arrays.face, arrays.barycentric = warp_array(paths.ray), warp_array(paths.face), warp_array(paths.barycentric, wp.vec2)
    arrays.arriving, arrays.throughput = warp_array(paths.arriving, wp.vec3), warp_array(paths.throughput, wp.vec3)
    return arrays


def trace_indirect(estimate: Estimate, paths: Paths, ray_count: int, first_point: int, tracer: AbstractTracer) -> tuple[Tensor, int]:
    """(ray, 3) radiance that the first hits of a batch send back along its rays, and rays traced for it. Runs on the calling thread.

    Args:
        estimate: with at least 1 bounce.
        ray_count: of the batch; rays are grouped by point, from `first_point` on.
    """
    device, warp_dev, traced = paths.arriving.device, warp_device(paths.arriving), 0
    indirect = torch.zeros(ray_count, 3, device=device)
    if estimate.scene.known.vertex.shape[0] > 0 and len(paths.ray) > 0:
        is_known = torch.empty(len(paths.ray), dtype=torch.bool, device=device)
        outputs = [warp_array(indirect, wp.vec3), warp_array(is_known)]
        wp.launch(read_known_light, dim=len(paths.ray), inputs=[_arrays_of(paths), estimate.scene], outputs=outputs, device=warp_dev)
        paths = Paths(*(values[~is_known] for values in vars(paths).values()))
    for depth in range(estimate.bounces):
        count = len(paths.ray)
        if count == 0:
            break
        origin, direction, contribution = (torch.empty(2 * count, 3, device=device) for _ in range(3))
        throughput = torch.empty(count, 3, device=device)
        scattered = ScatteredRays()
        scattered.origin, scattered.direction = warp_array(origin, wp.vec3), warp_array(direction, wp.vec3)
        scattered.contribution, scattered.throughput = warp_array(contribution, wp.vec3), warp_array(throughput, wp.vec3)
        wp.launch(
            scatter_hits,
            dim=count,
            inputs=[_arrays_of(paths), count, first_point, depth, estimate.points, estimate.scene, estimate.samples],
            outputs=[scattered],
            device=warp_dev,
        )
        is_last = depth + 1 == estimate.bounces
        if is_last:
            blocked = tracer.occluded(origin, direction)
        else:
            onward = tracer.closest_hits(origin[count:], direction[count:])
            blocked = torch.cat([tracer.occluded(origin[:count], direction[:count]), onward.hit])
        traced += 2 * count
        wp.launch(
            add_contributions,
            dim=count,
            inputs=[warp_array(paths.ray), count, scattered.contribution, warp_array(blocked)],
            outputs=[warp_array(indirect, wp.vec3)],
            device=warp_dev,
        )
        if not is_last:
            alive = torch.nonzero(onward.hit & (throughput.amax(-1) > 0)).squeeze(-1)
            paths = Paths(paths.ray[alive], onward.face[alive], onward.barycentric[alive], direction[count:][alive], throughput[alive])
    return indirect, traced
