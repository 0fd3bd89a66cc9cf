"""Particles inside a triangle mesh: matter for the simulation, whatever holes, flips and overlaps the mesh has.

In: vertices and faces. Out: jittered lattice points where the generalised winding number exceeds one half, with volumes that add up
to the volume enclosed, and points of the surface as tracers. Knows nothing of materials. Source: docs/sources.md (jacobson2013).
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
import warp as wp
from jaxtyping import Float, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from drgs.deform.matter.measure_thickness import ThinPart, measure_thickness, share_of_area, thin_parts, welded
from drgs.maths.constants import UNBOUNDED
from drgs.warp_torch import launch, warp_array, warp_device

wp.set_module_options({"enable_backward": False})

SURVEY_POINTS = 40_000
"""Lattice points that measure the volume before the spacing is chosen."""
THIN_CELLS = 3.0
"""Parts thinner than this many grid cells bend too easily."""
MOST_LATTICE_POINTS = 40_000_000
TRACER_SHARE = 1e-3
"""Mass and volume of a tracer, as a part of an interior particle's: it follows, and hardly pushes."""
SPACINGS_A_CELL = 2.0
"""Of the lattice in a cell of the simulation's grid."""


@dataclass(frozen=True)
class FillSettings:
    particles: int = 20_000
    """Interior particles aimed at; the spacing follows from the volume."""
    jitter: float = 0.2
    """Largest shift along each axis [spacings]."""
    minimum_depth: float = 0.25
    """Particles keep this far from the surface [spacings]."""
    minimum_component: float = 1e-3
    """Connected parts with less area than this part of the largest are floaters, and not filled."""
    surface: Literal["tracers", "particles", "none"] = "tracers"
    """What becomes of the surface. tracers: one vertex a voxel of the spacing; particles: all vertices, as matter (the paper's)."""
    seed: int = 0


@dataclass(frozen=True, eq=False)
class Particles:
    """Matter at rest; interior points first, then those of the surface."""

    positions: Float[Tensor, "particle 3"]
    """World units."""
    volumes: Float[Tensor, "particle"]
    """World units cubed."""
    spacing: float
    """Of the interior lattice [world units]."""
    interior: int
    """How many of the particles are interior ones."""
    thin_share: float
    """Of the surface's area, where the object is thinner than three grid cells: it bends too easily there."""
    torn_parts: tuple[ThinPart, ...]
    """Where it is thinner than one, the largest first: particles on its two sides hardly feel each other, and it tears."""


@wp.kernel
def measure_depth(
    first: int,
    mesh: wp.uint64,
    points: wp.array[wp.vec3],
    reach: float,
    # outputs
    depth: wp.array[float],
):
    i = first + wp.tid()
    query = wp.mesh_query_point_sign_winding_number(mesh, points[i], reach)
    distance = wp.float32(-UNBOUNDED)
    if query.result:
        nearest = wp.mesh_eval_position(mesh, query.face, query.u, query.v)
        distance = -query.sign * wp.length(nearest - points[i])
    depth[i] = distance


def fill_particles(
    vertices: Float[Tensor, "vertex 3"],
    faces: Int[Tensor, "face 3"],
    settings: FillSettings | None = None,
    go_on: Callable[[], None] | None = None,
) -> Particles:
    """Fill the mesh of vertices (vertex, 3) and faces (face, 3).

    Args:
        go_on: called between steps, of which each may take seconds; what it raises ends the work.

    Raises:
        ValueError: the mesh encloses nothing, or so little of its box that the lattice would not fit in memory.
    """
    settings = settings or FillSettings()
    if settings.particles < 1:
        raise ValueError(f"particles is {settings.particles}; expected at least 1")
    vertices = vertices.detach().float().contiguous()
    solid = _oriented(vertices, _without_floaters(vertices, faces, settings.minimum_component))
    tree = wp.Mesh(warp_array(vertices, wp.vec3), warp_array(solid.reshape(-1)), support_winding_number=True)
    used = vertices[solid.long().unique()]
    low, high = used.amin(0).double().cpu(), used.amax(0).double().cpu()
    if not bool((high > low).all()):
        raise ValueError("cannot fill a mesh that is flat: it encloses no volume")

    survey = float((high - low).prod() / SURVEY_POINTS) ** (1 / 3)
    # One point anywhere in each cell: stratified, so the share of points inside has no bias.
    points = _lattice(low, high, survey, 0.5, settings.seed + 1, vertices.device)
    enclosed = float((depths(tree, points) > 0).double().mean()) * float((high - low).prod())
    if enclosed <= 0:
        raise ValueError("cannot fill this mesh: no point of its box lies inside (is it an open sheet?)")
    spacing = (enclosed / settings.particles) ** (1 / 3)
    if float(((high - low) / spacing + 1).prod()) > MOST_LATTICE_POINTS:
        raise ValueError(
            f"cannot fill this mesh with {settings.particles} particles: it fills only {enclosed / float((high - low).prod()):.1e} of its box"
        )
    if go_on is not None:
        go_on()
    points = _lattice(low, high, spacing, settings.jitter, settings.seed, vertices.device)
    depth = depths(tree, points)
    if go_on is not None:
        go_on()
    inside = depth > settings.minimum_depth * spacing
    if not bool(inside.any()):
        inside = depth > 0
    if not bool(inside.any()):
        inside = depth >= depth.max()
    interior = points[inside]
    each = enclosed / len(interior)
    positions, volumes = [interior], [torch.full((len(interior),), each, device=vertices.device)]
    if settings.surface != "none":
        surface = used if settings.surface == "particles" else used[_one_a_voxel(used, spacing)]
        share = 1.0 if settings.surface == "particles" else TRACER_SHARE
        positions.append(surface)
        volumes.append(torch.full((len(surface),), each * share, device=vertices.device))
        if settings.surface == "particles":  # all share the volume
            volumes = [torch.full_like(v, enclosed / (len(interior) + len(surface))) for v in volumes]
    cell = SPACINGS_A_CELL * spacing
    thickness = measure_thickness(tree, vertices, solid, THIN_CELLS * cell)
    thin = share_of_area(vertices, solid, thickness < THIN_CELLS * cell)
    parts = thin_parts(vertices, solid, thickness, cell)
    return Particles(torch.cat(positions).contiguous(), torch.cat(volumes), spacing, len(interior), thin, parts)


def depths(tree: wp.Mesh, points: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
    """(n,) distance from points (n, 3) to the surface, positive inside; the mesh must have been built for winding numbers."""
    found = torch.empty(len(points), device=points.device)
    launch(measure_depth, len(points), [tree.id, warp_array(points, wp.vec3), UNBOUNDED], [warp_array(found)], warp_device(points))
    return found


def _lattice(
    low: Float[Tensor, "3"], high: Float[Tensor, "3"], spacing: float, jitter: float, seed: int, device: torch.device
) -> Float[Tensor, "n 3"]:
    """Centres of the cells that divide the box evenly, about `spacing` wide, each shifted at random by up to `jitter` cells."""
    axes, widths = [], []
    for axis in range(3):
        extent = float(high[axis] - low[axis])
        count = max(1, round(extent / spacing))
        widths.append(extent / count)
        axes.append(float(low[axis]) + (torch.arange(count, dtype=torch.float64) + 0.5) * widths[-1])
    points = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    random = torch.rand(points.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return (points + (2 * random - 1) * jitter * torch.tensor(widths)).float().contiguous().to(device)


def _without_floaters(vertices: Float[Tensor, "vertex 3"], faces: Int[Tensor, "face 3"], share: float) -> Int[Tensor, "kept_face 3"]:
    """The faces of connected parts with enough area; vertices at one place count as one."""
    where = vertices.double().cpu().numpy()
    corners = faces.long().cpu().numpy()
    linked = welded(vertices)[corners]
    pairs = np.concatenate([linked[:, [0, 1]], linked[:, [1, 2]]])
    count = int(linked.max()) + 1
    graph = coo_matrix((np.ones(len(pairs), np.int8), (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    _, part = connected_components(graph, directed=False)
    a, b, c = (where[corners[:, k]] for k in range(3))
    area = np.bincount(part[linked[:, 0]], np.linalg.norm(np.cross(b - a, c - a), axis=1))
    keep = area[part[linked[:, 0]]] >= share * area.max()
    return faces[torch.from_numpy(keep).to(faces.device)].to(torch.int32).contiguous()


def _oriented(vertices: Float[Tensor, "vertex 3"], faces: Int[Tensor, "face 3"]) -> Int[Tensor, "face 3"]:
    """The faces, all turned over if together they enclose a negative volume."""
    a, b, c = (vertices - vertices.mean(0)).double()[faces.long()].unbind(1)
    signed = (a * torch.linalg.cross(b, c)).sum()
    return faces if float(signed) >= 0 else faces.flip(1).contiguous()


def _one_a_voxel(points: Float[Tensor, "n 3"], size: float) -> Int[Tensor, "voxel"]:
    """Indices of the points that come first in each voxel."""
    voxel = torch.floor((points.double() - points.double().amin(0)) / size).long()
    key = (voxel[:, 0] * (int(voxel[:, 1].max()) + 1) + voxel[:, 1]) * (int(voxel[:, 2].max()) + 1) + voxel[:, 2]
    ordered, order = torch.sort(key, stable=True)
    fresh = torch.ones_like(ordered, dtype=torch.bool)
    fresh[1:] = ordered[1:] != ordered[:-1]
    return order[fresh]
