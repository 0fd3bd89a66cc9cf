"""Slow torch twin of the kernel scatter_hits in drgs/render/integrate/trace_indirect.py, at the precision of its inputs; its specification.

The same random numbers as the kernel, so that paths can be compared one by one. What the estimate must be in the mean says
path_integrator.py, which knows nothing of these numbers.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from drgs.maths.brdf import evaluate_brdf
from drgs.maths.constants import F0, MIN_ROUGHNESS
from drgs.maths.sampling import (
    cosine_pdf,
    ggx_vndf_pdf,
    hash_combine,
    sample_cosine,
    sample_ggx_vndf,
    shuffle_index,
    sobol_2d,
    world_from_local,
)
from drgs.reference.environment_pool import CANDIDATES, Candidates, blocks_of, choose_candidates
from drgs.reference.mesh_surface import Surfaces
from drgs.render.integrate.environment_table import EnvironmentTable, environment_pdf, sample_environment
from drgs.scene.environment import Environment, environment_radiance

LIGHT_STREAM, BRDF_STREAM, CHOICE_STREAM, STREAMS_A_DEPTH = 16, 17, 18, 4
"""Which numbers of a sample's sequence go where."""


@dataclass(frozen=True, eq=False)
class PathSamples:
    """The first rays of paths: where their random numbers come from."""

    seed: Int[Tensor, "path"]
    """int64; of the first ray's strategy in its pixel (sample_rays.strategy_seed)."""
    index: Int[Tensor, "path"]
    """int64; of the first ray in that strategy's sequence."""


@dataclass(frozen=True, eq=False)
class ScatteredRay:
    """One ray from each surface; void where its contribution is 0."""

    direction: Float[Tensor, "path 3"]
    contribution: Float[Tensor, "path 3"]
    """What it adds to the radiance of the path's first ray if it meets nothing."""
    throughput: Float[Tensor, "path 3"]
    """Of the path that goes on along it; 0 where it ends."""


def scatter_hits(
    x: Surfaces,
    wo: Tensor,
    throughput: Tensor,
    numbers: PathSamples,
    depth: int,
    environment: Environment,
    table: EnvironmentTable,
    pool: Candidates | None = None,
) -> tuple[ScatteredRay, ScatteredRay]:
    """A ray towards the environment and one along the BRDF, of surfaces that a path reaches after `depth` others.

    Args:
        wo: (path, 3) from the surface back along the path. throughput: (path, 3) of the path up to here.
        environment, table: unturned.
        pool: what rays towards the environment choose from at the first hit.
    """
    u_light, u_brdf, u_choice = (_numbers(numbers, stream, depth, wo.dtype) for stream in (LIGHT_STREAM, BRDF_STREAM, CHOICE_STREAM))
    share = specular_share(x, wo)
    is_front = ((x.normal * wo).sum(-1) > 0) & ((x.face_normal * wo).sum(-1) > 0)

    def reflect(wi: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Throughput times f(wi, wo) times n·wi, 0 where no light can pass; and the densities of the BRDF's and the environment's samples."""
        n_dot_l = (x.normal * wi).sum(-1)
        passes = is_front & (n_dot_l > 0) & ((x.face_normal * wi).sum(-1) > 0)
        diffuse, specular = evaluate_brdf(wi, wo, x.normal, x.albedo, x.roughness, x.metallic)
        own = share * ggx_vndf_pdf(wi, wo, x.normal, _alpha(x)) + (1 - share) * cosine_pdf(n_dot_l)
        reflected = throughput * (diffuse + specular) * torch.where(passes, n_dot_l, 0.0)[:, None]
        return reflected, own, environment_pdf(table, wi)

    def light(wi: Tensor, reflected: Tensor, density: Tensor) -> Tensor:
        incoming = environment_radiance(environment, wi)
        return torch.where((density > 0)[:, None], reflected * incoming / density.clamp(min=1e-37)[:, None], 0.0)

    # Direct light: one sample of each, under the balance heuristic.
    candidates, factor = 1, torch.ones_like(share)
    if pool is None or depth > 0:
        to_light = sample_environment(table, u_light)
    else:
        seed = hash_combine(numbers.seed, torch.full_like(numbers.seed, LIGHT_STREAM))
        blocks, candidates = blocks_of(pool, seed, numbers.index), CANDIDATES
        scattered = ((wi, *reflect(wi)) for wi in blocks.direction.unbind(1))
        brought = [light(wi, reflected, own + candidates * of_table) for wi, reflected, own, of_table in scattered]
        chosen, factor = choose_candidates(torch.stack([b.sum(-1) for b in brought], -1), u_light[:, 0])
        to_light = blocks.direction[torch.arange(len(chosen)), chosen]
    reflected, own, of_table = reflect(to_light)
    contribution = factor[:, None] * light(to_light, reflected, own + candidates * of_table)
    light_ray = ScatteredRay(to_light, contribution, torch.zeros_like(wo))

    onward = _sample_brdf(x, wo, u_brdf, u_choice[:, 0] < share)
    reflected, own, of_table = reflect(onward)
    contribution = light(onward, reflected, own + candidates * of_table)

    # Light from further surfaces: by the BRDF's sample alone. Russian roulette from the second hit on.
    survival = torch.ones_like(share) if depth == 0 else (reflected.amax(-1) / own.clamp(min=1e-37)).clamp(0.05, 1)
    goes_on = (u_choice[:, 1] < survival) & (own > 0)
    carried = torch.where(goes_on[:, None], reflected / (own * survival).clamp(min=1e-37)[:, None], 0.0)
    return light_ray, ScatteredRay(onward, contribution, carried)


def specular_share(x: Surfaces, wo: Tensor) -> Tensor:
    """(path,) probability of the specular lobe: its share of the reflected energy, Fresnel at the viewing angle."""
    base = x.albedo.amax(-1)
    f0 = (F0 * (1 - x.metallic) + base * x.metallic).clamp(min=1e-3)
    specular = f0 + (1 - f0) * (1 - (x.normal * wo).sum(-1)) ** 5
    return (specular / (specular + (1 - x.metallic) * base)).clamp(0.1, 1)


def _alpha(x: Surfaces) -> Tensor:
    return x.roughness.clamp(min=MIN_ROUGHNESS) ** 2


def _numbers(samples: PathSamples, stream: int, depth: int, dtype: torch.dtype) -> Tensor:
    """(path, 2) numbers in [0, 1)."""
    seed = hash_combine(samples.seed, torch.full_like(samples.seed, stream + STREAMS_A_DEPTH * depth))
    return sobol_2d(shuffle_index(samples.index, seed), seed, dtype)


def _sample_brdf(x: Surfaces, wo: Tensor, u: Tensor, is_specular: Tensor) -> Tensor:
    frame = torch.stack([world_from_local(axis.expand_as(wo), x.normal) for axis in torch.eye(3, dtype=wo.dtype)], -1)
    ggx = sample_ggx_vndf(u, torch.einsum("pij,pi->pj", frame, wo), _alpha(x))
    return world_from_local(torch.where(is_specular[:, None], ggx, sample_cosine(u)), x.normal)
