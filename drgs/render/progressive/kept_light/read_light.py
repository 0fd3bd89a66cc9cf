"""Kept light at points of the mesh, and where it is good enough to be read.

In: points with their faces, the kept light. Out: for each point whether it is read there, and what it says; and the vertices that somebody
would like to know more about. A point is left to rays

- for ever where less than LEAST_DIFFUSE of what the surface reflects is diffuse, where its face is wider than LARGEST_FACE pixels (what lies between the corners of a
  wide face they cannot tell), or bends more than FLAT between face and vertex normals (light from below a face's plane is blocked for the
  points on it, not for its corners);
- for now where a corner has no estimate of both parts, where the standard error of what would be read is above LARGEST_ERROR, or where
  corners differ by more than STEEPEST and noise explains: the edge of a shadow, which rays show sharply.

Twin: drgs/reference/kept_light.py.
"""

from dataclasses import dataclass
from typing import Any

import torch
import warp as wp
from jaxtyping import Bool, Float, Int
from torch import Tensor

from drgs.maths.constants import F0
from drgs.render.color_warp import luminance_of
from drgs.render.integrate import plan
from drgs.render.integrate.sample_arrays import PointArrays, point_arrays
from drgs.render.intersect.mesh_surface import MeshArrays, mesh_arrays
from drgs.render.intersect.tracer import AbstractTracer
from drgs.render.progressive.kept_light.kept_light import A_ROUND, KeptArrays, KeptLight, kept_arrays
from drgs.render.records import PrimaryPoints
from drgs.warp_torch import launch, warp_array, warp_device

wp.set_module_options({"enable_backward": False})

LEAST_DIFFUSE = wp.constant(plan.LEAST_DIFFUSE)
LARGEST_FACE = wp.constant(6.0)
"""Longest side [pixels]."""
FLAT = wp.constant(0.95)
"""Cosine between a face's normal and its corners': planes so far apart differ by (1 - FLAT) / 2 = 2.5 % of an even sky."""
LARGEST_ERROR = wp.constant(0.2)
"""Standard error as a share of the light; estimated from the scatter of samples, of which stratified ones have less: 20 rays a pixel have it."""
STEEPEST = wp.constant(0.25)
"""Of the corners' mean: what is read lies between the corners, so it is off by no more."""
RAYS_A_ROUND = wp.constant(A_ROUND.total)
NOISE = wp.constant(2.0)
"""Standard errors that corners may differ by besides."""

TRACED, WANTED, READ = (wp.constant(k) for k in range(3))
"""Of a point: left to rays for ever, for now, or not."""


@dataclass(frozen=True, eq=False)
class LightThere:
    """Kept light at points."""

    verdict: Int[Tensor, "point"]
    """int32: TRACED, WANTED or READ; where it is not READ the other maps mean nothing."""
    light: Float[Tensor, "point 3"]
    """Irradiance / pi."""
    variance: Float[Tensor, "point"]
    """Of its luminance."""
    visibility: Float[Tensor, "point"]
    """Open share of the cosine-weighted sky."""
    samples: Float[Tensor, "point"]
    """Rays of the corner that has fewest; 0 where it is not READ."""
    wanted: Bool[Tensor, "vertex"]
    """Corners of points that are read, or would be if more were known."""


@wp.struct
class ThereArrays:
    """LightThere as kernels write it."""

    verdict: wp.array[int]
    light: wp.array[wp.vec3]
    variance: wp.array[float]
    visibility: wp.array[float]
    samples: wp.array[float]
    wanted: wp.array[wp.bool]
    """Threads may write the same True to one vertex."""


@wp.func
def light_of_vertex(kept: KeptArrays, vertex: int) -> wp.vec3:
    direct = kept.direct[vertex] / float(wp.max(kept.rounds[vertex], 1))
    return direct + kept.indirect[vertex] / float(wp.max(kept.indirect_rounds[vertex], 1))


@wp.func
def variance_of_vertex(kept: KeptArrays, vertex: int) -> float:
    """Of the luminance of its mean; the indirect part is taken to scatter as much for its size as the whole does."""
    rounds = float(wp.max(kept.rounds[vertex], 1))
    further = float(wp.max(kept.indirect_rounds[vertex], 1))
    direct = luminance_of(kept.direct[vertex]) / rounds
    indirect = luminance_of(kept.indirect[vertex]) / further
    share = indirect / wp.max(direct + indirect, 1.0e-20)
    return kept.variance[vertex] / rounds * ((1.0 - share) / rounds + share / further)


@wp.func
def is_fit(mesh: MeshArrays, a: int, b: int, c: int, widest: float) -> bool:
    """Whether a face's corners can speak for it. `widest`: longest side [world units]."""
    ab = mesh.vertices[b] - mesh.vertices[a]
    ac = mesh.vertices[c] - mesh.vertices[a]
    n = wp.normalize(wp.cross(ab, ac))
    longest = wp.max(wp.length(ab), wp.max(wp.length(ac), wp.length(ac - ab)))
    flattest = wp.min(wp.dot(n, mesh.normals[a]), wp.min(wp.dot(n, mesh.normals[b]), wp.dot(n, mesh.normals[c])))
    return longest <= widest and flattest >= FLAT


@wp.kernel
def read_points(
    first: int,
    points: PointArrays,
    face: wp.array[int],
    barycentric: wp.array[wp.vec2],
    depth: wp.array[float],
    mesh: MeshArrays,
    kept: KeptArrays,
    footprint: float,
    # outputs
    there: ThereArrays,
):
    i = first + wp.tid()
    there.verdict[i] = TRACED
    there.samples[i] = 0.0
    metallic = points.metallic[i]
    base = wp.max(points.albedo[i])
    diffuse = (1.0 - metallic) * base
    if diffuse < LEAST_DIFFUSE * (diffuse + F0 * (1.0 - metallic) + metallic * base):
        return
    a = mesh.faces[3 * face[i]]
    b = mesh.faces[3 * face[i] + 1]
    c = mesh.faces[3 * face[i] + 2]
    if not is_fit(mesh, a, b, c, LARGEST_FACE * footprint * depth[i]):
        return
    there.verdict[i] = WANTED
    there.wanted[a] = True
    there.wanted[b] = True
    there.wanted[c] = True
    fewest = wp.min(kept.indirect_rounds[a], wp.min(kept.indirect_rounds[b], kept.indirect_rounds[c]))
    if fewest < 1:
        return
    y = barycentric[i][0]
    z = barycentric[i][1]
    x = 1.0 - y - z
    light_a = light_of_vertex(kept, a)
    light_b = light_of_vertex(kept, b)
    light_c = light_of_vertex(kept, c)
    variance_a = variance_of_vertex(kept, a)
    variance_b = variance_of_vertex(kept, b)
    variance_c = variance_of_vertex(kept, c)
    bright_a = luminance_of(light_a)
    bright_b = luminance_of(light_b)
    bright_c = luminance_of(light_c)
    mean = (bright_a + bright_b + bright_c) / 3.0
    span = wp.max(bright_a, wp.max(bright_b, bright_c)) - wp.min(bright_a, wp.min(bright_b, bright_c))
    noise = NOISE * wp.sqrt(wp.max(variance_a, wp.max(variance_b, variance_c)))
    scatter = x * x * variance_a + y * y * variance_b + z * z * variance_c
    if span > STEEPEST * mean + noise or scatter > LARGEST_ERROR * LARGEST_ERROR * mean * mean:
        return
    there.verdict[i] = READ
    there.samples[i] = float(fewest * RAYS_A_ROUND)
    there.light[i] = x * light_a + y * light_b + z * light_c
    there.variance[i] = scatter
    open_a = kept.visibility[a] / float(kept.rounds[a])
    open_b = kept.visibility[b] / float(kept.rounds[b])
    open_c = kept.visibility[c] / float(kept.rounds[c])
    there.visibility[i] = x * open_a + y * open_b + z * open_c


def read_light(kept: KeptLight, primary: PrimaryPoints, tracer: AbstractTracer, footprint: float) -> LightThere:
    """What is kept at points of the tracer's mesh.

    Args:
        primary: of a traced mesh: with faces and barycentric weights.
        footprint: of a pixel at distance 1 [world units].
    """
    assert primary.starts.face is not None and primary.barycentric is not None
    count, device = len(primary.depth), primary.depth.device
    there = LightThere(
        torch.empty(count, dtype=torch.int32, device=device),
        torch.empty(count, 3, device=device),
        torch.empty(count, device=device),
        torch.empty(count, device=device),
        torch.empty(count, device=device),
        torch.zeros(len(kept.rounds), dtype=torch.bool, device=device),
    )
    inputs = [
        point_arrays(primary.points), warp_array(primary.starts.face), warp_array(primary.barycentric, wp.vec2), warp_array(primary.depth),
        mesh_arrays(tracer.mesh, tracer.lift), kept_arrays(kept), footprint,
    ]  # fmt: skip
    launch(read_points, count, inputs, [there_arrays(there)], warp_device(primary.depth))
    return there


def there_arrays(there: LightThere) -> Any:
    """The struct that kernels read and write; shares memory with the tensors."""
    arrays = ThereArrays()
    arrays.verdict, arrays.light, arrays.variance = warp_array(there.verdict), warp_array(there.light, wp.vec3), warp_array(there.variance)
    arrays.visibility, arrays.samples, arrays.wanted = (warp_array(x) for x in (there.visibility, there.samples, there.wanted))
    return arrays
