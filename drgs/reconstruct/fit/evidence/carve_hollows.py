"""Hollows that no outline shows: where photographs agree behind the surface and not on it, the surface is moved there.

The mesh begins on the visual hull, which fills what lies between parts of an object; shading cannot empty it, for a bump of the right paint
explains most pictures. But paint looks alike from all sides: at its true depth the views that would see it agree. So each vertex is looked at
in steps along its inward normal. A view sees a place behind the surface if its ray enters the mesh near the vertex and does not leave it
before, and of those only the ones that look most steeply count: into a narrow hollow the others would see its walls, which the mesh does not have yet.
The step where colours differ least is the vertex's wish, if they differ much less there than on the surface. Wishes are averaged with what
the surroundings want, by a sparse linear solve, in which vertices that have no wish hold their place.

Mirrors agree nowhere, so metal and smooth surfaces hold their place: their shape is told by what they mirror (fit_surface). Source: the idea is
space carving's (Kutulakos and Seitz 2000, docs/sources.md: kutulakos2000), with a surface's normals in place of voxels.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from drgs.reconstruct.fit.view_targets import ViewTarget
from drgs.reconstruct.geometry.agree_along_edges import agree_along_edges
from drgs.reconstruct.geometry.average_around import averaged, averaging_matrix
from drgs.reconstruct.geometry.mesh_edges import MeshEdges
from drgs.reconstruct.geometry.thickness import thickness
from drgs.render.intersect.trace_rays import trace_rays
from drgs.render.intersect.tracer import AbstractTracer
from drgs.scene.mesh import vertex_normals
from drgs.warp_torch import by_pool

FACING = 0.2
"""Least cosine between the outward normal and the direction to the eye."""
INSIDE = 0.9
"""Least coverage of a place in the photograph."""
TRIMMED = 2 / 3
"""Share of the views whose difference counts."""
THROUGH = 0.7
"""Share of the object's thickness that may be carved at once: more could tear a hole."""
LEFT = 0.03
"""Of the radius: what must be left of the thickness. Where plain paint does not say how deep it is, carvings would go on to the other side."""
NEARBY = 0.02
"""Of the radius: how far beyond three depths from the vertex a ray may enter."""


@dataclass(frozen=True)
class CarveSettings:
    """How far is looked, and what counts as agreement."""

    step: float = 0.01
    """Of the object's radius."""
    steps: int = 20
    smoothest: float = 0.3
    """Roughness below which a surface may be a mirror."""
    most_metallic: float = 0.3
    most_evidence: float = 0.2
    """Of metal, -1..1 (metal_evidence)."""
    better: float = 0.8
    """Share of the difference on the surface that is left at the wish, at most."""
    margin: float = 0.01
    """Least gain of the difference, of display values 0..1."""
    equal: float = 0.1
    """Share of the gain by which a nearer place may be worse than the best."""
    shallowest: int = 3
    """Steps: what lies nearer is for normals and outlines to find."""
    agreeing: float = 0.5
    """Share of a neighbourhood that must have wishes, too."""
    fewest_views: int = 5
    steepest: float = 0.4
    """Share of the views that count, those nearest to the inward direction ..."""
    fewest_steep: int = 6
    """... but so many at least."""
    direction_rings: int = 10
    """Neighbourhoods over which normals are averaged for the direction."""
    cost_rings: int = 4
    """And differences."""
    together: float = 2.0
    """Weight of neighbours' moves being equal, against a wish."""
    hold: float = 1.0
    """Weight of staying in place, against a wish: of those who have none, mirrors among them ..."""
    hold_unsure: float = 0.1
    """... but of paint that views do not agree about, or that too few see."""
    disagreeing: float = 0.035
    """Difference of display values above which views do not agree."""


def carved_depths(
    tracer: AbstractTracer,
    evidence: Float[Tensor, "vertex"],
    targets: list[ViewTarget],
    edges: MeshEdges,
    radius: float,
    settings: CarveSettings,
) -> tuple[Float[Tensor, "vertex 3"], Float[Tensor, "vertex"]]:
    """(vertex, 3) unit inward directions and (vertex,) how far each vertex of the tracer's mesh should move along them [world units].

    Args:
        evidence: of metal_evidence. radius: of the object's bounding sphere [world units].
    """
    mesh = tracer.mesh
    around = averaging_matrix(edges, len(mesh.vertices))
    outward = averaged(around, vertex_normals(mesh.vertices, mesh.faces), settings.direction_rings)
    inward = -torch.nn.functional.normalize(outward, dim=-1)
    matt = (mesh.metallic < settings.most_metallic) & (mesh.roughness > settings.smoothest) & (evidence < settings.most_evidence)
    matt = matt.nonzero().squeeze(1)
    if len(matt) == 0:
        return inward, torch.zeros_like(mesh.roughness)

    def cost_at(step: int) -> Tensor:
        behind = step * settings.step * radius
        difference, views = view_differences(tracer, targets, matt, inward[matt], behind, radius, settings.steepest, settings.fewest_steep)
        known = views >= settings.fewest_views
        sums = torch.zeros(len(mesh.vertices), 2, device=matt.device)
        sums[matt[known]] = torch.stack([difference * views, views], -1)[known]
        total, weight = averaged(around, sums, settings.cost_rings)[matt].unbind(-1)
        return torch.where(weight > 1e-3 * settings.fewest_views, total / weight.clamp(min=1e-9), torch.full_like(total, torch.inf))

    cost = torch.stack(by_pool(lambda step, _: cost_at(step), range(settings.steps + 2), matt.device))
    least = cost.min(0).values
    # Plain paint agrees nearly as well in front of where it is as there, and behind as well: the nearest of equals is chosen.
    near = cost <= least + settings.equal * (cost[0] - least).clamp(min=0)
    at = near.to(torch.uint8).argmax(0)
    wishes = (least < settings.better * cost[0]) & (cost[0] - least > settings.margin) & torch.isfinite(cost[0])
    wishes &= at >= settings.shallowest
    alike = torch.zeros(len(mesh.vertices), 2, device=matt.device)
    alike[matt[wishes]] = torch.stack([torch.ones_like(least), at * settings.step * radius], -1)[wishes]
    share, common = averaged(around, alike, settings.cost_rings)[matt].unbind(-1)
    wishes &= share > settings.agreeing
    through = thickness(tracer, matt, inward[matt])
    common = torch.minimum(common / share.clamp(min=1e-9), torch.minimum(THROUGH * through, (through - LEFT * radius).clamp(min=0)))
    weight, wish = torch.full_like(mesh.roughness, settings.hold), torch.zeros_like(mesh.roughness)
    weight[matt[cost[0] > settings.disagreeing]] = settings.hold_unsure  # also where too few views see them, for then it is endless
    weight[matt[wishes]], wish[matt[wishes]] = 1.0, common[wishes]
    depth = agree_along_edges(edges, weight, wish, settings.together).clamp(min=0)
    return inward, depth


def view_differences(
    tracer: AbstractTracer,
    targets: list[ViewTarget],
    vertices: Tensor,
    inward: Tensor,
    depth: float,
    radius: float,
    steepest: float = 1.0,
    fewest_steep: int = 0,
) -> tuple[Tensor, Tensor]:
    """(n,) mean difference from the median colour among views that would see the places `depth` behind the vertices (n,), and how many those are.

    The third that differs most is left out: highlights.

    Args:
        steepest: share of the views that are asked, those that look most nearly along `inward` (n, 3), but `fewest_steep` at least.
    """
    place = tracer.mesh.vertices[vertices] + depth * inward
    shown = torch.full((len(targets), len(vertices), 3), torch.nan, device=place.device)
    along = torch.full(shown.shape[:2], -1.0, device=place.device)
    for index, target in enumerate(targets):
        camera = target.camera
        offset = place - camera.center_world
        distance = offset.norm(dim=1)
        direction = offset / distance[:, None]
        at = place @ camera.camera_from_world[:3, :3].T + camera.camera_from_world[:3, 3]
        homogeneous = at @ camera.intrinsics.T
        pixel = homogeneous[:, :2] / homogeneous[:, 2:]
        size = torch.tensor([camera.width, camera.height], device=place.device)
        cosine = (direction * inward).sum(1)
        seen = (cosine > FACING) & (at[:, 2] > 0) & (pixel > 1).all(1) & (pixel < size - 1).all(1)
        seen = seen.nonzero().squeeze(1)
        seen = seen[_would_be_seen(tracer, camera.center_world, direction[seen], distance[seen], vertices[seen], depth, radius)]
        grid = (2 * pixel[seen] / size - 1)[None, None]
        picture = torch.cat([target.saturation, target.mask[..., None]], -1).permute(2, 0, 1)[None]
        sampled = torch.nn.functional.grid_sample(picture, grid, mode="bilinear", align_corners=False)[0, :, 0].T
        inside = sampled[:, 3] > INSIDE
        shown[index, seen[inside]], along[index, seen[inside]] = sampled[inside, :3], cosine[seen[inside]]
    asked = (steepest * (along > 0).sum(0)).ceil().clamp(min=fewest_steep)
    rank = along.argsort(0, descending=True).argsort(0)
    shown[rank >= asked] = torch.nan
    difference = (shown - shown.nanmedian(0).values).abs().mean(-1)
    count = (~torch.isnan(difference)).sum(0)
    ordered = difference.nan_to_num(nan=torch.inf).sort(0).values
    kept = torch.arange(len(targets), device=place.device)[:, None] < (TRIMMED * count).ceil()
    total = torch.where(kept, ordered, torch.zeros_like(ordered)).sum(0)
    return total / kept.sum(0).clamp(min=1), count.float()


def _would_be_seen(
    tracer: AbstractTracer, eye: Tensor, direction: Tensor, distance: Tensor, vertices: Tensor, depth: float, radius: float
) -> Tensor:
    """(n,) whether a ray from the eye comes to its place through nothing but what would be carved: matter near the vertex, entered once."""
    first = trace_rays(eye.expand_as(direction), direction, tracer)
    if depth == 0:
        return first.distance > distance - 8 * tracer.lift
    start = first.distance + 4 * tracer.lift
    entry = eye + direction * start.clamp(max=2 * float(distance.max()) if len(distance) else 1.0)[:, None]
    second = trace_rays(entry, direction, tracer)
    stays = ~second.hit | (second.distance + start > distance)
    near = (entry - tracer.mesh.vertices[vertices]).norm(dim=1) < 3 * depth + NEARBY * radius
    return first.hit & (first.distance < distance) & stays & near
