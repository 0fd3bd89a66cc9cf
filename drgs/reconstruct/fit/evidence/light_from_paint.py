"""The light under which paint of one colour is alike on all sides of the object.

Gradients leave light and paint where they began: a lamp above that stage 1 missed has become brighter paint on all that faces up and darker paint on
all that faces down, every photograph is explained, and nothing calls it back. But objects wear few paints, and wear them around bends. With the
radiance R_i that paint sends at places i, the share T_ij of direction j's radiance that arrives there, and what the object itself sends to it, I_i,

    R_i = (a_i + g) (sum_j T_ij L_j + I_i),

where g is the gloss of all paint, albedo follows from light. Which light: that under which places of alike chroma and brightness, near each other,
have alike albedo, most of them, in relative terms. Near each other, for else an object whose upper half is white and whose lower half is grey would be
told to be of one paint.
Each place's albedo is held against the mean of places like it, light is solved for these means by non-negative least squares with what the fit had as a
faint prior, and albedo is taken anew from it; again until they agree. The brightness of places alike may differ by a third, so that this finds what
gradients do not.

What faces down is lit by little, and of another colour than the rest; taken for lit by more, its paint is black or of another hue, a paint of its own to
a narrow kernel, and what is wrong below agrees with itself. So light is solved for once more with a kernel that begins wide, which brings both together,
and narrows, so that what truly is of two paints parts again. Not all does: of both lights the one is taken under which the object wears fewer paints.
Gloss counts for the same reason: what sends next to nothing but gloss says nothing of light without it.

Source: places of alike chroma have one reflectance (docs/sources.md: garces2012), here on a surface and with light by direction; paint is spread least
under the right light (finlayson2004); steps of beck2009.

Where the light turns with the camera, photographs say more: light_from_turns.

In: the mesh through its tracer, the light so far. Out: by what factor it is to change, by direction.
"""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from drgs.reconstruct.fit.light.mesh_light import SHARE_LIFT, MeshLight, radiance_along
from drgs.reconstruct.fit.light.split_sum import texel_solid_angles
from drgs.render.intersect.tracer import AbstractTracer
from drgs.scene.environment import direction_from_uv
from drgs.scene.mesh import face_areas

DARKEST = 1e-3
"""Radiance below which errors count as absolute rather than relative."""
BRIGHTEST = 10.0
"""Albedo, with light that is yet to be brighter."""


@dataclass(frozen=True)
class PaintLightSettings:
    """What is asked, and how far it is believed."""

    rows: int = 16
    """Of the table in which light is solved."""
    places: int = 2000
    """Drawn by area."""
    fewest: int = 200
    """Of them that are paint; with fewer the light stays."""
    alike_chroma: float = 0.09
    """Of logarithms, less their mean: standard deviation of the kernel by which albedos are alike in the end ..."""
    alike_brightness: float = 0.35
    """... and that of their mean."""
    alike_at_first: float = 0.6
    """Both in the first round of a second solve: under light of a wrong colour one paint has several, and only what counts as alike is brought together."""
    alike_place: float = 0.4
    """Of where they are, over the root mean squared distance of places from their middle."""
    gloss: float = 0.05
    """Share of the light that paint sends back without its colour: a dielectric's of reflectance 0.04, over all directions."""
    noise: float = 0.1
    """Relative error up to which places count by its square; beyond by its amount."""
    hold: float = 0.2
    """Of the light so far, against the places' mean squared relative error."""
    stride: float = 1.6
    """Albedo goes towards the mean of places like it by this much of the way: beyond, for from round to round means of the near change but slowly."""
    rounds: int = 16
    """Albedo and light in turns."""
    steps: int = 100
    """Of each solve."""
    brightest: float = 0.85
    """Albedo in its brightest channel, below which is ..."""
    share_below: float = 0.99
    """... this share of the places, at least: beyond light is too dark, not what it falls on too bright."""
    most: float = 4.0
    """Factor by which a direction changes."""

    def at_round(self, number: int) -> "PaintLightSettings":
        """With the kernel of round `number`."""
        place = number / max(self.rounds - 1, 1)

        def between(end: float) -> float:
            return max(self.alike_at_first, end) ** (1 - place) * end**place

        return replace(self, alike_chroma=between(self.alike_chroma), alike_brightness=between(self.alike_brightness))


@torch.no_grad()
def light_from_paint(
    tracer: AbstractTracer,
    radiance: Float[Tensor, "128 256 3"],
    light: MeshLight,
    paint: Bool[Tensor, "vertex"],
    settings: PaintLightSettings,
    generator: torch.Generator,
) -> Float[Tensor, "rows columns 3"] | None:
    """Factors of `radiance`, texels laid out alike; None where there is too little paint.

    Args:
        radiance: of the environment, so far. light: the same with what arrives, in the world's directions.
    """
    mesh = tracer.mesh
    drawn = drawn_by_area(tracer, settings.places, generator)
    chosen, metal = drawn[paint[drawn]], drawn[~paint[drawn]]
    if len(chosen) < settings.fewest:
        return None
    known = mean_radiance(radiance, settings.rows)
    shares, from_object = _arriving(tracer, chosen, light, settings.rows, generator)
    albedo = mesh.albedo[chosen] * (1 - mesh.metallic[chosen])[:, None] + settings.gloss
    sent = (albedo * (shares @ known + from_object)).clamp(min=DARKEST)
    where = standing_apart(mesh.vertices[chosen], settings)
    solved = min(
        (_solved(where, shares, from_object, sent, known, own) for own in (replace(settings, alike_at_first=0.0), settings)),
        key=lambda light: spread_of_paint(_log_albedo(sent, shares @ light + from_object), where, settings),
    )
    # How bright and of what colour light is as a whole it trades with albedo, and places that are alike say nothing of it: so it stays for most of what
    # is seen by it (dark sides, where it was furthest off, do not count), ...
    before, after = ((shares @ radiance_of + from_object).clamp(min=DARKEST) for radiance_of in (known, solved))
    solved = solved * weighted_median(before / after, sent.mean(1))
    # ... but for as much as leaves albedo room below white.
    area = solid_angles(settings.rows).to(known)[:, None]
    whole = (known * area).sum(0) / (solved * area).sum(0).clamp(min=DARKEST)
    solved = solved * too_dark(
        torch.cat([sent / (shares @ solved + from_object).clamp(min=DARKEST) - settings.gloss, mesh.albedo[metal] * whole]), settings
    )
    return (solved / known.clamp(min=1e-6)).clamp(1 / settings.most, settings.most).view(settings.rows, 2 * settings.rows, 3)


def weighted_median(values: Float[Tensor, "place column"], weight: Float[Tensor, "place"]) -> Float[Tensor, "column"]:
    """Of each column: below and above it lies half of the weight."""
    ranked, order = values.sort(dim=0)
    summed = weight[order].cumsum(0)
    at = (summed < 0.5 * summed[-1]).sum(0)
    return ranked.gather(0, at[None]).squeeze(0)


def too_dark(albedo: Float[Tensor, "place 3"], settings: PaintLightSettings) -> float:
    """By what factor light is to be brighter, that what it falls on is not above white; 1 where it is not."""
    return max(1.0, float(albedo.amax(1).quantile(settings.share_below)) / settings.brightest)


def drawn_by_area(tracer: AbstractTracer, count: int, generator: torch.Generator) -> Int[Tensor, "place"]:
    """Vertices, by the area of a face around them."""
    faces, area = tracer.mesh.faces.long(), face_areas(tracer.mesh.vertices, tracer.mesh.faces)
    return faces[torch.multinomial(area.cpu(), count, replacement=True, generator=generator).to(faces.device), 0].unique()


def solid_angles(rows: int) -> Float[Tensor, "texel"]:
    """Of a table's texels [sr]."""
    return texel_solid_angles(rows).repeat_interleave(2 * rows)


def mean_radiance(radiance: Float[Tensor, "128 256 3"], rows: int) -> Float[Tensor, "texel 3"]:
    """Of a table, over the texels of a coarser one."""
    area = texel_solid_angles(radiance.shape[0]).to(radiance)[:, None].expand(radiance.shape[:2])[None]
    sums = torch.nn.functional.adaptive_avg_pool2d(radiance.permute(2, 0, 1) * area, (rows, 2 * rows))
    return (sums / torch.nn.functional.adaptive_avg_pool2d(area, (rows, 2 * rows))).permute(1, 2, 0).reshape(-1, 3)


def _arriving(
    tracer: AbstractTracer, chosen: Int[Tensor, "place"], light: MeshLight, rows: int, generator: torch.Generator
) -> tuple[Float[Tensor, "place texel"], Float[Tensor, "place 3"]]:
    """Irradiance over pi that a unit of each texel's radiance leaves at each place, by one ray a texel; and what the object sends there."""
    mesh, columns = tracer.mesh, 2 * rows
    start = mesh.vertices[chosen]
    normal = mesh.normals[chosen]
    v, u = torch.meshgrid(torch.arange(rows), torch.arange(columns), indexing="ij")
    corner = torch.stack([u, v], -1).reshape(-1, 2)
    within = torch.rand(len(chosen), len(corner), 2, generator=generator)
    direction = direction_from_uv(((corner + within) / torch.tensor([columns, rows])).to(start))
    solid_angle = solid_angles(rows).to(start)
    weight = (direction * normal[:, None]).sum(-1).clamp(min=0) * solid_angle / math.pi
    place, texel = (weight > 0).nonzero().unbind(1)
    origins = start[place] + SHARE_LIFT * tracer.lift * normal[place]
    transmittance, met = radiance_along(tracer, origins, direction[place, texel], light)
    own = weight[place, texel]
    shares = torch.zeros_like(weight)
    shares[place, texel] = own * transmittance
    return shares, torch.zeros_like(start).index_add_(0, place, own[:, None] * met)


def _solved(
    where: Float[Tensor, "place 3"],
    shares: Float[Tensor, "place texel"],
    from_object: Float[Tensor, "place 3"],
    sent: Float[Tensor, "place 3"],
    known: Float[Tensor, "texel 3"],
    settings: PaintLightSettings,
) -> Float[Tensor, "texel 3"]:
    """The light that makes paint alike.

    Args:
        where: of standing_apart. sent: radiance, above 0. known: the light so far.
    """
    light = known
    solid_angle = (solid_angles(settings.rows) / (4 * math.pi)).to(known)[:, None]
    unit = known + (known * solid_angle).sum(0)  # a texel's steps are relative, for those that are dark to their mean
    for number in range(settings.rounds):
        own = settings.at_round(number)
        arriving = shares @ light + from_object
        log_albedo = _log_albedo(sent, arriving)
        alike = (log_albedo + settings.stride * (_mean_of_alike(log_albedo, where, own) - log_albedo)).exp()
        error = ((sent - alike * arriving) / sent).abs().mean(1)
        weight = error.clamp(min=settings.noise).rsqrt()
        weight = weight / weight.mean()
        relative = weight[:, None] * alike / sent
        light = torch.stack(
            [
                unit[:, c]
                * _non_negative(
                    (relative[:, c, None] * shares) * unit[:, c],
                    weight - relative[:, c] * from_object[:, c],
                    settings.hold * solid_angle[:, 0],
                    known[:, c] / unit[:, c],
                    light[:, c] / unit[:, c],
                    settings.steps,
                )
                for c in range(3)
            ],
            -1,
        )
    return light


def _log_albedo(sent: Float[Tensor, "place 3"], arriving: Float[Tensor, "place 3"]) -> Float[Tensor, "place 3"]:
    """With gloss."""
    return (sent / arriving.clamp(min=1e-4)).clamp(DARKEST, BRIGHTEST).log()


def spread_of_paint(log_albedo: Float[Tensor, "place 3"], where: Float[Tensor, "place 3"], settings: PaintLightSettings) -> float:
    """0 where all that is near each other is of one paint: the mean logarithm of how many times more is near a place than near and alike.

    Args:
        where: of standing_apart.
    """
    near = torch.exp(-0.5 * torch.cdist(where, where).square())
    return float((near.sum(1) / alikeness(log_albedo, where, settings).sum(1)).log().mean())


def _mean_of_alike(
    log_albedo: Float[Tensor, "place 3"], where: Float[Tensor, "place 3"], settings: PaintLightSettings
) -> Float[Tensor, "place 3"]:
    """Of places with alike chroma and brightness near each other.

    Args:
        where: of standing_apart.
    """
    near = alikeness(log_albedo, where, settings)
    return (near @ log_albedo) / near.sum(1, keepdim=True)


def standing_apart(positions: Float[Tensor, "place 3"], settings: PaintLightSettings) -> Float[Tensor, "place 3"]:
    """Where places are, in standard deviations of the kernel of alikeness."""
    middle = positions - positions.mean(0)
    return middle / (settings.alike_place * middle.square().sum(1).mean().sqrt())


def alikeness(
    log_albedo: Float[Tensor, "place 3"], where: Float[Tensor, "place 3"], settings: PaintLightSettings
) -> Float[Tensor, "place place"]:
    """How much places are of one paint, 0..1, by chroma, brightness and where they are.

    Args:
        where: of standing_apart.
    """
    brightness = log_albedo.mean(1, keepdim=True)
    scaled = torch.cat([(log_albedo - brightness) / settings.alike_chroma, brightness / settings.alike_brightness, where], 1)
    return torch.exp(-0.5 * torch.cdist(scaled, scaled).square())


def _non_negative(
    matrix: Float[Tensor, "place texel"],
    wanted: Float[Tensor, "place"],
    hold: Float[Tensor, "texel"],
    home: Float[Tensor, "texel"],
    start: Float[Tensor, "texel"],
    steps: int,
) -> Float[Tensor, "texel"]:
    """The least mean square of `matrix x - wanted`, plus `hold` times that of x - `home`, over x of at least 0."""
    square = matrix.T @ matrix / len(matrix) + torch.diag(hold)
    goal = matrix.T @ wanted / len(matrix) + hold * home
    largest = torch.ones_like(start)
    for _ in range(20):
        largest = square @ largest
        largest = largest / largest.norm()
    # The power method comes from below.
    step = 1 / (1.02 * float(largest @ (square @ largest)))
    found, ahead, momentum = start, start, 1.0
    for _ in range(steps):
        following = (ahead - step * (square @ ahead - goal)).clamp(min=0)
        after = (1 + math.sqrt(1 + 4 * momentum * momentum)) / 2
        ahead = following + (momentum - 1) / after * (following - found)
        found, momentum = following, after
    return found
