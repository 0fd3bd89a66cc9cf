"""Light on the mesh while its surface is fitted: split sum, with what the object itself blocks and sends back.

In: the mesh with its materials (through its tracer), the filtered environment. Out: of a mirrored ray, whether it escapes and the radiance of
what it meets; of each vertex, the share of the irradiance of an open sky that arrives there, light from the object included. Nothing here
passes a gradient on: what was reflected twice is taken as known. One ray a point, drawn from its lobe: steps average over them.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from drgs.maths.brdf import f0_from_base
from drgs.maths.frames import tangents_from_normal
from drgs.reconstruct.fit.light.split_sum import shade_split_sum
from drgs.reconstruct.fit.view_targets import ViewTarget
from drgs.render.integrate.environment_table import build_environment_table
from drgs.render.integrate.sample_rays import sample_rays
from drgs.render.intersect.trace_rays import trace_rays
from drgs.render.intersect.tracer import AbstractTracer
from drgs.render.records import SampleCounts, ShadingPoints
from drgs.scene.environment import Environment, environment_radiance
from drgs.scene.mesh import TriangleMesh
from drgs.warp_torch import by_pool

SHARE_LIFT = 4.0
"""Of the tracer's lift: rays from vertices must clear all faces around them."""
BRIGHTEST_SHARE = 3.0
"""More than this times the open sky's irradiance is noise."""
SHARED_AT_ONCE = 4096
"""Vertices whose rays are traced together."""
MIRRORS = 2
"""Times that what a mirrored ray meets mirrors the object again. Few rays meet anything, so it costs little."""
CLEAR_OF_FACE = 1e-3
"""Least cosine of a mirrored ray to its face; rays below it count as free."""


@dataclass(frozen=True, eq=False)
class MeshLight:
    """What light there is around a mesh when it is photographed."""

    tables: Float[Tensor, "texel 3"]
    """Of filter_environment."""
    open_share: Float[Tensor, "vertex 3"]
    """Of the open sky's irradiance that arrives: irradiance_share, or arriving_share where the light turns with the camera."""
    light_from_world: Float[Tensor, "3 3"] | None = None
    """Rotation of directions in the world to those of the tables; None: the same."""


LightOf = Callable[[ViewTarget], MeshLight]
"""Of each photograph; the same for all where the light stands still."""


def at_corners(values: Tensor, corners: Tensor, weights: Tensor) -> Tensor:
    """(point, ...) of vertex values (vertex, ...) at corners (point, 3) by weights (point, 3)."""
    # index_select, whose gradient is one index_add: that of values[corners] takes five times as long on a CPU.
    around = values.index_select(0, corners.reshape(-1)).view(*corners.shape, *values.shape[1:])
    first, second, third = (around * weights.view(*weights.shape, *[1] * (values.ndim - 1))).unbind(1)
    return first + second + third  # a sum over an axis of three takes a CPU four times as long


def corner_weights(barycentric: Tensor) -> Tensor:
    """(point, 3) of the weights (point, 2) of second and third corner."""
    return torch.cat([1 - barycentric.sum(-1, keepdim=True), barycentric], -1)


def hit_radiance(
    mesh: TriangleMesh,
    corners: Tensor,
    weights: Tensor,
    towards: Tensor,
    light: MeshLight,
    mirrored: tuple[Tensor, Tensor] | None = None,
) -> Tensor:
    """(point, 3) radiance that places on the mesh send in the directions `towards` (point, 3), by split sum.

    Args:
        mirrored: of mirrored_light; None: all that is mirrored there is the sky.
    """
    normal = torch.nn.functional.normalize(at_corners(mesh.normals, corners, weights), dim=-1)
    albedo, metallic = at_corners(mesh.albedo, corners, weights), at_corners(mesh.metallic, corners, weights)
    transmittance, met = (None, None) if mirrored is None else mirrored
    return shade_split_sum(
        albedo * (1 - metallic)[:, None],
        torch.zeros_like(albedo),
        f0_from_base(albedo, metallic),
        at_corners(mesh.roughness, corners, weights),
        normal,
        towards,
        light.tables,
        transmittance,
        met,
        open_share=at_corners(light.open_share, corners, weights),
        light_from_world=light.light_from_world,
    ).clamp(min=0)


def radiance_along(
    tracer: AbstractTracer,
    origins: Tensor,
    directions: Tensor,
    light: MeshLight,
    mirrors: int = 0,
    generator: torch.Generator | None = None,
) -> tuple[Tensor, Tensor]:
    """(ray,) 1 where nothing is met, and (ray, 3) radiance of what is, 0 elsewhere.

    Args:
        mirrors: how often what is met mirrors the object again; after that it mirrors the sky. generator: of their directions.
    """
    hits = trace_rays(origins, directions, tracer)
    radiance = torch.zeros_like(directions)
    met = hits.hit.nonzero().squeeze(1)
    if len(met):
        mesh, towards = tracer.mesh, -directions[met]
        face = hits.face[met].long()
        corners, weights = mesh.faces[face].long(), corner_weights(hits.barycentric[met])
        again = None
        if mirrors:
            assert generator is not None
            position, roughness = (at_corners(values, corners, weights) for values in (mesh.vertices, mesh.roughness))
            normal = torch.nn.functional.normalize(at_corners(mesh.normals, corners, weights), dim=-1)
            again = mirrored_light(tracer, position, tracer.face_normals[face], normal, roughness, towards, light, generator, mirrors - 1)
        radiance[met] = hit_radiance(mesh, corners, weights, towards, light, again)
    return (~hits.hit).float(), radiance


def mirrored_light(
    tracer: AbstractTracer,
    position: Tensor,
    face_normal: Tensor,
    normal: Tensor,
    roughness: Tensor,
    wo: Tensor,
    light: MeshLight,
    generator: torch.Generator,
    mirrors: int = MIRRORS,
) -> tuple[Tensor, Tensor]:
    """Of each point (point, 3): whether a ray mirrored at a half vector drawn from its lobe escapes (point,), and what it meets (point, 3).

    Args:
        mirrors: of radiance_along.
    """
    alpha = roughness * roughness
    u = torch.rand(2, len(normal), generator=generator).to(normal.device)
    cosine2 = (1 - u[0]) / (1 + (alpha * alpha - 1) * u[0])
    sine, azimuth = (1 - cosine2).clamp(min=0).sqrt(), 2 * math.pi * u[1]
    t_u, t_v = tangents_from_normal(normal)
    half = t_u * (sine * azimuth.cos())[:, None] + t_v * (sine * azimuth.sin())[:, None] + normal * cosine2.sqrt()[:, None]
    mirrored = 2 * (half * wo).sum(-1, keepdim=True) * half - wo
    transmittance, met = torch.ones_like(roughness), torch.zeros_like(normal)
    above = ((mirrored * face_normal).sum(-1) > CLEAR_OF_FACE).nonzero().squeeze(1)
    origin = position[above] + tracer.lift * face_normal[above]
    transmittance[above], met[above] = radiance_along(tracer, origin, mirrored[above], light, mirrors, generator)
    return transmittance, met


def irradiance_share(tracer: AbstractTracer, environment: Environment, light: MeshLight, rays: int, generator: torch.Generator) -> Tensor:
    """(vertex, 3) share of an open sky's irradiance that arrives, by `rays` directions a vertex.

    Half of them by the cosine, half by the sky's light, so that no vertex misses a lamp or counts one twice (Veach 1995); a ratio of two
    sums over the same directions, so that the sky's part is exact where nothing is met, or everything.

    Args:
        light: that of the environment, with the shares known so far: what was reflected comes once more with each call.
    """
    mesh, table = tracer.mesh, build_environment_table(environment)
    by_light = rays // 2
    counts = SampleCounts(rays - by_light, 0, by_light)
    seed = int(torch.randint(1 << 31, (1,), generator=generator))

    @torch.no_grad()
    def shares(first: int, last: int) -> Tensor:
        some, count = slice(first, last), last - first
        normal = mesh.normals[some]
        one = torch.ones(count, device=normal.device)
        index = torch.arange(first, last, dtype=torch.int32, device=normal.device)
        points = ShadingPoints(mesh.vertices[some], normal, normal, torch.ones_like(normal), one, 0 * one, index)
        sampled = sample_rays(points, table, counts, seed, SHARE_LIFT * tracer.lift)
        direction = sampled.direction_world.reshape(-1, 3)
        origins = sampled.origin_world[:, None].expand_as(sampled.direction_world).reshape(-1, 3)
        cosine = (sampled.direction_world * normal[:, None]).sum(-1)
        weight = (sampled.weight * cosine).clamp(min=0)[..., None]
        transmittance, met = radiance_along(tracer, origins, direction, light)
        sky = environment_radiance(environment, direction).view(count, rays, 3) * weight
        arriving = sky * transmittance.view(count, rays, 1) + met.view(count, rays, 3) * weight
        return arriving.sum(1) / sky.sum(1).clamp(min=1e-6)

    parts = by_pool(shares, [*range(0, len(mesh.vertices), SHARED_AT_ONCE), len(mesh.vertices)], mesh.vertices.device)
    return torch.cat([torch.zeros_like(mesh.vertices[:0]), *parts]).clamp(0, BRIGHTEST_SHARE)
