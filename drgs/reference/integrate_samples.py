"""Slow torch twin of drgs/render/integrate/integrate_samples.py, at the precision of its inputs; the specification of the kernel."""

import torch
from torch import Tensor

from drgs.maths.brdf import evaluate_brdf
from drgs.render.records import Rays, ShadingPoints
from drgs.scene.environment import Environment, environment_radiance


def integrate_samples(
    points: ShadingPoints, rays: Rays, transmittance: Tensor, hit_radiance: Tensor, environment_radiance_table: Tensor
) -> Tensor:
    """As drgs.render.integrate.integrate_samples.integrate_samples; torch differentiates it."""
    wi = rays.direction_world
    wo, normal, albedo = (x[:, None].expand(*wi.shape[:2], 3) for x in (points.wo_world, points.normal_world, points.albedo))
    roughness, metallic = (x[:, None].expand(wi.shape[:2]) for x in (points.roughness, points.metallic))
    diffuse, specular = evaluate_brdf(wi, wo, normal, albedo, roughness, metallic)
    incoming = environment_radiance(Environment(environment_radiance_table), wi) * transmittance[..., None] + hit_radiance
    n_dot_l = (normal * wi).sum(-1).clamp(min=0)
    return torch.sum((diffuse + specular) * incoming * (n_dot_l * rays.weight)[..., None], 1)
