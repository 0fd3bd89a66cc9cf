"""Slow torch twin of the integrators (drgs/render/integrate/integrator.py), at the precision of its inputs; their specification.

The same random numbers, so that points can be compared one by one; whether rays meet something is the tracer's word.
"""

import torch
from torch import Tensor

from drgs.maths.brdf import evaluate_brdf
from drgs.reference.environment_pool import AT_SURFACES, choose_directions, draw_pool
from drgs.reference.mesh_surface import mesh_in, surfaces_at
from drgs.reference.sample_rays import sample_rays, split_at, strategy_of, strategy_seed
from drgs.reference.scatter_hits import PathSamples, scatter_hits
from drgs.render.integrate.environment_table import EnvironmentTable
from drgs.render.integrate.integrator import IntegratorSettings
from drgs.render.intersect.trace_rays import trace_rays
from drgs.render.intersect.tracer import AbstractTracer
from drgs.render.records import Hits, RayStarts, ShadingPoints
from drgs.scene.environment import Environment, environment_radiance


def shade(
    points: ShadingPoints,
    starts: RayStarts,
    environment: Environment,
    table: EnvironmentTable,
    tracer: AbstractTracer,
    settings: IntegratorSettings,
    samples_round: int = 0,
) -> tuple[Tensor, Tensor]:
    """Diffuse and specular light (point, 3), environment unturned."""
    rays = sample_rays(points, table, settings.counts, settings.seed, samples_round=samples_round, by_material=settings.by_material)
    if settings.candidates > 1:
        rays = choose_directions(rays, points, starts, environment, table, settings, samples_round)
    wi = rays.direction_world
    hits = trace_rays(starts.origin_world[:, None].expand_as(wi).reshape(-1, 3), wi.reshape(-1, 3), tracer)
    incoming = environment_radiance(environment, wi).reshape(-1, 3)
    indirect = trace_indirect(points, wi, hits, environment, table, tracer, settings, samples_round)
    incoming = torch.where(hits.hit[:, None], indirect, incoming).view_as(wi)

    wo, normal, albedo = (t[:, None].expand_as(wi) for t in (points.wo_world, points.normal_world, points.albedo))
    roughness, metallic = (t[:, None].expand(wi.shape[:2]) for t in (points.roughness, points.metallic))
    diffuse, specular = evaluate_brdf(wi, wo, normal, albedo, roughness, metallic)
    n_dot_l = (normal * wi).sum(-1).clamp(min=0)
    is_above = (wi * starts.surface_normal_world[:, None]).sum(-1) > 0
    light = incoming * (rays.weight * n_dot_l * is_above)[..., None]
    return torch.sum(diffuse * light, 1), torch.sum(specular * light, 1)


def trace_indirect(
    points: ShadingPoints,
    wi: Tensor,
    hits: Hits,
    environment: Environment,
    table: EnvironmentTable,
    tracer: AbstractTracer,
    settings: IntegratorSettings,
    samples_round: int,
) -> Tensor:
    """(ray, 3) radiance that the hits of rays in directions wi (point, sample, 3) send back along them; 0 for rays without one."""
    mesh = mesh_in(wi.dtype, tracer.mesh)
    slot = torch.arange(wi.shape[1]).expand(wi.shape[:2])
    strategy, index = strategy_of(
        split_at(points, settings.counts, settings.by_material)[:, None].expand(*wi.shape[:2], 3), samples_round, slot
    )
    seed = strategy_seed(points.pixel[:, None], strategy, settings.seed)

    pool = draw_pool(environment, table, settings.seed, samples_round, AT_SURFACES) if settings.candidates > 1 else None

    radiance = torch.zeros(hits.hit.shape[0], 3, dtype=wi.dtype)
    ray = torch.nonzero(hits.hit).squeeze(-1)
    face, barycentric, arriving, throughput = (
        hits.face[ray],
        hits.barycentric[ray],
        wi.reshape(-1, 3)[ray],
        torch.ones(len(ray), 3, dtype=wi.dtype),
    )
    for depth in range(settings.bounces):
        x = surfaces_at(mesh, face, barycentric.to(wi.dtype))
        numbers = PathSamples(seed.reshape(-1)[ray], index.reshape(-1)[ray])
        towards_light, onward = scatter_hits(x, -arriving, throughput, numbers, depth, environment, table, pool)
        origin = x.position + tracer.lift * x.face_normal
        blocked, further = trace_rays(origin, towards_light.direction, tracer).hit, trace_rays(origin, onward.direction, tracer)
        radiance.index_add_(0, ray, torch.where(blocked[:, None], 0.0, towards_light.contribution))
        radiance.index_add_(0, ray, torch.where(further.hit[:, None], 0.0, onward.contribution))
        alive = torch.nonzero(further.hit & (onward.throughput.amax(-1) > 0)).squeeze(-1)
        ray, face, barycentric = ray[alive], further.face[alive], further.barycentric[alive]
        arriving, throughput = onward.direction[alive], onward.throughput[alive]
    return radiance
