"""Slow torch twin of drgs/render/integrate/environment_pool.py, at the precision of its inputs; the specification of the kernels."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from drgs.maths.brdf import evaluate_brdf
from drgs.maths.sampling import hash_combine, sobol_2d
from drgs.reference.sample_rays import balance_weights, split_at, strategy_of, strategy_seed
from drgs.render.integrate.environment_table import EnvironmentTable, environment_pdf, sample_environment
from drgs.render.integrate.integrator import IntegratorSettings
from drgs.render.records import Rays, RayStarts, ShadingPoints
from drgs.scene.environment import Environment, environment_radiance

CANDIDATES, BLOCKS = 16, 128
AT_POINTS, AT_SURFACES = 0, 1
POOL_STREAM, BLOCK_STREAM = 8, 8
FLOOR = 0.3


@dataclass(frozen=True, eq=False)
class Candidates:
    """A pool, or the blocks of it that samples choose from."""

    direction: Float[Tensor, "*block candidate 3"]
    radiance: Float[Tensor, "*block candidate 3"]
    density: Float[Tensor, "*block candidate"]
    floor: Float[Tensor, "*block candidate"]
    """FLOOR times the sky's mean radiance."""


def draw_pool(environment: Environment, table: EnvironmentTable, seed: int, samples_round: int, pool: int) -> Candidates:
    """The pool (BLOCKS, CANDIDATES) of a round; the environment unturned."""
    stream = torch.tensor(seed & 0xFFFFFFFF)
    for number in (samples_round, POOL_STREAM + pool):
        stream = hash_combine(stream, torch.tensor(number))
    entry = torch.arange(BLOCKS * CANDIDATES)
    u = sobol_2d(entry, stream.expand_as(entry), environment.radiance.dtype).view(BLOCKS, CANDIDATES, 2)
    direction = sample_environment(table, u)
    radiance, density = environment_radiance(environment, direction), environment_pdf(table, direction)
    integral = torch.where(density > 0, radiance.amax(-1) / density.clamp(min=1e-37), 0.0)
    return Candidates(direction, radiance, density, FLOOR * integral / (4 * torch.pi))


def blocks_of(pool: Candidates, stream: Int[Tensor, "sample"], index: Int[Tensor, "sample"]) -> Candidates:
    """What each sample chooses from."""
    block = ((hash_combine(stream, torch.full_like(stream, BLOCK_STREAM)) + index) & 0xFFFFFFFF) % BLOCKS
    return Candidates(*(values[block] for values in vars(pool).values()))


def choose_candidates(q: Float[Tensor, "sample candidate"], u: Float[Tensor, "sample"]) -> tuple[Tensor, Tensor]:
    """Index of each sample's candidate, drawn in proportion to q >= 0, and the sum of q over its own; 0 and 0 where all are 0."""
    total, before = q.sum(-1), q.cumsum(-1) - q
    reached = (q > 0) & (before <= (u * total)[:, None])
    chosen = torch.where(reached, torch.arange(q.shape[-1]), -1).amax(-1).clamp(min=0)
    own = q.gather(-1, chosen[:, None])[:, 0]
    return chosen, torch.where(own > 0, total / own.clamp(min=1e-37), 0.0)


def choose_directions(
    rays: Rays,
    points: ShadingPoints,
    starts: RayStarts,
    environment: Environment,
    table: EnvironmentTable,
    settings: IntegratorSettings,
    samples_round: int,
) -> Rays:
    """The rays of points with environment samples that chose; all weights are those of the larger number of samples."""
    shape = rays.direction_world.shape[:2]
    split = split_at(points, settings.counts, settings.by_material)
    strategy, index = strategy_of(split[:, None].expand(*shape, 3), samples_round, torch.arange(shape[1]).expand(shape))
    stream = strategy_seed(points.pixel[:, None], strategy, settings.seed)
    split = split * torch.tensor([1, 1, settings.candidates])
    pool = draw_pool(environment, table, settings.seed, samples_round, AT_POINTS)
    point, slot = torch.nonzero(strategy == 2).unbind(-1)
    blocks = blocks_of(pool, stream[point, slot], index[point, slot])

    of_sample = ShadingPoints(*(values[point] for values in vars(points).values()))
    weight = balance_weights(blocks.direction, of_sample, table, split[point])
    n, wo, albedo = (v[:, None].expand_as(blocks.direction) for v in (of_sample.normal_world, of_sample.wo_world, of_sample.albedo))
    roughness, metallic = (v[:, None].expand_as(weight) for v in (of_sample.roughness, of_sample.metallic))
    brdf = torch.add(*evaluate_brdf(blocks.direction, wo, n, albedo, roughness, metallic))
    light = blocks.radiance + blocks.floor[..., None]
    cosine = (n * blocks.direction).sum(-1).clamp(min=0)
    is_above = (blocks.direction * starts.surface_normal_world[point, None]).sum(-1) > 0
    u = sobol_2d(index[point, slot], stream[point, slot], weight.dtype)[:, 0]
    chosen, factor = choose_candidates((brdf * light).sum(-1) * cosine * weight * is_above, u)

    direction = rays.direction_world.clone()
    direction[point, slot] = blocks.direction[torch.arange(len(point)), chosen]
    weights = balance_weights(direction, points, table, split)
    weights[point, slot] *= factor
    return Rays(rays.origin_world, direction, weights)
