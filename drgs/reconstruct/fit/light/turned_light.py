"""Light that turns with the camera, as on a turntable: of each vertex the share of the open sky's irradiance that arrives, for any turn.

Sampled for one light (mesh_light.irradiance_share), that share would have to be traced anew for each photograph. Here what a vertex sees is
traced once, in the same directions for all: where the sky is seen, and which vertex sends light back elsewhere. For a photograph the
sky is looked up along these directions, turned, softened to the angle between two of them, and summed; what is met sends its diffuse share
of what arrives there. So shadows are as soft as that; under an even sky the share is what irradiance_share finds.

In: the mesh through its tracer. Out: SeenSky; by it and the filtered environment, (vertex, 3) a photograph, with slopes by the normals that are fitted and
by the light: without them a lamp would be asked for what it does not reach.
"""

import math
from dataclasses import dataclass
from functools import cache

import torch
import warp as wp
from jaxtyping import Float, Int, Int16
from torch import Tensor

from drgs.reconstruct.fit.light.ground_light import GroundLight
from drgs.reconstruct.fit.light.mesh_light import BRIGHTEST_SHARE, SHARE_LIFT, LightOf, MeshLight, corner_weights
from drgs.reconstruct.fit.light.split_sum import level_table, texel_directions
from drgs.reconstruct.fit.light.turned_light_kernels import SUM_ROWS, bounce_kernel, direct_kernel, share_adjoint, share_kernel
from drgs.reconstruct.fit.view_targets import ViewTarget
from drgs.render.intersect.trace_rays import trace_rays
from drgs.render.intersect.tracer import AbstractTracer
from drgs.scene.environment import Environment, environment_radiance
from drgs.scene.mesh import vertex_normals
from drgs.warp_torch import launch, launch_adding, warp_argument, warp_device

BOUNCES = 2
TRACED_AT_ONCE = 1 << 19
"""Rays: each vertex has one for half of the directions."""


@dataclass(frozen=True)
class Fineness:
    """Of what is seen of the sky."""

    directions: int
    """Over the sphere."""
    lobe: int
    """Of LEVELS: the table whose lobe is about as wide as the angle from one to the next."""


COARSE = Fineness(192, 2)
"""15 degrees. For what things send each other, and for coarse shapes."""
FINE = Fineness(768, 1)
"""7 degrees. For shadows by which normals are found."""


@dataclass(frozen=True, eq=False)
class HiddenSky:
    """Where each vertex meets something instead of the sky."""

    fineness: Fineness
    directions: Float[Tensor, "direction 3"]
    """Unit, world: even_directions."""
    normals: Float[Tensor, "vertex 3"]
    """Of the faces around each: below their horizon nothing is looked for."""
    first_met: Int[Tensor, "vertex_and_end"]
    """Where in what follows, which is in the order of vertices, that of each vertex begins."""
    met_direction: Int16[Tensor, "met"]
    """In which something is met."""


@dataclass(frozen=True, eq=False)
class SeenSky:
    """What each vertex sees of the sky, and what sends light back to it."""

    hidden: HiddenSky
    """As fine as shadows are to be."""
    coarse: HiddenSky
    """COARSE, for what things send each other is softer than shadows; the same where shadows are as coarse."""
    met_cosine: Float[Tensor, "met"]
    """Of what `coarse` meets, at the vertex that meets it."""
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
def seen_sky(tracer: AbstractTracer, fineness: Fineness = COARSE) -> SeenSky:
    """Of the tracer's mesh, by the normals of its faces: fitted ones change with each step, and a fit that is resumed must see the same."""
    coarse, met_cosine, sender = _hidden_sky(tracer, COARSE)
    return SeenSky(coarse if fineness == COARSE else _hidden_sky(tracer, fineness)[0], coarse, met_cosine, sender)


def _hidden_sky(tracer: AbstractTracer, fineness: Fineness) -> tuple[HiddenSky, Tensor, Tensor]:
    """With the cosines and senders of what is met."""
    mesh = tracer.mesh
    normals = vertex_normals(mesh.vertices, mesh.faces)
    directions = even_directions(fineness.directions).to(normals)
    counts, directions_met, cosines_met, senders = [], [], [], []
    for some in torch.arange(len(normals), device=normals.device).split(2 * TRACED_AT_ONCE // fineness.directions):
        cosines = normals[some] @ directions.T
        at, direction = (cosines > 0).nonzero().unbind(1)
        vertex = some[at]
        hits = trace_rays(mesh.vertices[vertex] + SHARE_LIFT * tracer.lift * normals[vertex], directions[direction], tracer)
        met = hits.hit.nonzero().squeeze(1)
        nearest = corner_weights(hits.barycentric[met]).argmax(1, keepdim=True)
        counts.append(torch.bincount(at[met], minlength=len(some)))
        directions_met.append(direction[met].to(torch.int16))
        cosines_met.append(cosines[at[met], direction[met]])
        senders.append(mesh.faces[hits.face[met].long()].gather(1, nearest).squeeze(1).to(torch.int32))
    first_met = torch.cat([counts[0][:1] * 0, torch.cat(counts).cumsum(0)]).to(torch.int32)
    return HiddenSky(fineness, directions, normals, first_met, torch.cat(directions_met)), torch.cat(cosines_met), torch.cat(senders)


@cache
def _cosines_about(count: int, device: torch.device) -> Float[Tensor, "texel {count}"]:
    """Of even_directions to the normals of a table of SUM_ROWS."""
    about = texel_directions(SUM_ROWS).view(-1, 3)
    return (about @ even_directions(count).T).clamp(min=0).to(device)


def arriving_share(
    sky: SeenSky,
    albedo: Float[Tensor, "vertex 3"],
    tables: Float[Tensor, "texel 3"],
    light_from_world: Float[Tensor, "3 3"],
    normals: Float[Tensor, "vertex 3"] | None = None,
) -> Float[Tensor, "vertex 3"]:
    """(vertex, 3) of the open sky's irradiance under the light turned so; differentiable in `tables` and `normals`, but for what is sent back.

    Args:
        albedo: (vertex, 3) base colour of what sends light back; of metal it stands for what it mirrors. tables: of filter_environment.
        normals: (vertex, 3) unit, which way the surface faces where that is fitted; None: as its faces do.
    """
    hidden, coarse = sky.hidden, sky.coarse
    radiance, sums = _summed(hidden, tables, light_from_world)
    softer = (radiance.detach(), sums.detach()) if coarse is hidden else _summed(coarse, tables.detach(), light_from_world)
    sent_back = _sent_back(sky, albedo, *softer) * (len(hidden.directions) / len(coarse.directions))
    return _Share.apply(hidden.normals if normals is None else normals, radiance, sums, hidden, sent_back)


def _summed(sky: HiddenSky, tables: Tensor, light_from_world: Tensor) -> tuple[Float[Tensor, "direction 3"], Float[Tensor, "texel 3"]]:
    """What the sky sends along the directions, and by a table of normals what it sends in all, summed over them. What hides nothing has all of the sky,
    whichever way it faces: so what is hidden is held against a sum over the same directions."""
    softened = Environment(level_table(tables, sky.fineness.lobe))
    radiance = environment_radiance(softened, sky.directions @ light_from_world.T).contiguous()
    return radiance, _cosines_about(len(radiance), radiance.device) @ radiance


@torch.no_grad()
def _sent_back(sky: SeenSky, albedo: Tensor, radiance: Tensor, sums: Tensor) -> Float[Tensor, "vertex 3"]:
    """What arrives from what is met, summed over the coarse directions, where the surface faces as its faces do.

    Args:
        radiance, sums: of _summed along those.
    """
    coarse = sky.coarse
    albedo, direct = albedo.contiguous(), torch.empty_like(coarse.normals)
    count, device, output = len(direct), warp_device(direct), warp_argument(direct, wp.vec3)
    met = [warp_argument(coarse.first_met), warp_argument(coarse.met_direction), warp_argument(sky.met_cosine)]
    launch(direct_kernel, count, [*met, *(warp_argument(x, wp.vec3) for x in (radiance, coarse.normals, sums))], [output], device)
    sent_back = torch.zeros_like(direct)
    for _ in range(BOUNCES):
        # A direction stands for 4 pi over their number; irradiance over pi times albedo is what is sent.
        sent, sent_back = albedo * (direct + sent_back) * (4 / len(radiance)), torch.empty_like(direct)
        sending = [met[0], met[2], warp_argument(sky.sender), warp_argument(sent, wp.vec3)]
        launch(bounce_kernel, count, sending, [warp_argument(sent_back, wp.vec3)], device)
    return sent_back


class _Share(torch.autograd.Function):
    @staticmethod
    def forward(ctx, normals, radiance, sums, sky, sent_back):
        given = tuple(x.detach().contiguous() for x in (radiance, sent_back, normals, sums))
        ctx.sky = sky
        share, hidden = torch.empty_like(given[1]), torch.empty_like(given[1])
        outputs = [warp_argument(x, wp.vec3) for x in (share, hidden)]
        launch(share_kernel, len(share), _share_arguments(sky, *given), outputs, warp_device(share))
        ctx.save_for_backward(*given, hidden)
        return share

    @staticmethod
    def backward(ctx, gradient):
        *given, hidden = ctx.saved_tensors
        radiance, _, normals, sums = given
        gradient, by_normals = gradient.contiguous(), torch.empty_like(normals)
        inputs = [*_share_arguments(ctx.sky, *given), *(warp_argument(x, wp.vec3) for x in (hidden, gradient))]
        outputs, added = [warp_argument(by_normals, wp.vec3)], [(radiance, wp.vec3), (sums, wp.vec3)]
        by_radiance, by_sums = launch_adding(share_adjoint, len(normals), inputs, outputs, added, warp_device(normals))
        return by_normals, by_radiance, by_sums, None, None


def _share_arguments(sky: HiddenSky, *vectors: Tensor) -> list:
    given = (warp_argument(x, wp.vec3) for x in (sky.directions, *vectors))
    return [warp_argument(sky.first_met), warp_argument(sky.met_direction), *given, BRIGHTEST_SHARE]


def light_of_views(
    tables: Float[Tensor, "texel 3"],
    open_share: Float[Tensor, "vertex 3"],
    albedo: Float[Tensor, "vertex 3"],
    sky: SeenSky | None,
    normals: Float[Tensor, "vertex 3"] | None = None,
    ground: GroundLight | None = None,
) -> LightOf:
    """The light around the mesh in each photograph.

    Args:
        open_share: of irradiance_share, where the light stands still. albedo: of the mesh. sky: where it turns with the camera.
        normals: of arriving_share, where it turns; None: the share has no slope. ground: of MeshLight; where the light turns, what arrives by it is not known.
    """
    if sky is None:
        still = MeshLight(tables, open_share, ground=ground)
        return lambda target: still

    def turned(target: ViewTarget) -> MeshLight:
        assert target.light_from_world is not None  # of views whose light turns
        share = arriving_share(sky, albedo, tables.detach() if normals is None else tables, target.light_from_world, normals)
        return MeshLight(tables, share, target.light_from_world, ground)

    return turned
