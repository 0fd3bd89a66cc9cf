"""The project's one BRDF: f = (1 - m) a / pi + D V F.

GGX with alpha = r^2 (r clamped at MIN_ROUGHNESS), height-correlated Smith V = G / (4 n.l n.v), Schlick F with
F0 (1 - m) + a m.  Source: Walter et al. 2007, Heitz 2014, Burley 2012 (docs/sources.md). Warp kernels
restate these lines once, in drgs/render/integrate/brdf_warp.py, and are tested against this file.
"""

import math

import torch
from torch import Tensor

from drgs.maths.constants import F0, MIN_ROUGHNESS


def f0_from_base(albedo: Tensor, metallic: Tensor) -> Tensor:
    """(..., 3) reflectance at normal incidence of albedo (..., 3), metallic (...)."""
    m = metallic[..., None]
    return F0 * (1 - m) + albedo * m


def ggx_d(n_dot_h: Tensor, alpha: Tensor, sin2_nh: Tensor | None = None) -> Tensor:
    """GGX distribution; sin^2 is kept apart from alpha^2 so that the peak survives float32.

    Args:
        sin2_nh: |n x h|^2. Default 1 - (n.h)^2, which in float32 is off by 6e-8: 7 % of the peak at the smallest alpha.
    """
    a2 = alpha * alpha
    c2 = n_dot_h * n_dot_h
    denominator = ((1 - c2) if sin2_nh is None else sin2_nh) + c2 * a2
    return a2 / (math.pi * denominator * denominator).clamp(min=1e-30)


def smith_v(n_dot_l: Tensor, n_dot_v: Tensor, alpha: Tensor) -> Tensor:
    """Height-correlated Smith visibility G2 / (4 n.l n.v)."""
    a2 = alpha * alpha
    lambda_v = n_dot_l * torch.sqrt(n_dot_v * n_dot_v * (1 - a2) + a2)
    lambda_l = n_dot_v * torch.sqrt(n_dot_l * n_dot_l * (1 - a2) + a2)
    return 0.5 / (lambda_v + lambda_l).clamp(min=1e-12)


def schlick_f(h_dot_v: Tensor, f0: Tensor) -> Tensor:
    """(..., 3) Fresnel reflectance."""
    return f0 + (1 - f0) * ((1 - h_dot_v).clamp(0, 1) ** 5)[..., None]


def evaluate_brdf(wi: Tensor, wo: Tensor, normal: Tensor, albedo: Tensor, roughness: Tensor, metallic: Tensor) -> tuple[Tensor, Tensor]:
    """Diffuse and specular parts (..., 3) of f(wi, wo), without the cosine; zero below the horizon.

    wi, wo, normal: unit (..., 3), both directions pointing away from the surface.
    """
    alpha = roughness.clamp(min=MIN_ROUGHNESS) ** 2
    h = torch.nn.functional.normalize(wi + wo, dim=-1)
    n_dot_l, n_dot_v = (normal * wi).sum(-1), (normal * wo).sum(-1)
    above = (n_dot_l > 0) & (n_dot_v > 0)
    n_dot_h, h_dot_v = (normal * h).sum(-1).clamp(0, 1), (h * wo).sum(-1).clamp(0, 1)
    sin2_nh = torch.linalg.cross(normal, h).square().sum(-1)
    dv = ggx_d(n_dot_h, alpha, sin2_nh) * smith_v(n_dot_l.clamp(min=1e-6), n_dot_v.clamp(min=1e-6), alpha)
    specular = dv[..., None] * schlick_f(h_dot_v, f0_from_base(albedo, metallic))
    diffuse = ((1 - metallic)[..., None] * albedo / math.pi).expand_as(specular)
    zero = torch.zeros((), dtype=specular.dtype, device=specular.device)
    return torch.where(above[..., None], diffuse, zero), torch.where(above[..., None], specular, zero)
