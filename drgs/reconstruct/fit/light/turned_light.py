"""Light that turns with the camera, as on a turntable: of each vertex the share of the open sky's irradiance that arrives, for any turn.

Sampled for one light (mesh_light.irradiance_share), that share would have to be traced anew for each photograph. Here what a vertex sees is
traced once, in the same directions for all: where the sky is seen, and which vertex sends light back elsewhere. For a photograph the
sky is looked up along these directions, turned, softened to the angle between two of them, and summed; what is met sends its diffuse share
of what arrives there. So shadows are as soft as LOBE; under an even sky the share is what irradiance_share finds.

In: the mesh through its tracer. Out: SeenSky; by it and the filtered environment, (vertex, 3) a photograph. No gradient.
"""

import math
from dataclasses import dataclass

import torch
import warp as wp
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from drgs.reconstruct.fit.light.mesh_light import BRIGHTEST_SHARE, SHARE_LIFT, LightOf, MeshLight, corner_weights
from drgs.reconstruct.fit.light.split_sum import level_table
from drgs.reconstruct.fit.view_targets import ViewTarget
from drgs.render.intersect.trace_rays import trace_rays
from drgs.render.intersect.tracer import AbstractTracer
from drgs.scene.environment import Environment, environment_radiance
from drgs.scene.mesh import vertex_normals
from drgs.warp_torch import launch, warp_argument, warp_device

wp.set_module_options({"enable_backward": False})

DIRECTIONS = 192
"""Over the sphere: 15 degrees from one to the next."""
LOBE = 3
"""Of LEVELS: the table whose lobe is about as wide."""
BOUNCES = 2
TRACED_AT_ONCE = 1 << 19
"""Rays."""


@dataclass(frozen=True, eq=False)
class SeenSky:
    """What each vertex sees of the sky, and what sends light back to it."""

    directions: Float[Tensor, "direction 3"]
    """Unit, world."""
    cosine: Float[Tensor, "direction vertex"]
    """To the vertex's normal; 0 below the horizon. In this order a product with three columns takes half the time."""
    first_met: Int[Tensor, "vertex_and_end"]
    """Where in what follows, which is in the order of vertices, that of each vertex begins."""
    met_direction: UInt8[Tensor, "met"]
    """In which something is met."""
    met_cosine: Float[Tensor, "met"]
    """At the vertex that meets it."""
    sender: Int[Tensor, "met"]
    """Vertex that is met: of a face the nearest corner."""


def even_directions(count: int) -> Float[Tensor, "{count} 3"]:
    """(count, 3) unit, evenly over the sphere: a Fibonacci spiral (Swinbank and Purser 2006)."""
    k = torch.arange(count, dtype=torch.float64)
    z = 1 - (2 * k + 1) / count
    azimuth = k * math.pi * (3 - math.sqrt(5))
    radius = (1 - z * z).sqrt()
    return torch.stack([radius * azimuth.cos(), radius * azimuth.sin(), z], -1).float()


@torch.no_grad()
def seen_sky(tracer: AbstractTracer) -> SeenSky:
    """Of the tracer's mesh, by the normals of its faces: fitted ones change with each step, and a fit that is resumed must see the same."""
    mesh = tracer.mesh
    normals = vertex_normals(mesh.vertices, mesh.faces)
    directions = even_directions(DIRECTIONS).to(normals)
    cosine = (directions @ normals.T).clamp(min=0)
    vertex, direction = (cosine.T > 0).nonzero().unbind(1)
    counts = torch.zeros(len(normals), dtype=torch.int64, device=vertex.device)
    met_direction, met_cosine, sender = [], [], []
    for some in torch.arange(len(vertex), device=vertex.device).split(TRACED_AT_ONCE):
        at = vertex[some]
        origins = mesh.vertices[at] + SHARE_LIFT * tracer.lift * normals[at]
        hits = trace_rays(origins, directions[direction[some]], tracer)
        met = hits.hit.nonzero().squeeze(1)
        nearest = corner_weights(hits.barycentric[met]).argmax(1, keepdim=True)
        counts += torch.bincount(at[met], minlength=len(normals))
        met_direction.append(direction[some[met]].to(torch.uint8))
        met_cosine.append(cosine[direction[some[met]], at[met]])
        sender.append(mesh.faces[hits.face[met].long()].gather(1, nearest).squeeze(1).to(torch.int32))
    first_met = torch.cat([counts[:1] * 0, counts.cumsum(0)]).to(torch.int32)
    return SeenSky(directions, cosine, first_met, *(torch.cat(parts) for parts in (met_direction, met_cosine, sender)))


@wp.kernel
def direct_kernel(
    first: int,
    first_met: wp.array[int],
    met_direction: wp.array[wp.uint8],
    met_cosine: wp.array[float],
    radiance: wp.array[wp.vec3],
    unhidden: wp.array[wp.vec3],
    # outputs
    direct: wp.array[wp.vec3],
):
    """What arrives from the sky: all of it, less what is hidden."""
    i = first + wp.tid()
    hidden = wp.vec3(0.0, 0.0, 0.0)
    for k in range(first_met[i], first_met[i + 1]):
        hidden += met_cosine[k] * radiance[int(met_direction[k])]
    left = unhidden[i] - hidden
    direct[i] = wp.vec3(wp.max(left[0], 0.0), wp.max(left[1], 0.0), wp.max(left[2], 0.0))


@wp.kernel
def bounce_kernel(
    first: int,
    first_met: wp.array[int],
    met_cosine: wp.array[float],
    sender: wp.array[int],
    sent: wp.array[wp.vec3],
    direct: wp.array[wp.vec3],
    # outputs
    arriving: wp.array[wp.vec3],
):
    """What arrives from the sky and from what is met."""
    i = first + wp.tid()
    found = direct[i]
    for k in range(first_met[i], first_met[i + 1]):
        found += met_cosine[k] * sent[sender[k]]
    arriving[i] = found


@torch.no_grad()
def arriving_share(
    sky: SeenSky, albedo: Float[Tensor, "vertex 3"], tables: Float[Tensor, "texel 3"], light_from_world: Float[Tensor, "3 3"]
) -> Float[Tensor, "vertex 3"]:
    """(vertex, 3) of the open sky's irradiance under the light turned so.

    Args:
        albedo: (vertex, 3) base colour of what sends light back; of metal it stands for what it mirrors. tables: of filter_environment.
    """
    softened = Environment(level_table(tables, LOBE))
    radiance = environment_radiance(softened, sky.directions @ light_from_world.T).contiguous()
    unhidden = (radiance.T @ sky.cosine).T.contiguous()
    count, device, direct = len(unhidden), warp_device(unhidden), torch.empty_like(unhidden)
    first_met, met_cosine = warp_argument(sky.first_met), warp_argument(sky.met_cosine)
    *inputs, output = (warp_argument(x, wp.vec3) for x in (radiance, unhidden, direct))
    launch(direct_kernel, count, [first_met, warp_argument(sky.met_direction), met_cosine, *inputs], [output], device)
    arriving = direct
    for _ in range(BOUNCES):
        # A direction stands for 4 pi / DIRECTIONS; irradiance over pi times albedo is what is sent.
        sent, arriving = albedo * arriving * (4 / DIRECTIONS), torch.empty_like(direct)
        sending = [first_met, met_cosine, warp_argument(sky.sender), warp_argument(sent, wp.vec3), output]
        launch(bounce_kernel, count, sending, [warp_argument(arriving, wp.vec3)], device)
    return (arriving / unhidden.clamp(min=1e-6)).clamp(0, BRIGHTEST_SHARE)


def light_of_views(
    tables: Float[Tensor, "texel 3"], open_share: Float[Tensor, "vertex 3"], albedo: Float[Tensor, "vertex 3"], sky: SeenSky | None
) -> LightOf:
    """The light around the mesh in each photograph.

    Args:
        open_share: of irradiance_share, where the light stands still. albedo: of the mesh. sky: where it turns with the camera.
    """
    if sky is None:
        still = MeshLight(tables, open_share)
        return lambda target: still

    def turned(target: ViewTarget) -> MeshLight:
        assert target.light_from_world is not None  # of views whose light turns
        share = arriving_share(sky, albedo, tables.detach(), target.light_from_world)
        return MeshLight(tables, share, target.light_from_world)

    return turned
