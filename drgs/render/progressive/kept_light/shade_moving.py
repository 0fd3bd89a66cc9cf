"""The light of a moving picture: kept light where it is good enough, rays for what is left.

In: the points of a pass, the kept light. Out: their light, which of them were read, and kept light with more rounds. Points that are read
pay for specular rays alone, and of rough paint one in four does (lend_specular.py). What is spent on the next picture's kept light is bounded by what this one spends (SPENT_FIRST, SPENT_LATER).
"""

from dataclasses import dataclass, replace
from typing import Any

import torch
import warp as wp
from jaxtyping import Float
from torch import Tensor

from drgs.maths.constants import F0
from drgs.render.integrate.integrator import AbstractIntegrator, IntegratorSettings, light_sums
from drgs.render.integrate.sample_arrays import PointArrays, point_arrays
from drgs.render.integrate.sum_samples import LightSums
from drgs.render.progressive.demodulate_albedo import mean_square
from drgs.render.progressive.kept_light.gather_light import gather_light, vertices_to_light
from drgs.render.progressive.kept_light.kept_light import A_ROUND, KeptLight
from drgs.render.progressive.kept_light.lend_specular import find_lenders, lend_specular
from drgs.render.progressive.kept_light.light_of_hits import light_of_hits
from drgs.render.progressive.kept_light.read_light import READ, ThereArrays, read_light, there_arrays
from drgs.render.records import PrimaryPoints, SampleCounts, ShadedPoints, ShadingPoints
from drgs.warp_torch import launch, warp_array, warp_device

wp.set_module_options({"enable_backward": False})

SPENT_FIRST = 1
"""Rays that go to kept light for each point that is not read, as a share of its own."""
SPENT_ON_HITS = 1.0
"""Rays of a picture, for each of its points, that go to light of surfaces that other rays met."""
ENOUGH_ROUNDS = 4
"""Of a vertex, from which on no more is spent on it for points that are not read: metal, and the edges of shadows, will never be."""
SPENT_LATER, LEAST_LATER = 1 / 16, 0.5
"""The same for each point that is read; and at least."""
SPECULAR = 3 / 8
"""Rays of a point that is read, as a share of one that is not, at least two: its specular part is a fraction of its light (LEAST_DIFFUSE), and
with these rays the whole is still known no worse than with all (docs/performance.md)."""


@dataclass(frozen=True, eq=False)
class MovingLight:
    """Of the points of a pass."""

    light: ShadedPoints
    kept_samples: Float[Tensor, "point"]
    """Rays behind the diffuse part where it is kept light; else 0."""
    kept: KeptLight


def shade_moving(
    integrator: AbstractIntegrator,
    primary: PrimaryPoints,
    environment_light: Any,
    how: IntegratorSettings,
    kept: KeptLight,
    horizon: Tensor | None,
    where: Any,
) -> MovingLight:
    """Light of a picture's first pass.

    Args:
        how: of points that are not read. horizon: of the tracer's mesh. where: Neighbourhood of the points.
    """
    there = read_light(kept, primary, integrator.tracer, where.footprint)
    known = light_of_hits(kept, integrator.tracer) if how.bounces == 1 else None
    read = there.verdict == int(READ)
    here, elsewhere = (torch.nonzero(chosen).squeeze(-1).int() for chosen in (read, ~read))
    light = integrator.shade(primary.points, primary.starts, environment_light, how, 0, None, horizon, known, elsewhere)
    fewer, glossy = replace(how, counts=specular_counts(how.counts)), only_specular(primary.points)
    lenders = find_lenders(primary, there.verdict, where)
    light = integrator.shade(glossy, primary.starts, environment_light, fewer, 0, None, horizon, known, lenders.with_rays, light)
    lend_specular(lenders, primary, light)
    inputs = [warp_array(here), point_arrays(primary.points), there_arrays(there)]
    launch(add_read_light, len(here), inputs, [light_sums(light)], warp_device(read))
    young = int((there.wanted & (kept.indirect_rounds < ENOUGH_ROUNDS)).sum())
    vertices = vertices_to_light(kept, there.wanted, rays_to_keep(how.counts.total, len(elsewhere), len(here), young))
    if known is not None:
        asked = known.asked & (kept.rounds < 1) & ~there.wanted
        vertices = torch.cat([vertices, vertices_to_light(kept, asked, int(SPENT_ON_HITS * len(there.samples)))])
    return MovingLight(light, there.samples, gather_light(kept, vertices, integrator, environment_light, how, known))


@wp.kernel
def add_read_light(
    first: int,
    here: wp.array[int],
    points: PointArrays,
    there: ThereArrays,
    # in and out
    light: LightSums,
):
    """The diffuse light of points that are read, beside the specular light that rays brought."""
    p = here[first + wp.tid()]
    reflectance = (1.0 - points.metallic[p]) * points.albedo[p]
    # The luminance of a product is no product; this is how denoisers take it apart again.
    variance = there.variance[p] * mean_square(reflectance)
    specular = light.variance[p][2]
    light.diffuse[p] = wp.cw_mul(reflectance, there.light[p])
    light.variance[p] = wp.vec3(variance + specular, variance, specular)
    light.visibility[p] = there.visibility[p]


def specular_counts(counts: SampleCounts) -> SampleCounts:
    """Of a point whose diffuse light is known."""
    total = max(2, int(SPECULAR * counts.total))
    environment = total // 2 if counts.environment > 0 else 0
    return SampleCounts(0, total - environment, environment)


def rays_to_keep(rays_a_point: int, traced: int, read: int, young: int) -> int:
    """What a picture may spend on kept light.

    Args:
        traced: points that are not read. read: those that are. young: wanted vertices with fewer than ENOUGH_ROUNDS.
    """
    first = min(SPENT_FIRST * rays_a_point * traced, A_ROUND.total * young)
    return int(first + max(SPENT_LATER * rays_a_point, LEAST_LATER) * read)


def only_specular(points: ShadingPoints) -> ShadingPoints:
    """Points that reflect as these do, without the diffuse part: metal whose colour is their reflectance at normal incidence."""
    metallic = points.metallic[:, None]
    return replace(points, albedo=F0 * (1 - metallic) + metallic * points.albedo, metallic=torch.ones_like(points.metallic))
