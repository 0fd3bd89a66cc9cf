"""More estimates of kept light where it is wanted: a round of rays from each of some vertices.

In: the kept light, which vertices are wanted, how many rays there are to spend. Out: kept light with more rounds. Vertices with the fewest
rounds come first, and none gets more than MOST_ROUNDS. Rays are those of the integrators, from white paint at the vertex; round after round
they leave from another of the faces around it, so that the mean sees what the points on these faces see.
"""

from dataclasses import replace
from typing import Any

import torch
import warp as wp
from torch import Tensor

from drgs.render.integrate.integrator import AbstractIntegrator, IntegratorSettings
from drgs.render.integrate.surface_light import SurfaceLight
from drgs.render.intersect.horizon import usable_horizons
from drgs.render.progressive.kept_light.kept_light import A_ROUND, KeptArrays, KeptLight, kept_arrays
from drgs.render.records import RayStarts, ShadingPoints
from drgs.warp_torch import launch, warp_array, warp_device

wp.set_module_options({"enable_backward": False})

MOST_ROUNDS = 16
"""Of a vertex: 256 rays."""
VERTEX_STREAM = 0x51AB
"""Keeps the random numbers of vertices apart from those of pixels."""


@wp.kernel
def add_round(
    first: int,
    vertices: wp.array[wp.int64],
    light: wp.array[wp.vec3],
    indirect: wp.array[wp.vec3],
    variance: wp.array[wp.vec3],
    visibility: wp.array[float],
    # in and out; each vertex occurs once, so plain adds are exact
    kept: KeptArrays,
):
    i = first + wp.tid()
    v = int(vertices[i])
    kept.direct[v] = kept.direct[v] + (light[i] - indirect[i])
    kept.indirect[v] = kept.indirect[v] + indirect[i]
    kept.visibility[v] = kept.visibility[v] + visibility[i]
    kept.variance[v] = kept.variance[v] + variance[i][1]
    kept.rounds[v] = kept.rounds[v] + 1
    kept.indirect_rounds[v] = kept.indirect_rounds[v] + 1


def vertices_to_light(kept: KeptLight, wanted: Tensor, rays: int) -> Tensor:
    """(chosen,) int64: the wanted vertices (vertex,) bool that a round of `rays` rays in all goes to, those with fewest rounds first."""
    here = torch.nonzero(wanted & (kept.indirect_rounds < MOST_ROUNDS)).squeeze(-1)
    most = rays // A_ROUND.total
    return here if len(here) <= most else here[torch.argsort(kept.indirect_rounds[here], stable=True)[:most]]


def gather_light(
    kept: KeptLight,
    vertices: Tensor,
    integrator: AbstractIntegrator,
    light: Any,
    how: IntegratorSettings,
    known: SurfaceLight | None = None,
) -> KeptLight:
    """The same with one more round at chosen vertices (chosen,) int64, no vertex twice.

    Args:
        light: EnvironmentLight struct. how: of the picture; its bounces and seed are used. known: what surfaces send that rays meet.
    """
    if len(vertices) == 0:
        return kept
    tracer, mesh = integrator.tracer, integrator.tracer.mesh
    rounds, first = kept.rounds[vertices], kept.around.first[vertices]
    degree = kept.around.first[vertices + 1] - first
    face = kept.around.face[(first + rounds % degree).long()]
    position, normal, face_normal = mesh.vertices[vertices], mesh.normals[vertices], tracer.face_normals[face.long()]
    one = torch.ones(len(vertices), device=position.device)
    points = ShadingPoints(position, normal, normal, one[:, None].expand(-1, 3), one, torch.zeros_like(one), vertices.int())
    starts = RayStarts(position + tracer.lift * face_normal, face_normal, face)
    white = IntegratorSettings(A_ROUND, how.bounces, how.seed ^ VERTEX_STREAM, split_indirect=True)
    # Whatever share of the sky the picture takes for open without asking, what is kept outlives that setting.
    found = integrator.shade(points, starts, light, white, rounds, None, usable_horizons(tracer.horizons), known)
    assert found.indirect_diffuse is not None
    copies: dict[str, Any] = {name: values.clone() for name, values in vars(kept).items() if isinstance(values, Tensor)}
    more = replace(kept, **copies)
    inputs = [warp_array(vertices), *(warp_array(x, wp.vec3) for x in (found.diffuse, found.indirect_diffuse, found.variance))]
    launch(add_round, len(vertices), [*inputs, warp_array(found.visibility)], [kept_arrays(more)], warp_device(position))
    return more
