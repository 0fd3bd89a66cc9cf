"""Pixels of a photograph on the mesh, and how split sum shades them: what the fits of the surface compare.

In: the tracer of a mesh, normals and materials of its vertices, the filtered light. Out: the places that pixels see, and their colours in
display space, differentiable in all but the places.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from drgs.reconstruct.fit.light.mesh_light import MeshLight, at_corners, corner_weights, mirrored_light
from drgs.reconstruct.fit.surface.surface_color import surface_color
from drgs.reconstruct.fit.view_targets import ViewTarget
from drgs.render.intersect.trace_rays import trace_rays
from drgs.render.intersect.tracer import AbstractTracer
from drgs.render.records import Hits
from drgs.scene.camera import world_from_pixel

SOLID = 0.995
"""Least coverage of a pixel that is compared: others mix in the background."""
GRAZING = 0.05
"""Least cosine between normal and view: below, interpolated normals say little."""


@dataclass(frozen=True, eq=False)
class SeenPlaces:
    """Where pixels see the mesh."""

    pixels: Int[Tensor, "place"]
    """Flat indices."""
    wo: Float[Tensor, "place 3"]
    face: Int[Tensor, "place"]
    corners: Int[Tensor, "place 3"]
    weights: Float[Tensor, "place 3"]
    """Of the corners."""

    def __getitem__(self, chosen: Bool[Tensor, "place"] | Int[Tensor, "chosen"]) -> "SeenPlaces":
        at = chosen.nonzero().squeeze(1) if chosen.dtype == torch.bool else chosen
        return SeenPlaces(*(values.index_select(0, at) for values in vars(self).values()))

    @property
    def nearest(self) -> Int[Tensor, "place"]:
        """Vertex at the nearest corner."""
        return self.corners.gather(1, self.weights.argmax(1, keepdim=True)).squeeze(1)


@torch.no_grad()
def seen_places(target: ViewTarget, pixels: Int[Tensor, "pixel"], tracer: AbstractTracer) -> SeenPlaces:
    """Those of `pixels` (flat) that see the mesh, by their middles."""
    direction = _directions(target, pixels, torch.full((len(pixels), 2), 0.5, device=pixels.device))
    hits = trace_rays(target.camera.center_world.expand_as(direction), direction, tracer)
    return _places_of(hits.hit, pixels, direction, hits, tracer)


@torch.no_grad()
def seen_twice(
    target: ViewTarget, pixels: Int[Tensor, "pixel"], tracer: AbstractTracer, generator: torch.Generator
) -> tuple[SeenPlaces, SeenPlaces]:
    """Of those of `pixels` (flat) that see the mesh two times, each time by a place of the pixel drawn anew.

    Why: a pixel shows its mean. With one place for both estimates, what differs within a pixel is noise that both share, and crossed_halves
    takes it for error: what is finer than a pixel would be flattened.
    """
    rays = []
    for _ in range(2):
        direction = _directions(target, pixels, torch.rand(len(pixels), 2, generator=generator).to(target.mask))
        rays.append((direction, trace_rays(target.camera.center_world.expand_as(direction), direction, tracer)))
    both = rays[0][1].hit & rays[1][1].hit
    first, second = (_places_of(both, pixels, direction, hits, tracer) for direction, hits in rays)
    return first, second


def _directions(target: ViewTarget, pixels: Int[Tensor, "pixel"], inside: Float[Tensor, "pixel 2"]) -> Float[Tensor, "pixel 3"]:
    """Unit, world, of the pixels (flat), through a place inside each, 0..1 from its corner."""
    width = target.camera.width
    at = torch.stack([pixels % width, pixels // width], -1) + inside
    directions = torch.cat([at, torch.ones_like(at[:, :1])], -1) @ world_from_pixel(target.camera).T
    return torch.nn.functional.normalize(directions, dim=-1)


def _places_of(chosen: Tensor, pixels: Tensor, direction: Tensor, hits: Hits, tracer: AbstractTracer) -> SeenPlaces:
    """The `chosen` (pixel,) rays' places."""
    at = chosen.nonzero().squeeze(1)
    face = hits.face[at].long()
    return SeenPlaces(pixels[at], -direction[at], face, tracer.mesh.faces[face].long(), corner_weights(hits.barycentric[at]))


def packed_surface(parameters: dict[str, Tensor]) -> Float[Tensor, "vertex 8"]:
    """Normals, albedo, roughness and metallic of a fit's vertices side by side: places gather them at once."""
    one = (parameters[f"{name}_logits"][:, None] for name in ("roughness", "metallic"))
    logits = torch.cat([parameters["albedo_logits"], *one], 1)
    return torch.cat([torch.nn.functional.normalize(parameters["normals"], dim=-1), torch.sigmoid(logits)], 1)


@torch.no_grad()
def steep_enough(seen: SeenPlaces, normals: Float[Tensor, "vertex 3"]) -> Bool[Tensor, "place"]:
    """Which are seen steeply enough to be compared."""
    normal = torch.nn.functional.normalize(at_corners(normals, seen.corners, seen.weights), dim=-1)
    return (normal * seen.wo).sum(-1) > GRAZING


def shade_places(
    seen: SeenPlaces,
    target: ViewTarget,
    tracer: AbstractTracer,
    surface: Float[Tensor, "vertex 8"],
    light: MeshLight,
    generator: torch.Generator,
) -> Float[Tensor, "place 3"]:
    """An estimate of the colours in display space, by split sum with one traced mirror ray each. Two of them are what crossed_halves and
    crossed_squares compare.

    Args:
        tracer: its mesh has the materials that mirrors see. surface: of packed_surface. light: its tables may want a gradient.
    """
    known = MeshLight(light.tables.detach(), light.open_share, light.light_from_world)
    with torch.no_grad():
        transmittance, met = mirrored_light(tracer, seen.face, seen.weights.detach(), seen.wo, known, generator)
    photo = target.saturation.reshape(-1, 3)[seen.pixels]
    corners, weights = seen.corners, seen.weights
    if weights.requires_grad:
        # The kernel has no slope by weights: it gets what lies at each place, as that place's own vertex.
        surface, open_share = at_corners(surface, corners, weights), at_corners(light.open_share, corners, weights)
        light = MeshLight(light.tables, open_share, light.light_from_world)
        corners = torch.arange(len(weights), device=weights.device)[:, None].expand(-1, 3).contiguous()
        weights = torch.eye(3, device=weights.device)[0].expand(len(corners), 3).contiguous()
    return surface_color(corners, weights, seen.wo, transmittance, met, photo, target.ceiling, surface, light)
