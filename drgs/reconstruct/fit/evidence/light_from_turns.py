"""Light that turns with the camera, from paint: each place is seen under many of its turns, and paint of one colour is alike on all sides.

With the radiance R_iv that paint at place i sends in photograph v, the share T_ivj of direction j's radiance that arrives there in it, and what the
object itself sends to it, I_iv,

    log R_iv = log a_i + log(sum_j T_ivj L_j + I_iv).

What differs between a place's looks says what light is like wherever one place turns to, whatever its albedo a_i, and what is alike between places of
one paint (light_from_paint) says it between places that never turn the same way: of an object that stands upright before cameras that stand around it,
what faces up and what faces aside. Gradients, which move albedo and light a step a photograph, leave such light far from where it explains the
photographs best: on a plate of one paint with things on it they left 0.18 of relative error and albedo 0.76, 0.40 and 0.22 above, aside and below,
where the true light leaves 0.163 (docs/decisions/0003-fitting.md, "Light that turns, from paint").

The light's logarithm changes by few harmonics: paint knows no more of it, and what mirrors show in it stays as fine as it was. Albedo is eliminated from
each step, for steps of albedo and light in turns hardly move what trades between them. Outlying looks count little: where shape or matter are wrong, so
is the light that they ask for.

Source: Ramamoorthi and Hanrahan 2001 for what paint knows, Golub and Pereyra 1973 for the steps (docs/sources.md: ramamoorthi2001, golub1973).

In: the mesh through its tracer, photographs, the light so far. Out: by what factor it is to change, by direction.
"""

import math
from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from drgs.maths.constants import F0
from drgs.maths.spherical_harmonics import sh_basis
from drgs.reconstruct.fit.evidence.light_from_paint import (
    DARKEST,
    PaintLightSettings,
    alikeness,
    drawn_by_area,
    mean_radiance,
    solid_angles,
    standing_apart,
    too_dark,
)
from drgs.reconstruct.fit.evidence.seen_vertices import SeenVertices, mirrored_radiance, seen_vertices
from drgs.reconstruct.fit.light.mesh_light import SHARE_LIFT, LightOf, MeshLight, corner_weights, hit_radiance
from drgs.reconstruct.fit.light.split_sum import shade_split_sum
from drgs.reconstruct.fit.view_targets import ViewTarget
from drgs.render.intersect.trace_rays import trace_rays
from drgs.render.intersect.tracer import AbstractTracer
from drgs.scene.environment import direction_from_uv, uv_from_direction

FAINTEST = 1e-4
"""Radiance that arrives, at least: its logarithm is asked for."""
PARTS = 3
"""A side, of a texel, by which it is spread over those that it is turned onto."""
REWEIGHTINGS = 3
"""Of a place's looks around their mean, in each step."""
LONGEST = 1.0
"""Step of a harmonic."""


@dataclass(frozen=True)
class TurnedLightSettings:
    """What is asked, and how far it is believed."""

    alike: PaintLightSettings = field(default_factory=PaintLightSettings)
    """What is alike, and how far light may change."""
    places: int = 1000
    """Drawn by area."""
    photographs: int = 24
    """That are asked, of all, at most."""
    looks: int = 12
    """Photographs of each place, at most."""
    degree: int = 3
    """Of the harmonics by which the light's logarithm changes."""
    dark: float = 0.05
    """Radiance below which errors count as absolute rather than relative."""
    spread: float = 0.15
    """Relative error from which a look counts little."""
    weight_alike: float = 1.0
    """Of a place's difference to those like it, against that of a look to its place."""
    hold: float = 2e-4
    """Of the light so far, against mean squared relative errors."""
    rounds: int = 8


@dataclass(frozen=True, eq=False)
class Looks:
    """Places as photographs show them."""

    place: Int[Tensor, "look"]
    shares: Float[Tensor, "look texel"]
    """Irradiance over pi that a unit of each texel's radiance leaves, in the light's directions."""
    from_object: Float[Tensor, "look 3"]
    """The same from the object itself."""
    sent: Float[Tensor, "look 3"]
    """Radiance, as the photograph has it, without gloss; above 0."""

    def arriving(self, light: Float[Tensor, "texel 3"]) -> Float[Tensor, "look 3"]:
        return (self.shares @ light + self.from_object).clamp(min=FAINTEST)


@torch.no_grad()
def light_from_turns(
    tracer: AbstractTracer,
    radiance: Float[Tensor, "128 256 3"],
    light_of: LightOf,
    targets: list[ViewTarget],
    paint: Bool[Tensor, "vertex"],
    settings: TurnedLightSettings,
    generator: torch.Generator,
) -> Float[Tensor, "rows columns 3"] | None:
    """Factors of `radiance`, texels laid out alike; None where too little paint is seen.

    Args:
        radiance: of the environment, so far, in the light's directions. light_of: the same with what arrives in each of the `targets`.
    """
    mesh, alike = tracer.mesh, settings.alike
    drawn = drawn_by_area(tracer, settings.places, generator)
    chosen, metal = drawn[paint[drawn]], drawn[~paint[drawn]]
    if len(chosen) < alike.fewest:
        return None
    asked = [targets[k] for k in even_choice(len(targets), settings.photographs)]
    looks = _looks(tracer, chosen, light_of, asked, settings, generator)
    seen, place = looks.place.unique(return_inverse=True)
    if len(seen) < alike.fewest:
        return None
    looks = Looks(place, looks.shares, looks.from_object, looks.sent)
    known = mean_radiance(radiance, alike.rows)
    solved = _solved(mesh.vertices[chosen[seen]], looks, known, settings)
    # How bright and of what colour light is as a whole it trades with albedo: so it stays, where the photographs are bright, ...
    before, after = looks.arriving(known), looks.arriving(solved)
    weight = looks.sent.mean(1, keepdim=True)
    solved = solved * ((weight * (before / after).log()).sum(0) / weight.sum()).exp()
    # ... but for as much as leaves albedo room below white.
    area = solid_angles(alike.rows).to(known)[:, None]
    whole = (known * area).sum(0) / (solved * area).sum(0).clamp(min=DARKEST)
    log_albedo = _log_albedo(looks, looks.arriving(solved), len(seen), settings)[0]
    solved = solved * too_dark(torch.cat([log_albedo.exp(), mesh.albedo[metal] * whole]), alike)
    return (solved / known.clamp(min=1e-6)).clamp(1 / alike.most, alike.most).view(alike.rows, 2 * alike.rows, 3)


def even_choice(count: int, most: int) -> list[int]:
    """Numbers below `count`, at most so many, evenly among them."""
    chosen = min(count, most)
    return [(2 * k + 1) * count // (2 * chosen) for k in range(chosen)]


def _looks(
    tracer: AbstractTracer,
    chosen: Int[Tensor, "place"],
    light_of: LightOf,
    targets: list[ViewTarget],
    settings: TurnedLightSettings,
    generator: torch.Generator,
) -> Looks:
    """Of the chosen vertices, by one ray a texel each."""
    mesh, rows = tracer.mesh, settings.alike.rows
    start, normal = mesh.vertices[chosen], mesh.normals[chosen]
    direction = _directions(len(chosen), rows, generator).to(start)
    weight = (direction * normal[:, None]).sum(-1).clamp(min=0) * solid_angles(rows).to(start) / math.pi
    place, texel = (weight > 0).nonzero().unbind(1)
    hits = trace_rays(start[place] + SHARE_LIFT * tracer.lift * normal[place], direction[place, texel], tracer)
    met = hits.hit.nonzero().squeeze(1)
    place, texel = place[met], texel[met]
    own, towards = weight[place, texel, None], -direction[place, texel]
    face, corners = hits.face[met].long(), corner_weights(hits.barycentric[met])
    open_share = weight
    open_share[place, texel] = 0

    def looked_at(view: ViewTarget, shown: Tensor, seen: SeenVertices) -> Looks:
        """The places `shown`, by number, as the view has `seen` them."""
        light = light_of(view)
        assert light.light_from_world is not None  # of views whose light turns
        slot = torch.full((len(chosen),), -1, device=shown.device)
        slot[shown] = torch.arange(len(shown), device=shown.device)
        here = (slot[place] >= 0).nonzero().squeeze(1)
        sent = own[here] * hit_radiance(mesh, face[here], corners[here], towards[here], light)
        from_object = start.new_zeros(len(shown), 3).index_add_(0, slot[place[here]], sent)
        shares = open_share[shown] @ _turned_texels(light.light_from_world, rows).to(start)
        return Looks(shown, shares, from_object, (seen.photo - _gloss(tracer, seen, light)).clamp(min=DARKEST))

    drawn = _drawn_looks(tracer, chosen, targets, settings.looks, generator)
    parts = [looked_at(target, *shown) for target, shown in zip(targets, drawn, strict=True)]
    return Looks(*(torch.cat([getattr(part, name) for part in parts]) for name in ("place", "shares", "from_object", "sent")))


def _directions(count: int, rows: int, generator: torch.Generator) -> Float[Tensor, "{count} texel 3"]:
    """Unit, one in each texel of a table of so many rows."""
    v, u = torch.meshgrid(torch.arange(rows), torch.arange(2 * rows), indexing="ij")
    corner = torch.stack([u, v], -1).reshape(-1, 2)
    within = torch.rand(count, len(corner), 2, generator=generator)
    return direction_from_uv((corner + within) / torch.tensor([2 * rows, rows]))


def _gloss(tracer: AbstractTracer, seen: SeenVertices, light: MeshLight) -> Float[Tensor, "seen 3"]:
    """Radiance that paint mirrors towards the camera, under the light so far."""
    transmittance, met = mirrored_radiance(tracer, seen, light)
    black, at, mesh = torch.zeros_like(seen.photo), seen.index, tracer.mesh
    return shade_split_sum(
        black, black, black + F0, mesh.roughness[at], mesh.normals[at], seen.wo, light.tables, transmittance=transmittance,
        hit_radiance=met, open_share=light.open_share[at], light_from_world=light.light_from_world,
    )  # fmt: skip


def _drawn_looks(
    tracer: AbstractTracer, chosen: Int[Tensor, "place"], targets: list[ViewTarget], most: int, generator: torch.Generator
) -> list[tuple[Int[Tensor, "shown"], SeenVertices]]:
    """For each photograph the places, by number, that are looked at in it, and what it has there: of each, `most` of the photographs that show it.

    Args:
        chosen: vertices in ascending order.
    """
    seen = [seen_vertices(tracer, target, chosen) for target in targets]
    places = [torch.searchsorted(chosen, each.index) for each in seen]
    shows = torch.zeros(len(targets), len(chosen), dtype=torch.bool)
    for shown, place in zip(shows, places, strict=True):
        shown[place.cpu()] = True
    order = torch.rand(shows.shape, generator=generator) + (~shows).float()
    last = order.sort(0).values[min(most, len(targets)) - 1]
    looks = []
    for own, place, each in zip((order <= last).to(chosen.device), places, seen, strict=True):
        kept = own[place]
        looks.append((place[kept], SeenVertices(each.index[kept], each.photo[kept], each.wo[kept])))
    return looks


def _turned_texels(turn: Float[Tensor, "3 3"], rows: int) -> Float[Tensor, "texel texel"]:
    """Of each texel of the world's directions the shares of it that `turn` brings onto each of the light's."""
    fine = PARTS * rows
    v, u = torch.meshgrid((torch.arange(fine) + 0.5) / fine, (torch.arange(2 * fine) + 0.5) / (2 * fine), indexing="ij")
    uv = uv_from_direction(direction_from_uv(torch.stack([u, v], -1)) @ turn.cpu().T)
    sides = torch.tensor([2 * rows, rows])
    column, row = torch.minimum((uv * sides).long().clamp(min=0), sides - 1).unbind(-1)
    own_row, own_column = torch.meshgrid(torch.arange(fine) // PARTS, torch.arange(2 * fine) // PARTS, indexing="ij")
    texels = 2 * rows * rows
    at = ((own_row * 2 * rows + own_column) * texels + row * 2 * rows + column).flatten()
    return torch.zeros(texels * texels).index_add_(0, at, torch.full((len(at),), 1 / PARTS**2)).view(texels, texels)


def _log_albedo(
    looks: Looks, arriving: Float[Tensor, "look 3"], places: int, settings: TurnedLightSettings
) -> tuple[Float[Tensor, "place 3"], Float[Tensor, "look 3"], Float[Tensor, "look 3"]]:
    """Of each place, by its looks; how far each look is from it, and how much it counts."""
    found = looks.sent.log() - arriving.log()
    trust = (looks.sent / (looks.sent + settings.dark)).square()
    weight = trust
    for _ in range(REWEIGHTINGS):
        mean = _sums(looks, weight * found, places) / _sums(looks, weight, places)
        apart = found - mean[looks.place]
        weight = trust / (1 + apart.square().mean(1, keepdim=True) / settings.spread**2)
    return mean, apart, weight


def _sums(looks: Looks, values: Float[Tensor, "look column"], places: int) -> Float[Tensor, "place column"]:
    return values.new_zeros(places, values.shape[1]).index_add_(0, looks.place, values)


def _solved(
    positions: Float[Tensor, "place 3"], looks: Looks, known: Float[Tensor, "texel 3"], settings: TurnedLightSettings
) -> Float[Tensor, "texel 3"]:
    """The light that explains the looks, and makes paint alike, by Gauss-Newton steps.

    Args:
        positions: of the places, each of which is looked at. known: the light so far.
    """
    rows, places, count = settings.alike.rows, len(positions), len(looks.place)
    v, u = torch.meshgrid((torch.arange(rows) + 0.5) / rows, (torch.arange(2 * rows) + 0.5) / (2 * rows), indexing="ij")
    basis = sh_basis(direction_from_uv(torch.stack([u, v], -1)).view(-1, 3), settings.degree).to(known)
    hold = settings.hold * torch.eye(basis.shape[1]).to(known)
    where = standing_apart(positions, settings.alike)
    change = known.new_zeros(basis.shape[1], 3)
    light = known
    for _ in range(settings.rounds):
        arriving = looks.arriving(light)
        albedo, apart, weight = _log_albedo(looks, arriving, places, settings)
        near = alikeness(albedo, where, settings.alike)
        near = near / near.sum(1, keepdim=True)
        steps = []
        for c in range(3):
            w = weight[:, c, None]
            slope = -((looks.shares * light[:, c]) @ basis) / arriving[:, c, None]  # of `apart`'s first term by `change`
            mean_slope = _sums(looks, w * slope, places) / _sums(looks, w, places)
            slope = slope - mean_slope[looks.place]
            unlike, unlike_slope = albedo[:, c] - near @ albedo[:, c], mean_slope - near @ mean_slope
            w_unlike = settings.weight_alike / (1 + unlike.square() / settings.spread**2)
            square = slope.T @ (w * slope) / count + unlike_slope.T @ (w_unlike[:, None] * unlike_slope) / places + hold
            goal = slope.T @ (w[:, 0] * apart[:, c]) / count + unlike_slope.T @ (w_unlike * unlike) / places + hold @ change[:, c]
            steps.append(torch.linalg.solve(square, goal))
        change = change - torch.stack(steps, 1).clamp(-LONGEST, LONGEST)
        light = known * (basis @ change).exp()
    return light
