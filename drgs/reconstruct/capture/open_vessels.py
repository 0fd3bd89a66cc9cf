"""Cups, bowls, pots, boxes: where a wall runs around an opening, the hull is a lid on it, and no small step takes that lid away.

What is seen through an opening is not where the lid is, so there views disagree. For each place that looks so, and that an edge of the hull runs
around, vessels are proposed: the hull without what is farther than a wall's thickness from the rest of it and nearer to the lid than a depth. Of
each, every ray through the lid is asked whether other views see its colour at the place that it meets; that counts what the rim hides, and
needs no pattern. What curved mirrors show seems to be some way behind them, too, so they ask for all of this: a ball of satin metal looks
alike to two thirds of its rays in a vessel that is 0.36 as bad as its surface (a mug's is, too), but no edge runs around its lids, and the mean over
all of their rays falls to 0.68 at best where that of vessels falls to 0.53 and less.

How deep a smooth inside is, few rays tell: of depths that explain about as much the deepest is taken, whose floor is as thick as its wall.

In: Views with masks, their hull. Out: a closed surface inside the hull, or that hull where nothing is a vessel.
"""

from dataclasses import dataclass, field
from functools import cached_property

import igl
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy import ndimage
from skimage.measure import marching_cubes
from torch import Tensor

from drgs.reconstruct.capture.find_pit import Pit, PitSettings, find_pit
from drgs.reconstruct.capture.hull_rays import (
    TRIMMED,
    SolidRays,
    bounds_of,
    large_patches,
    object_targets,
    patches,
    seen_from_elsewhere,
    surface_of,
    surface_of_hull,
    unlikeness,
)
from drgs.reconstruct.capture.visual_hull import VisualHull
from drgs.reconstruct.fit.view_targets import ViewTarget
from drgs.reconstruct.geometry.average_around import averaged, averaging_matrix
from drgs.reconstruct.geometry.mesh_edges import mesh_edges
from drgs.render.intersect.trace_rays import trace_rays
from drgs.render.intersect.tracer import AbstractTracer
from drgs.scene.views import Views

EXACT_NODES = 3.0
"""Nodes from the hull up to which distances are exact; beyond, only their sign is asked."""
SPARE = 3
"""Nodes around the hull's box."""
NARROW_SHARE = 0.15
"""Of a vessel's largest inscribed ball: where smaller ones alone fit, it is full."""


@dataclass(frozen=True)
class VesselSettings:
    """What is proposed, and what is believed. Lengths are shares of half of the hull's longest side."""

    walls: tuple[float, ...] = (0.03, 0.05, 0.08, 0.12, 0.18, 0.25)
    """Thicknesses. Without any, nothing is looked for."""
    depths: tuple[float, ...] = (0.2, 0.35, 0.5, 0.75, 1.0, 1.3, 1.6, 2.0)
    """Of floors behind the lid."""
    first_depths: tuple[float, ...] = (0.35, 0.75, 1.3)
    """Of `depths`, those tried with each wall; a lid goes on only where one vessel leaves less than ..."""
    promising: float = 0.75
    """... this share of the lid's difference."""
    better: float = 0.6
    """Share that a vessel may leave, at most: of the mean over all rays, too."""
    alike: float = 0.06
    """And of brightness, at most."""
    equal: float = 0.05
    """Share by which a deeper vessel may leave more than the best ..."""
    equal_level: float = 0.001
    """... and what it may leave besides (display values): a quarter of a picture's step."""
    unlike: float = 0.01
    """Difference between views (display values) above which the hull may be a lid."""
    least_lid: float = 0.01
    """Share of the hull's vertices that are so, at least, on one lid."""
    facing: float = 0.85
    """Cosine: so far may a lid's normals be from its direction, averaged around."""
    facing_beyond: float = 0.5
    """A smaller one: where the surface goes on round, many more vertices face so; where an edge runs around the lid, few."""
    bounded: float = 0.7
    """Share of the latter that the former must be: 0.82 and more on what is open, 0.3 to 0.55 on domes."""
    most_lids: int = 8
    nodes: int = 96
    """Along the longest side of the hull."""
    pixels: int = 4500
    """Of the object in the median photograph, after reduction: a ray each."""
    rays: int = 500_000
    """Through the object in all photographs, about, at most."""
    same_place: float = 0.03
    """Side of the cells in which colours of different views are compared."""
    cost_rings: int = 4
    direction_rings: int = 10
    """Neighbourhoods over which differences and normals are averaged."""
    pits: PitSettings = field(default_factory=PitSettings)
    """Of lids that no edge runs around."""


@dataclass(frozen=True, eq=False)
class _Lid:
    vertices: Bool[Tensor, "vertex"]
    """Of the hull."""
    direction: Float[Tensor, "3"]
    """Outward, unit."""


@dataclass(frozen=True)
class _Difference:
    """Between views, in display values, over rays."""

    trimmed: float
    """Mean without the third that differ most, as gloss does."""
    mean: float


@dataclass(frozen=True, eq=False)
class _Vessel:
    left: "_Difference"
    """Of what rays through the lid meet."""
    empty: Float[ndarray, "x y z"]
    """Positive where nothing is."""


def open_vessels(views: Views, hull: VisualHull, settings: VesselSettings, device: torch.device) -> VisualHull:
    """The hull without the insides of its vessels; the very hull where it has none."""
    if not settings.walls:
        return hull
    targets = object_targets(views, min(settings.pixels, settings.rays // len(views.cameras)), device)
    outer = surface_of_hull(hull, device)
    search = _Search(outer, targets, bounds_of(hull, device)[2], settings)
    return search.opened() or hull


class _Search:
    """The hull as a field on a grid, negative inside, of which vessels are taken."""

    def __init__(self, outer: AbstractTracer, targets: list[ViewTarget], radius: float, settings: VesselSettings) -> None:
        self.outer, self.targets, self.radius, self.settings = outer, targets, radius, settings
        mesh = outer.mesh
        self.vertices = mesh.vertices.cpu().double().numpy()
        low, high = self.vertices.min(0), self.vertices.max(0)
        self.cell = float((high - low).max()) / settings.nodes
        self.low = low - SPARE * self.cell
        shape = np.ceil((high - low) / self.cell).astype(int) + 2 * SPARE + 1
        axes = [start + self.cell * np.arange(count) for start, count in zip(self.low, shape, strict=True)]
        self.places = np.stack(np.meshgrid(*axes, indexing="ij"), -1)
        self.around = averaging_matrix(mesh_edges(mesh.faces), len(mesh.vertices))
        self.normals = torch.nn.functional.normalize(averaged(self.around, mesh.normals, settings.cost_rings), dim=1)
        self.field: Float[ndarray, "x y z"] | None = None

    @cached_property
    def looks(self) -> SolidRays:
        """Of all photographs."""
        return SolidRays.of(self.targets, self.outer)

    def opened(self) -> VisualHull | None:
        """None where nothing is a vessel."""
        settings, found = self.settings, False
        unlike = unlikeness(self.outer, self.targets, settings.cost_rings)
        seeds = torch.isfinite(unlike) & (unlike > settings.unlike)
        for _ in range(settings.most_lids):
            seeds = large_patches(seeds, self.outer.mesh.faces, settings.least_lid)
            if not bool(seeds.any()):
                break
            lid, bounded = self._lid(seeds, unlike)
            vessel = self._best_vessel(lid) if bounded else self._pit(lid)
            if vessel is not None:
                self.field, found = np.maximum(self._hull_field(), vessel.empty), True
            seeds = seeds & ~lid.vertices
        if not found:
            return None
        vertices, faces = self._surface(self._hull_field())
        return VisualHull(vertices, faces.astype(np.int64), self.cell)

    def _lid(self, seeds: Bool[Tensor, "vertex"], unlike: Float[Tensor, "vertex"]) -> tuple[_Lid, bool]:
        """Around the place that looks least alike, and whether an edge runs around it."""
        settings, faces = self.settings, self.outer.mesh.faces
        most = averaged(self.around, torch.where(seeds, unlike, torch.zeros_like(unlike))[:, None], settings.direction_rings)[:, 0]
        middle = int(torch.where(seeds, most, torch.zeros_like(most)).argmax())

        def facing(direction: Float[Tensor, "3"], cosine: float) -> Bool[Tensor, "vertex"]:
            patch = patches(self.normals @ direction > cosine, faces)
            return patch == patch[middle]

        direction = self.normals[middle]
        for _ in range(2):
            lid = facing(direction, settings.facing)
            direction = torch.nn.functional.normalize(self.normals[lid & seeds].sum(0), dim=0)
        around = facing(direction, settings.facing_beyond)
        return _Lid(lid, direction), int(lid.sum()) >= settings.bounded * int(around.sum())

    def _best_vessel(self, lid: _Lid) -> _Vessel | None:
        """Behind that lid; None where none is believed."""
        settings, cell = self.settings, self.settings.same_place * self.radius
        looks = self.looks[(lid.vertices[self.outer.mesh.faces.long()].sum(1) >= 2)[self.looks.face]]
        if len(looks) == 0:
            return None
        whole, brightness = _difference(looks, self.outer, cell), float(looks.colors.mean())
        behind = _Behind.of(lid, self)
        tried: dict[tuple[float, float], _Vessel] = {}

        def best_of(walls: tuple[float, ...], depths: tuple[float, ...]) -> tuple[float, float]:
            """The pair that leaves least of all that were tried."""
            for key in ((wall, depth) for wall in walls for depth in depths if depth * self.radius < behind.deepest):
                if key not in tried:
                    empty = behind.empty(key[0] * self.radius, key[1] * self.radius)
                    tried[key] = _Vessel(_difference(looks, self._tracer(np.maximum(self._hull_field(), empty)), cell), empty)
            return min(tried, key=lambda key: tried[key].left.trimmed)

        if not any(depth * self.radius < behind.deepest for depth in settings.first_depths):
            return None
        best = best_of(settings.walls, settings.first_depths)
        if tried[best].left.trimmed > settings.promising * whole.trimmed:
            return None
        best = best_of(best[:1], settings.depths)
        wall = best_of(settings.walls, best[1:])[0]
        least = tried[best_of((wall,), settings.depths)].left
        if not self._believed(least, whole, brightness, settings.better):
            return None
        most = (1 + settings.equal) * least.trimmed + settings.equal_level
        as_good = (key for key in tried if key[0] == wall and tried[key].left.trimmed <= most)
        return tried[max(as_good, key=lambda key: key[1])]

    def _pit(self, lid: _Lid) -> _Vessel | None:
        """Below a large lid, what find_pit finds there; None where it finds nothing, or where that is not believed."""
        settings, cell = self.settings, self.settings.same_place * self.radius
        if int(lid.vertices.sum()) < settings.pits.least_lid * len(lid.vertices):
            return None
        looks = self.looks[(lid.vertices[self.outer.mesh.faces.long()].sum(1) >= 2)[self.looks.face]]
        if len(looks) == 0:
            return None
        pit = find_pit(lid.vertices, lid.direction, looks, self.outer, self.radius, cell, settings.pits)
        if pit is None:
            return None
        left = _difference(looks, self._tracer(np.maximum(self._hull_field(), self._empty(pit))), cell)
        whole, brightness = _difference(looks, self.outer, cell), float(looks.colors.mean())
        if not bool(pit.alike.any()) or not self._believed(left, whole, brightness, settings.pits.better):
            return None
        return _Vessel(left, self._empty(pit.where_alike()))

    def _empty(self, pit: Pit) -> Float[ndarray, "x y z"]:
        """Positive in the pit."""
        holds = pit.holds(self.places, 2 * self.cell)
        return self.cell * np.clip(
            ndimage.distance_transform_edt(holds) - ndimage.distance_transform_edt(~holds), -EXACT_NODES, EXACT_NODES
        )

    def _believed(self, left: _Difference, whole: _Difference, brightness: float, share: float) -> bool:
        better = left.trimmed <= share * whole.trimmed and left.mean <= self.settings.better * whole.mean
        return better and left.trimmed <= self.settings.alike * (brightness + 0.05)

    def _tracer(self, field: Float[ndarray, "x y z"]) -> AbstractTracer:
        """Of where the field is 0."""
        return surface_of(*(torch.from_numpy(part).to(self.outer.mesh.vertices.device) for part in self._surface(field)))

    def distance_to(self, points: Float[ndarray, "point 3"]) -> Float[ndarray, "x y z"]:
        """Of the grid's places to the mean of the points around the node that is nearest of those which have any."""
        shape = self.places.shape[:3]
        node = np.ravel_multi_index(tuple(np.rint((points - self.low) / self.cell).astype(int).T), shape)
        count = np.bincount(node, minlength=int(np.prod(shape)))
        sums = np.stack([np.bincount(node, weights=points[:, axis], minlength=len(count)) for axis in range(3)], -1)
        nearest = ndimage.distance_transform_edt(count.reshape(shape) == 0, return_distances=False, return_indices=True)
        nearest = np.ravel_multi_index(tuple(nearest), shape)
        return np.linalg.norm(self.places - sums[nearest] / count[nearest][..., None], axis=-1)

    def _hull_field(self) -> Float[ndarray, "x y z"]:
        """Signed distance, exact near the surface, less what was taken."""
        if self.field is None:
            faces = self.outer.mesh.faces.cpu().numpy().astype(np.int64)
            inside = igl.fast_winding_number(self.vertices, faces, self.places.reshape(-1, 3)).reshape(self.places.shape[:3]) > 0.5
            near = np.maximum(*(ndimage.distance_transform_edt(part) for part in (inside, ~inside))) < EXACT_NODES
            distance = np.full(inside.shape, EXACT_NODES * self.cell)
            distance[near] = np.sqrt(igl.point_mesh_squared_distance(self.places[near], self.vertices, faces)[0])
            self.field = np.where(inside, -distance, distance)
        return self.field

    def _surface(self, field: Float[ndarray, "x y z"]) -> tuple[Float[ndarray, "vertex 3"], Int[ndarray, "face 3"]]:
        """Where the field is 0."""
        vertices, faces, _, _ = marching_cubes(field, 0.0, spacing=(self.cell,) * 3, gradient_direction="descent", allow_degenerate=False)
        return (vertices + self.low).astype(np.float32), faces.astype(np.int32)


@dataclass(frozen=True, eq=False)
class _Behind:
    """Places of the grid as a lid sees them [world units]."""

    depth: Float[ndarray, "x y z"]
    """Behind the lid's outermost vertex, along its direction."""
    wall: Float[ndarray, "x y z"]
    """Distance to the rest of the hull."""
    below_lid: Bool[ndarray, "x y z"]
    deepest: float
    """Depth of the hull."""
    cell: float
    """Between places."""

    @classmethod
    def of(cls, lid: _Lid, search: _Search) -> "_Behind":
        chosen, direction = lid.vertices.cpu().numpy(), lid.direction.cpu().double().numpy()
        height = search.vertices @ direction
        top = float(height[chosen].max())
        wall, to_lid = search.distance_to(search.vertices[~chosen]), search.distance_to(search.vertices[chosen])
        return cls(top - search.places @ direction, wall, to_lid < 2 * search.cell, float(top - height.min()), search.cell)

    def empty(self, wall: float, depth: float) -> Float[ndarray, "x y z"]:
        """Positive in a vessel of that wall and depth, as far as it can be entered through the lid, and without what is much narrower: a mug's handle is full."""
        empty = np.minimum(self.wall - wall, depth - self.depth)
        narrow = NARROW_SHARE * float(empty.max())
        empty = np.minimum(empty, narrow - self.cell * ndimage.distance_transform_edt(empty <= narrow))
        places, _ = ndimage.label(empty > 0)
        entered = np.unique(places[self.below_lid])
        return np.where(np.isin(places, entered[entered > 0]), empty, np.minimum(empty, 0.0))


def _difference(looks: SolidRays, surface: AbstractTracer, cell: float) -> _Difference:
    """Of a ray's colour from the mean of what other views see where it meets the surface; cells of so many world units are one place."""
    origin, direction = looks.rays.origin, looks.rays.direction
    hits = trace_rays(origin, direction, surface)
    place = origin + torch.where(hits.hit, hits.distance, torch.zeros_like(hits.distance))[:, None] * direction
    mean, seen = seen_from_elsewhere(place, hits.hit, looks.colors, looks.view, cell)
    difference = torch.where(hits.hit, (looks.colors - mean).abs().mean(1), torch.ones_like(mean[:, 0]))
    ordered = difference[seen | ~hits.hit].sort().values
    if len(ordered) == 0:
        return _Difference(1.0, 1.0)
    return _Difference(float(ordered[: max(1, int(TRIMMED * len(ordered)))].mean()), float(ordered.mean()))
