"""Light on the mesh while its surface is fitted: split sum, with what the object itself blocks and sends back.

In: the mesh with its materials (through its tracer), the filtered environment. Out: of a mirrored ray, whether it escapes and the radiance of
what it meets; of each vertex, the share of the irradiance of an open sky that arrives there, light from the object included. Nothing here
passes a gradient on: what was reflected twice is taken as known. One ray a point, drawn from its lobe: steps average over them.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
import warp as wp
from jaxtyping import Float, Int
from torch import Tensor

from drgs.reconstruct.fit.light.ground_light import GroundLight, no_ground
from drgs.reconstruct.fit.light.mesh_light_kernels import MOST_MIRRORS, arriving_kernel, hit_kernel, mirrored_kernel, rotation_of
from drgs.reconstruct.fit.light.split_sum import factor_table
from drgs.reconstruct.fit.view_targets import ViewTarget
from drgs.render.integrate.environment_table import build_environment_table
from drgs.render.integrate.sample_rays import sample_rays
from drgs.render.intersect.trace_rays import trace_rays
from drgs.render.intersect.tracer import AbstractTracer
from drgs.render.records import SampleCounts, ShadingPoints
from drgs.scene.environment import Environment, environment_radiance
from drgs.scene.mesh import TriangleMesh
from drgs.warp_torch import by_pool, launch, warp_argument, warp_device

SHARE_LIFT = 4.0
"""Of the tracer's lift: rays from vertices must clear all faces around them."""
BRIGHTEST_SHARE = 3.0
"""More than this times the open sky's irradiance is noise."""
SHARED_AT_ONCE = 4096
"""Vertices whose rays are traced together."""
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
    ground: GroundLight | None = None
    """What the object stands on, which rays that pass it by may meet; None: they see the sky."""


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
    mesh: TriangleMesh, face: Int[Tensor, "place"], weights: Float[Tensor, "place 3"], towards: Float[Tensor, "place 3"], light: MeshLight
) -> Float[Tensor, "place 3"]:
    """Radiance that places on the mesh send in the directions `towards`, by split sum; they mirror the sky alone.

    Args:
        face, weights: where, int64 and by corner_weights.
    """
    weights, towards = weights.contiguous(), towards.contiguous()
    radiance = torch.empty_like(towards)
    inputs = [
        warp_argument(face),
        warp_argument(weights, wp.vec3),
        warp_argument(towards, wp.vec3),
        warp_argument(mesh.faces),
        *_sent_arguments(mesh, light),
    ]
    launch(hit_kernel, len(face), inputs, [warp_argument(radiance, wp.vec3)], warp_device(radiance))
    return radiance


def _sent_arguments(mesh: TriangleMesh, light: MeshLight) -> list[Any]:
    """By which kernels know what a place sends, from `normals` to `factors`."""
    vectors = (warp_argument(x, wp.vec3) for x in (mesh.normals, mesh.albedo))
    numbers = (warp_argument(x) for x in (mesh.roughness, mesh.metallic))
    turn, factors = rotation_of(light.light_from_world), factor_table(mesh.vertices.device)
    return [
        *vectors,
        *numbers,
        warp_argument(light.open_share, wp.vec3),
        turn,
        warp_argument(light.tables, wp.vec3),
        warp_argument(factors, wp.vec2),
    ]


def radiance_along(tracer: AbstractTracer, origins: Tensor, directions: Tensor, light: MeshLight) -> tuple[Tensor, Tensor]:
    """(ray,) 1 where nothing is met, and (ray, 3) radiance of what is, 0 elsewhere."""
    hits = trace_rays(origins, directions, tracer)
    radiance = torch.zeros_like(directions)
    met = hits.hit.nonzero().squeeze(1)
    if len(met):
        face, weights = hits.face.index_select(0, met).long(), corner_weights(hits.barycentric.index_select(0, met))
        radiance.index_copy_(0, met, hit_radiance(tracer.mesh, face, weights, -directions.index_select(0, met), light))
    free = ~hits.hit
    if light.ground is not None:
        below, seen = light.ground.along(origins, directions)
        radiance = torch.where((free & below)[:, None], seen, radiance)
        free = free & ~below
    return free.float(), radiance


def light_of_rays(
    tracer: AbstractTracer,
    origins: Float[Tensor, "point 3"],
    up: Float[Tensor, "point 3"],
    directions: Float[Tensor, "point sample 3"],
    weight: Float[Tensor, "point sample"],
    light: MeshLight,
) -> tuple[Float[Tensor, "point sample"], Float[Tensor, "point sample 3"]]:
    """Of several rays a point what radiance_along finds; rays without weight, or not above `up`, count as blocked by something black.

    All at once, by one kernel: most rays meet nothing, and need not be put together and scattered again.
    """
    mesh, ground = tracer.mesh, light.ground or no_ground(origins.device)
    origins, up, directions, weight = (x.contiguous() for x in (origins, up, directions, weight))
    transmittance, met = torch.empty_like(weight), torch.empty_like(directions)
    inputs = [
        tracer.handle, weight.shape[1], warp_argument(origins, wp.vec3), warp_argument(up, wp.vec3),
        warp_argument(directions.view(-1, 3), wp.vec3), warp_argument(weight.view(-1)), warp_argument(mesh.faces),
        *_sent_arguments(mesh, light), *ground.arguments(),
    ]  # fmt: skip
    outputs = [warp_argument(transmittance.view(-1)), warp_argument(met.view(-1, 3), wp.vec3)]
    launch(arriving_kernel(tracer.kernel_query), weight.numel(), inputs, outputs, warp_device(origins))
    return transmittance, met


def mirrored_light(
    tracer: AbstractTracer,
    face: Int[Tensor, "place"],
    weights: Float[Tensor, "place 3"],
    wo: Float[Tensor, "place 3"],
    light: MeshLight,
    generator: torch.Generator,
    mirrors: int = MOST_MIRRORS,
) -> tuple[Float[Tensor, "place"], Float[Tensor, "place 3"]]:
    """Of each place on the mesh: whether a ray mirrored at a half vector drawn from its lobe escapes, and what it meets.

    Args:
        face, weights: where, int64 and by corner_weights. generator: one number is drawn from it.
        mirrors: how often what is met mirrors the object again (MOST_MIRRORS at most); after that it mirrors the sky. Few rays meet anything, so it
            costs little.
    """
    mesh, weights, wo = tracer.mesh, weights.contiguous(), wo.contiguous()
    ground = light.ground or no_ground(wo.device)
    seed = int(torch.randint(1 << 31, (1,), generator=generator))
    transmittance, met = wo.new_empty(len(face)), torch.empty_like(wo)
    inputs = [
        tracer.handle, seed, mirrors, warp_argument(face), warp_argument(weights, wp.vec3), warp_argument(wo, wp.vec3), warp_argument(mesh.faces),
        warp_argument(mesh.vertices, wp.vec3), warp_argument(tracer.face_normals, wp.vec3), tracer.lift, CLEAR_OF_FACE,
        *_sent_arguments(mesh, light), *ground.arguments(),
    ]  # fmt: skip
    outputs = [warp_argument(transmittance), warp_argument(met, wp.vec3)]
    launch(mirrored_kernel(tracer.kernel_query), len(face), inputs, outputs, warp_device(wo))
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
        cosine = (sampled.direction_world * normal[:, None]).sum(-1)
        weight = (sampled.weight * cosine).clamp(min=0)
        transmittance, met = light_of_rays(tracer, sampled.origin_world, normal, sampled.direction_world, weight, light)
        sky = environment_radiance(environment, sampled.direction_world) * weight[..., None]
        arriving = sky * transmittance[..., None] + met * weight[..., None]
        return arriving.sum(1) / sky.sum(1).clamp(min=1e-6)

    parts = by_pool(shares, [*range(0, len(mesh.vertices), SHARED_AT_ONCE), len(mesh.vertices)], mesh.vertices.device)
    return torch.cat([torch.zeros_like(mesh.vertices[:0]), *parts]).clamp(0, BRIGHTEST_SHARE)
