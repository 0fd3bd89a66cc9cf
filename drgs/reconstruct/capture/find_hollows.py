"""What the hull fills, and the photographs show to be empty.

Silhouettes do not show hollows: the hull of things on a plate is a hill. Everything after it moves surfaces by small steps and stays on that hill.
So a coarse radiance field (radiance_grid) is fitted first; it finds the floor between the things, but mistakes mirrors and gloss, which it
sees below their surfaces. Each ray therefore says whether what it sees behind the hull's surface deserves belief: the place looks alike from all
sides, more so than the hull's surface before it, and the ray is stopped there rather than on its way. Where the light turns with the
camera, alike is what that light does not explain (looks_under_turns). Rays vote for the place of the hull that they
pass through; where enough do, depth is the field's, else the hull's, and all depths are fused to one surface. Where something was found all is done once
more behind that: between leaves the first look reaches the next leaf, where it is coarse.

In: Views with masks, their hull. Out: a closed surface inside the hull, or that hull where it is believed everywhere.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import igl
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from drgs.reconstruct.capture.hull_rays import (
    SolidRays,
    bounds_of,
    large_patches,
    object_targets,
    rays_into,
    surface_of,
    surface_of_hull,
    unlikenesses,
)
from drgs.reconstruct.capture.radiance_grid import RadianceGrid, RadianceGridSettings, Rays, fit_radiance_grid
from drgs.reconstruct.capture.visual_hull import VisualHull
from drgs.reconstruct.fit.view_targets import ViewTarget
from drgs.reconstruct.geometry.average_around import averaged, averaging_matrix
from drgs.reconstruct.geometry.extract_mesh import DepthMap, MeshSettings, extract_mesh
from drgs.reconstruct.geometry.mesh_edges import mesh_edges
from drgs.render.intersect.trace_rays import trace_rays
from drgs.render.intersect.tracer import AbstractTracer
from drgs.scene.views import Views
from drgs.warp_torch import by_pool

FIELD_MESH = MeshSettings(resolution=112, smoothing_passes=10, keep_component_fraction=0.02)
"""Without the field's clots of fog; where it has nothing the hull is believed."""
CHOSEN_MESH = MeshSettings(resolution=160, keep_component_fraction=0.002)


@dataclass(frozen=True)
class HollowSettings:
    """What is looked at, and what is believed."""

    grid: RadianceGridSettings = field(default_factory=RadianceGridSettings)
    """Without levels nothing is looked for."""
    pixels: int = 4500
    """Of the object in the median photograph, after reduction: a ray each."""
    field_mesh: MeshSettings = FIELD_MESH
    """Of the field's own surface."""
    chosen_mesh: MeshSettings = CHOSEN_MESH
    """Of the surface of chosen depths."""
    least_depth: float = 0.03
    """Of the radius, behind the hull: what lies nearer, later steps find."""
    alike: float = 0.06
    """Mean difference between views (display values) over brightness, at most: 0.03 refuses paint with a pattern, whose place a coarse field does not find exactly."""
    rounds: int = 2
    """At most."""
    better: float = 0.8
    """Of the hull's difference, at most."""
    stopped: float = 0.7
    """Spread of where the ray is stopped over the depth behind the hull, at most."""
    votes: float = 0.3
    """Share of the rays through a place of the hull that must believe: a quarter do in the median of still_life's whole hull, 0.04 to 0.2 at most anywhere on
    teapot, mic and tankard; patches of up to 0.48 (bunny) and 0.61 (eagle) are wrong, and small."""
    least_patch: float = 0.01
    """Of the hull's vertices: what is smaller is chance. The bunny's patches have 1.1 % together."""
    cost_rings: int = 4
    vote_rings: int = 8
    """Neighbourhoods over which differences and votes are averaged."""


def find_hollows(
    views: Views,
    hull: VisualHull,
    settings: HollowSettings,
    seed: int,
    device: torch.device,
    report: Callable[[float], None] | None = None,
    should_stop: Callable[[], bool] | None = None,
) -> VisualHull | None:
    """The hull without its hollows; the very hull where none are believed; None when should_stop() said so."""
    for number in range(settings.rounds):

        def told(share: float, number: int = number) -> None:
            if report is not None:
                report((number + share) / settings.rounds)

        found = _look_behind(views, hull, settings, seed + number, device, told, should_stop)
        if found is None or found is hull:
            return found
        hull = found
    return hull


def _look_behind(
    views: Views,
    hull: VisualHull,
    settings: HollowSettings,
    seed: int,
    device: torch.device,
    report: Callable[[float], None],
    should_stop: Callable[[], bool] | None,
) -> VisualHull | None:
    """find_hollows, once."""
    targets = object_targets(views, settings.pixels, device)
    low, high, radius = bounds_of(hull, device)
    center = (low + high) / 2
    outer = surface_of_hull(hull, device)
    solid = SolidRays.of(targets, outer)
    if len(solid) == 0:
        return hull
    grid = fit_radiance_grid(solid.rays, solid.colors, (low, high), _inside_of(outer), settings.grid, seed, report, should_stop)
    if grid is None:
        return None
    seen = by_pool(lambda k, _: _Seen.of(targets[k], outer, grid), range(len(targets) + 1), device)
    deep = [DepthMap(view.target.camera, view.deep, view.target.mask) for view in seen]
    try:
        inner = surface_of(*extract_mesh(deep, center, 1.03 * radius, settings.field_mesh))
    except ValueError:  # fog everywhere: nothing that photographs agree about
        return hull
    believed = _believed(seen, targets, outer, inner, radius, settings)
    empty = large_patches(believed > settings.votes, outer.mesh.faces, settings.least_patch)
    if not bool(empty.any()):
        return hull
    maps = [view.chosen(inner, empty) for view in seen]
    try:
        vertices, faces = extract_mesh(maps, center, 1.03 * radius, settings.chosen_mesh)
    except ValueError:  # so much was believed to be empty that nothing is left
        return hull
    cell = 2 * radius / settings.chosen_mesh.resolution
    return VisualHull(vertices.cpu().numpy(), faces.cpu().numpy().astype(np.int64), cell)


def _inside_of(surface: AbstractTracer) -> Callable[[Float[Tensor, "place 3"]], Bool[Tensor, "place"]]:
    vertices, faces = surface.mesh.vertices.cpu().double().numpy(), surface.mesh.faces.cpu().numpy().astype(np.int64)

    def is_inside(places: Float[Tensor, "place 3"]) -> Bool[Tensor, "place"]:
        winding = igl.fast_winding_number(vertices, faces, places.cpu().double().numpy())
        return torch.from_numpy(winding > 0.5).to(places.device)

    return is_inside


@dataclass(frozen=True, eq=False)
class _Seen:
    """What one photograph's rays see; depths along the viewing axis, per pixel, 0 for none."""

    target: ViewTarget
    pixels: Int[Tensor, "ray"]
    """Of rays that meet the hull."""
    rays: Rays
    corners: Int[Tensor, "ray 3"]
    """Of the hull's face that the ray enters by."""
    axial: Float[Tensor, "ray"]
    """Depth over distance."""
    spread: Float[Tensor, "ray"]
    """Of what stops the ray [world units]."""
    deep: Float[Tensor, "height width"]
    """Of the field."""

    @classmethod
    def of(cls, target: ViewTarget, outer: AbstractTracer, grid: RadianceGrid) -> "_Seen":
        rays, pixels, face = rays_into(target, outer, (target.mask.flatten() > 0.5).nonzero().squeeze(1))
        corners = outer.mesh.faces[face].long()
        axial = rays.direction @ target.camera.camera_from_world[2, :3]
        parts = [grid.depths(rays[part]) for part in torch.arange(len(pixels), device=pixels.device).split(4096)]
        median, spread = (torch.cat(part) for part in zip(*parts, strict=True))
        depth = torch.where(torch.isfinite(median), median * axial, torch.zeros_like(median))
        return cls(target, pixels, rays, corners, axial, spread, _placed(target, pixels, depth))

    def behind(self, inner: AbstractTracer) -> tuple[Float[Tensor, "ray"], Int[Tensor, "ray"], Bool[Tensor, "ray"]]:
        """Distance to the inner surface, the face there, and whether there is one."""
        hits = trace_rays(self.rays.origin, self.rays.direction, inner)
        return hits.distance, hits.face.long().clamp(min=0), hits.hit

    def chosen(self, inner: AbstractTracer, empty: Bool[Tensor, "vertex"]) -> DepthMap:
        """Depth of the inner surface where the hull is `empty` (hull's vertex), else of the hull."""
        distance, _, hit = self.behind(inner)
        passes = hit & (empty[self.corners].sum(1) >= 2)
        depth = torch.where(passes, torch.maximum(distance, self.rays.near), self.rays.near) * self.axial
        met = _placed(self.target, self.pixels, torch.ones_like(depth))
        return DepthMap(self.target.camera, _placed(self.target, self.pixels, depth), met)


def _placed(target: ViewTarget, pixels: Int[Tensor, "ray"], values: Float[Tensor, "ray"]) -> Float[Tensor, "height width"]:
    flat = torch.zeros_like(target.mask).flatten()
    flat[pixels] = values
    return flat.reshape(target.mask.shape)


def _believed(
    seen: list[_Seen], targets: list[ViewTarget], outer: AbstractTracer, inner: AbstractTracer, radius: float, settings: HollowSettings
) -> Float[Tensor, "vertex"]:
    """Of the hull's vertices, the share of rays through them that believe what they see behind, averaged around."""
    compared = tuple(zip(*(unlikenesses(surface, targets, settings.cost_rings) for surface in (outer, inner)), strict=True))
    votes = torch.zeros(len(outer.mesh.vertices), 2, device=outer.mesh.vertices.device)
    for view in seen:
        distance, face, hit = view.behind(inner)
        brightness = view.target.saturation.reshape(-1, 3)[view.pixels].mean(1)
        depth = distance - view.rays.near
        alike = torch.zeros_like(hit)
        for outside, behind in compared:
            there, here = behind[inner.mesh.faces[face].long()].mean(1), outside[view.corners].mean(1)
            alike |= (there < settings.alike * (brightness + 0.05)) & (there < settings.better * here)
        believes = hit & alike & (depth > settings.least_depth * radius) & (view.spread < settings.stopped * depth)
        cast = torch.stack([believes.float(), torch.ones_like(depth)], -1)
        for corner in view.corners.unbind(1):
            votes.index_add_(0, corner, cast)
    around = averaging_matrix(mesh_edges(outer.mesh.faces), len(votes))
    believing, counted = averaged(around, votes, settings.vote_rings).unbind(1)
    return believing / counted.clamp(min=1e-6)
