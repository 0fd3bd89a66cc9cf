"""Slow torch twin of drgs/render/shade.py for direct light, at the precision of its inputs; the specification of the kernels."""

import torch
from torch import Tensor

from drgs.maths.brdf import evaluate_brdf
from drgs.reference.sample_rays import sample_rays
from drgs.render.environment_table import EnvironmentTable
from drgs.render.records import ShadingPoints
from drgs.render.sample_rays import SampleCounts
from drgs.render.shade import RayStarts
from drgs.render.tracer import AbstractTracer
from drgs.scene.environment import Environment, environment_radiance


def shade(
    points: ShadingPoints,
    starts: RayStarts,
    environment: Environment,
    table: EnvironmentTable,
    tracer: AbstractTracer,
    counts: SampleCounts,
    seed: int,
    samples_round: int = 0,
) -> tuple[Tensor, Tensor]:
    """Diffuse and specular direct light (point, 3), environment unturned."""
    rays = sample_rays(points, table, counts, seed, samples_round=samples_round)
    wi = rays.direction_world
    origin = starts.origin_world[:, None].expand_as(wi).reshape(-1, 3).float().contiguous()
    blocked = tracer.occluded(origin, wi.reshape(-1, 3).float().contiguous()).reshape(wi.shape[:2])
    blocked = blocked | ((wi * starts.surface_normal_world[:, None]).sum(-1) <= 0)
    many = [t[:, None].expand(*wi.shape[:2], *t.shape[1:]) for t in (points.wo_world, points.normal_world, points.albedo)]
    diffuse, specular = evaluate_brdf(
        wi, *many, points.roughness[:, None].expand(wi.shape[:2]), points.metallic[:, None].expand(wi.shape[:2])
    )
    n_dot_l = (many[1] * wi).sum(-1).clamp(min=0)
    light = environment_radiance(environment, wi) * (rays.weight * n_dot_l * ~blocked)[..., None]
    return torch.sum(diffuse * light, 1), torch.sum(specular * light, 1)
