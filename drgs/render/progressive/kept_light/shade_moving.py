"""The light of a moving picture: kept light where it is good enough, rays for what is left.

In: the points of a pass, the kept light. Out: their light, which of them were read, and kept light with more rounds. Points that are read
pay for specular rays alone. What is spent on the next picture's kept light is bounded by what this one spends (SPENT_FIRST, SPENT_LATER).
"""

from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from drgs.maths.constants import F0
from drgs.render.integrate.integrator import AbstractIntegrator, IntegratorSettings
from drgs.render.progressive.kept_light.gather_light import gather_light, vertices_to_light
from drgs.render.progressive.kept_light.kept_light import A_ROUND, KeptLight
from drgs.render.progressive.kept_light.read_light import READ, LightThere, read_light
from drgs.render.records import PrimaryPoints, SampleCounts, ShadedPoints, ShadingPoints
from drgs.render.visible.points_at import points_at

SPENT_FIRST = 1
"""Rays that go to kept light for each point that is not read, as a share of its own."""
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
    footprint: float,
) -> MovingLight:
    """Light of a picture's first pass.

    Args:
        how: of points that are not read. horizon: of the tracer's mesh. footprint: of a pixel at distance 1 [world units].
    """
    there = read_light(kept, primary, integrator.tracer, footprint)
    read = there.verdict == int(READ)
    here, elsewhere = torch.nonzero(read).squeeze(-1), torch.nonzero(~read).squeeze(-1)
    traced = points_at(primary, elsewhere)
    light = integrator.shade(traced.points, traced.starts, environment_light, how, 0, None, horizon)
    glossy = points_at(primary, here)
    fewer = replace(how, counts=specular_counts(how.counts))
    specular = integrator.shade(only_specular(glossy.points), glossy.starts, environment_light, fewer, 0, None, horizon)
    young = int((there.wanted & (kept.indirect_rounds < ENOUGH_ROUNDS)).sum())
    vertices = vertices_to_light(kept, there.wanted, rays_to_keep(how.counts.total, len(elsewhere), len(here), young))
    kept = gather_light(kept, vertices, integrator, environment_light, how)
    return MovingLight(_together(light, elsewhere, _with_kept(specular, glossy.points, there, here), here), there.samples, kept)


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


def _with_kept(specular: ShadedPoints, points: ShadingPoints, there: LightThere, here: Tensor) -> ShadedPoints:
    """Light of points that are read: specular light, and kept light times their albedo."""
    reflectance = (1 - points.metallic)[:, None] * points.albedo
    # The luminance of a product is no product; this is how denoisers take it apart again.
    variance = there.variance[here] * reflectance.square().mean(-1)
    both = torch.stack([variance + specular.variance[:, 2], variance, specular.variance[:, 2]], -1)
    return ShadedPoints(reflectance * there.light[here], specular.specular, both, there.visibility[here])


def _together(a: ShadedPoints, where_a: Tensor, b: ShadedPoints, where_b: Tensor) -> ShadedPoints:
    """Two sets of points in the order of the pass."""

    def both(name: str) -> Tensor:
        first, second = getattr(a, name), getattr(b, name)
        values = first.new_empty(len(where_a) + len(where_b), *first.shape[1:])
        values[where_a], values[where_b] = first, second
        return values

    return ShadedPoints(both("diffuse"), both("specular"), both("variance"), both("visibility"))
