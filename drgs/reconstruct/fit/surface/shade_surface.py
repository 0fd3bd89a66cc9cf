"""Pixels of a photograph on the mesh, and how split sum shades them: what the fits of the surface compare.

In: the tracer of a mesh, normals and materials of its vertices, the filtered light. Out: the places that pixels see, and their colours in
display space, differentiable in all but the places.
"""

from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import torch
import warp as wp
from jaxtyping import Bool, Float, Int
from torch import Tensor

from drgs.reconstruct.fit.light.mesh_light import LightOf, MeshLight, at_corners, corner_weights, mirrored_light
from drgs.reconstruct.fit.light.mesh_light_kernels import normal_at, vector_at
from drgs.reconstruct.fit.surface.surface_color import surface_color
from drgs.reconstruct.fit.view_targets import ViewTarget
from drgs.render.integrate.random_warp import hash32, hash_combine, unit_float
from drgs.render.intersect.trace_rays import trace_rays
from drgs.render.intersect.tracer import AbstractTracer, KernelQuery
from drgs.render.records import Hits
from drgs.scene.camera import world_from_pixel
from drgs.warp_torch import launch, warp_argument, warp_device

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

    def halves(self) -> tuple["SeenPlaces", "SeenPlaces"]:
        """Of what seen_twice gives: the first places of the pixels, and the second ones."""
        middle = len(self.pixels) // 2
        first, second = (SeenPlaces(*(values[some] for values in vars(self).values())) for some in (slice(middle), slice(middle, None)))
        return first, second

    @property
    def nearest(self) -> Int[Tensor, "place"]:
        """Vertex at the nearest corner."""
        return self.corners.gather(1, self.weights.argmax(1, keepdim=True)).squeeze(1)


def joined(several: list[SeenPlaces]) -> SeenPlaces:
    """One after the other."""
    return SeenPlaces(*(torch.cat(values) for values in zip(*(vars(places).values() for places in several), strict=True)))


@torch.no_grad()
def seen_places(target: ViewTarget, pixels: Int[Tensor, "pixel"], tracer: AbstractTracer) -> SeenPlaces:
    """Those of `pixels` (flat) that see the mesh, by their middles."""
    direction = _directions(target, pixels, torch.full((len(pixels), 2), 0.5, device=pixels.device))
    hits = trace_rays(target.camera.center_world.expand_as(direction), direction, tracer)
    return _places_of(hits.hit, pixels, direction, hits, tracer)


@torch.no_grad()
def seen_twice(
    target: ViewTarget,
    pixels: Int[Tensor, "pixel"],
    tracer: AbstractTracer,
    generator: torch.Generator,
    normals: Float[Tensor, "vertex 3"] | None = None,
) -> SeenPlaces:
    """Of those of `pixels` (flat) that see the mesh two times, each time by a place of the pixel drawn anew: first places of all of them, then second ones.

    Together, for what is done with them is done once: half as many operations, which threads must take turns to begin.

    Why: a pixel shows its mean. With one place for both estimates, what differs within a pixel is noise that both share, and crossed_halves
    takes it for error: what is finer than a pixel would be flattened.

    Args:
        generator: one number is drawn from it. normals: only what is steep_enough by them, both times; None: all.
    """
    count, camera, device = len(pixels), target.camera, pixels.device
    seed = int(torch.randint(1 << 31, (1,), generator=generator))
    pixels = pixels.contiguous()
    wo, weights = torch.empty(2, count, 3, device=device), torch.empty(2, count, 3, device=device)
    face = torch.empty(2, count, dtype=torch.int64, device=device)
    seen = torch.empty(count, dtype=torch.bool, device=device)
    normals = wo.new_empty(0, 3) if normals is None else normals.contiguous()
    mesh = tracer.mesh
    inputs = [
        tracer.handle, seed, warp_argument(pixels), camera.width, wp.mat33(*world_from_pixel(camera).flatten().tolist()),
        wp.vec3(*camera.center_world.tolist()), warp_argument(mesh.faces), warp_argument(normals, wp.vec3), GRAZING,
    ]  # fmt: skip
    outputs = [warp_argument(seen), warp_argument(wo, wp.vec3), warp_argument(weights, wp.vec3), warp_argument(face)]
    launch(seen_twice_kernel(tracer.kernel_query), count, inputs, outputs, warp_device(pixels))
    at = seen.nonzero().squeeze(1)
    twice = torch.cat([at, at + count])
    faces = face.view(-1).index_select(0, twice)
    corners = mesh.faces.index_select(0, faces).long()
    chosen = pixels.index_select(0, at)
    wo, weights = (values.view(-1, 3).index_select(0, twice) for values in (wo, weights))
    return SeenPlaces(torch.cat([chosen, chosen]), wo, faces, corners, weights)


@cache
def seen_twice_kernel(query: KernelQuery) -> Any:
    """The kernel of seen_twice, for a kind of tracer."""
    closest_fn, handle_type = query.closest_fn, query.handle_type

    @wp.kernel(enable_backward=False, module="unique")
    def see_twice(
        first: int,
        tracer: handle_type,  # type: ignore[valid-type]  # known when the kernel is made
        seed: wp.uint32,
        pixels: wp.array[wp.int64],
        width: int,
        world_from_pixel: wp.mat33,
        center: wp.vec3,
        faces: wp.array2d[int],
        normals: wp.array[wp.vec3],
        least_cosine: float,
        # outputs
        seen: wp.array[wp.bool],
        wo: wp.array2d[wp.vec3],
        weights: wp.array2d[wp.vec3],
        face: wp.array2d[wp.int64],
    ):
        """One thread a pixel.

        Many arguments because a struct of them would be filled anew, array by array, for each launch.
        """
        i = first + wp.tid()
        pixel = int(pixels[i])
        is_seen = bool(True)
        for k in range(2):
            if is_seen:
                drawn = hash_combine(hash_combine(seed, wp.uint32(i)), wp.uint32(k))
                x = float(pixel % width) + unit_float(drawn)
                y = float(pixel // width) + unit_float(hash32(drawn))
                along = wp.normalize(world_from_pixel * wp.vec3(x, y, 1.0))
                hit = closest_fn(tracer, center, along, wp.inf)
                is_seen = hit.face >= 0
                if is_seen:
                    weight = wp.vec3(1.0 - (hit.barycentric[0] + hit.barycentric[1]), hit.barycentric[0], hit.barycentric[1])
                    if normals.shape[0] > 0:
                        corner = wp.vec3i(faces[hit.face, 0], faces[hit.face, 1], faces[hit.face, 2])
                        is_seen = -wp.dot(normal_at(vector_at(normals, corner, weight)), along) > least_cosine
                    wo[k, i] = -along
                    weights[k, i] = weight
                    face[k, i] = wp.int64(hit.face)
        seen[i] = is_seen

    return see_twice


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
    return _shade(seen, photo_of(seen, target), target.ceiling, tracer, surface, light, generator)


def photo_of(seen: SeenPlaces, target: ViewTarget) -> Float[Tensor, "place 3"]:
    """What the photograph shows there (display values)."""
    return target.saturation.reshape(-1, 3).index_select(0, seen.pixels)


def shade_photographs(
    seen: list[SeenPlaces],
    targets: list[ViewTarget],
    tracer: AbstractTracer,
    surface: Float[Tensor, "vertex 8"],
    light_of: LightOf,
    generator: torch.Generator,
) -> tuple[Float[Tensor, "pixel 3"], Float[Tensor, "pixel 3"], Float[Tensor, "pixel 3"]]:
    """Both estimates of the pixels of several photographs, and what these show there.

    Photographs under one light are shaded at once: of small operations most time is what it takes to begin them.

    Args:
        seen: of seen_twice, for each of `targets`. The rest: of shade_places.
    """
    photos = [photo_of(places, target) for places, target in zip(seen, targets, strict=True)]
    together: dict[tuple[int, float], list[int]] = {}
    lights = [light_of(target) for target in targets]
    for number, (light, target) in enumerate(zip(lights, targets, strict=True)):
        together.setdefault((id(light), target.ceiling), []).append(number)
    shaded: list[Tensor] = [surface] * len(targets)
    for (_, ceiling), numbers in together.items():
        places, shown = joined([seen[number] for number in numbers]), torch.cat([photos[number] for number in numbers])
        colors = _shade(places, shown, ceiling, tracer, surface, lights[numbers[0]], generator)
        for number, one in zip(numbers, colors.split([len(photos[number]) for number in numbers]), strict=True):
            shaded[number] = one
    first, second, photo = ([values.chunk(2)[k] for values in every] for every, k in ((shaded, 0), (shaded, 1), (photos, 0)))
    return torch.cat(first), torch.cat(second), torch.cat(photo)


def _shade(
    seen: SeenPlaces, photo: Tensor, ceiling: float, tracer: AbstractTracer, surface: Tensor, light: MeshLight, generator: torch.Generator
) -> Float[Tensor, "place 3"]:
    known = replace(light, tables=light.tables.detach())
    with torch.no_grad():
        transmittance, met = mirrored_light(tracer, seen.face, seen.weights.detach(), seen.wo, known, generator)
    corners, weights = seen.corners, seen.weights
    if weights.requires_grad:
        # The kernel has no slope by weights: it gets what lies at each place, as that place's own vertex.
        surface, open_share = at_corners(surface, corners, weights), at_corners(light.open_share, corners, weights)
        light = replace(light, open_share=open_share)
        corners = torch.arange(len(weights), device=weights.device)[:, None].expand(-1, 3).contiguous()
        weights = torch.eye(3, device=weights.device)[0].expand(len(corners), 3).contiguous()
    return surface_color(corners, weights, seen.wo, transmittance, met, photo, ceiling, surface, light)
