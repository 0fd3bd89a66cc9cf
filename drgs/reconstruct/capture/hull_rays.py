"""Photographs of an object and a first surface around it: rays that enter it, and how far views agree about what is on it.

In: Views with masks, their hull. Out: reduced photographs, rays, what they meet, patches of the surface.
"""

import statistics
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from drgs.reconstruct.capture.looks_under_turns import unexplained_looks
from drgs.reconstruct.capture.radiance_grid import Rays
from drgs.reconstruct.capture.visual_hull import VisualHull
from drgs.reconstruct.fit.view_targets import ViewTarget, view_targets
from drgs.reconstruct.geometry.average_around import averaged, averaging_matrix
from drgs.reconstruct.geometry.extract_mesh import MeshSettings, clean_mesh
from drgs.reconstruct.geometry.mesh_edges import mesh_edges
from drgs.render.intersect.trace_rays import build_tracer, trace_rays
from drgs.render.intersect.tracer import AbstractTracer
from drgs.scene.camera import pixel_rays_world
from drgs.scene.mesh import TriangleMesh, vertex_normals
from drgs.scene.views import Views

SOLID = 0.99
"""Least coverage of a pixel whose ray is fitted."""
FEWEST_VIEWS = 3
"""Of a place whose looks are compared."""
FACING = 0.2
"""Least cosine between the outward normal and the direction to the eye, of a look that is compared."""
INSIDE = 0.9
"""Least coverage of a place in the photograph."""
TRIMMED = 2 / 3
"""Share of the looks whose difference counts: highlights differ most."""
HULL_MESH = MeshSettings(face_limit=40_000, keep_component_fraction=0.0)
"""Every part of the hull: what its rays did not meet would count as seen through."""


def object_targets(views: Views, pixels: int, device: torch.device) -> list[ViewTarget]:
    """The photographs, reduced until the object fills so many pixels of the median one."""
    solid = statistics.median_low(int((mask > 127).sum()) for mask in views.coverage)
    return view_targets(views, min(1.0, (pixels / max(solid, 1)) ** 0.5), device)


def bounds_of(hull: VisualHull, device: torch.device) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"], float]:
    """Its box, low and high, and half of the longest side."""
    low, high = (torch.from_numpy(np.asarray(x, np.float32)).to(device) for x in (hull.vertices_world.min(0), hull.vertices_world.max(0)))
    return low, high, float((high - low).max()) / 2


def surface_of_hull(hull: VisualHull, device: torch.device) -> AbstractTracer:
    """What rays into the hull meet, of fewer faces."""
    vertices = torch.from_numpy(hull.vertices_world).to(device)
    return surface_of(
        *clean_mesh(vertices, torch.from_numpy(hull.faces.astype(np.int32)).to(device), HULL_MESH, 1e-5 * bounds_of(hull, device)[2])
    )


def surface_of(vertices: Tensor, faces: Tensor) -> AbstractTracer:
    """What rays meet; its materials are never looked at."""
    plain = torch.zeros(len(vertices), device=vertices.device)
    vertices = vertices.float().contiguous()
    return build_tracer(TriangleMesh(vertices, faces, vertex_normals(vertices, faces), plain[:, None].repeat(1, 3), plain, plain))


def rays_into(
    target: ViewTarget, outer: AbstractTracer, pixels: Int[Tensor, "pixel"]
) -> tuple[Rays, Int[Tensor, "ray"], Int[Tensor, "ray"]]:
    """Those through `pixels` (flat) that meet the hull, with their pixels and the hull's faces that they enter by."""
    origin, directions = pixel_rays_world(target.camera)
    direction = torch.nn.functional.normalize(directions.reshape(-1, 3)[pixels], dim=-1).contiguous()
    start = origin.expand_as(direction).contiguous()
    first = trace_rays(start, direction, outer)
    beyond = 2 * float((outer.mesh.vertices - origin).norm(dim=1).max())
    last = trace_rays(start + beyond * direction, -direction, outer)
    met = first.hit & last.hit
    return Rays(start, direction, first.distance, beyond - last.distance)[met], pixels[met], first.face[met].long()


@dataclass(frozen=True, eq=False)
class SolidRays:
    """Of all photographs: through the pixels that masks fill, where they meet the hull."""

    rays: Rays
    colors: Float[Tensor, "ray 3"]
    """SRGB."""
    view: Int[Tensor, "ray"]
    face: Int[Tensor, "ray"]
    """Of the hull, that the ray enters by."""

    @classmethod
    def of(cls, targets: list[ViewTarget], outer: AbstractTracer) -> "SolidRays":
        parts = []
        for number, target in enumerate(targets):
            rays, pixels, face = rays_into(target, outer, (target.mask.flatten() > SOLID).nonzero().squeeze(1))
            colors = target.saturation.reshape(-1, 3)[pixels]
            parts.append((rays.origin, rays.direction, rays.near, rays.far, colors, torch.full_like(pixels, number), face))
        origin, direction, near, far, colors, view, face = (torch.cat(part) for part in zip(*parts, strict=True))
        return cls(Rays(origin, direction, near, far), colors, view, face)

    def __len__(self) -> int:
        return len(self.view)

    def __getitem__(self, chosen: Bool[Tensor, "ray"]) -> "SolidRays":
        return SolidRays(self.rays[chosen], self.colors[chosen], self.view[chosen], self.face[chosen])


def seen_from_elsewhere(
    places: Float[Tensor, "ray 3"],
    ended: Bool[Tensor, "ray"],
    colors: Float[Tensor, "ray 3"],
    view: Int[Tensor, "ray"],
    cell: float,
) -> tuple[Float[Tensor, "ray 3"], Bool[Tensor, "ray"]]:
    """Mean colour of other views' rays that end in the same cell, and whether there are any.

    Args:
        places: where rays end.
        ended: on something; what did not is no ray that others see.
        cell: side of what counts as one place [world units].
    """
    corner = torch.floor(places / cell).long()
    corner -= corner.amin(0)
    place = (corner[:, 0] * (corner[:, 1].max() + 1) + corner[:, 1]) * (corner[:, 2].max() + 1) + corner[:, 2]
    order = (place * (int(view.max()) + 1) + view).argsort(stable=True)
    place, view = place[order], view[order]
    new_place = torch.cat([place.new_zeros(1, dtype=torch.bool), place[1:] != place[:-1]])
    new_pair = new_place | torch.cat([new_place[:1], view[1:] != view[:-1]])
    place, pair = new_place.cumsum(0), new_pair.cumsum(0)
    counted = (torch.cat([colors, torch.ones_like(colors[:, :1])], 1) * ended[:, None])[order]
    of_view = counted.new_zeros(int(pair[-1]) + 1, 4).index_add_(0, pair, counted)
    of_place = counted.new_zeros(int(place[-1]) + 1, 4).index_add_(0, place, counted)
    others = torch.empty_like(counted)
    others[order] = of_place[place] - of_view[pair]
    return others[:, :3] / others[:, 3:].clamp(min=1), others[:, 3] > 0.5


def patches(chosen: Bool[Tensor, "vertex"], faces: Int[Tensor, "face 3"]) -> Int[Tensor, "vertex"]:
    """A number for each vertex: equal where chosen vertices hang together, one of its own for every other."""
    marks = chosen.cpu().numpy()
    start, end = mesh_edges(faces).vertices.cpu().numpy().T
    joined = marks[start] & marks[end]
    graph = coo_matrix((np.ones(joined.sum()), (start[joined], end[joined])), shape=(len(marks),) * 2)
    return torch.from_numpy(connected_components(graph, directed=False)[1]).long().to(chosen.device)


def large_patches(chosen: Bool[Tensor, "vertex"], faces: Int[Tensor, "face 3"], least: float) -> Bool[Tensor, "vertex"]:
    """Of the chosen vertices, those that hang together with at least the share `least` of all."""
    patch = patches(chosen, faces)
    return chosen & (torch.bincount(patch) >= least * len(chosen))[patch]


def unlikeness(surface: AbstractTracer, targets: list[ViewTarget], rings: int) -> Float[Tensor, "vertex"]:
    """Mean difference (display values) between the views that see a vertex, averaged around; inf where hardly any does.

    Where the light turns with the camera, of what that light does not explain, with as much forgiven as ever is.
    """
    return unlikenesses(surface, targets, rings)[0]


def unlikenesses(surface: AbstractTracer, targets: list[ViewTarget], rings: int) -> list[Float[Tensor, "vertex"]]:
    """`unlikeness`, and where the light turns with the camera the same with less forgiven (looks_under_turns.HELD)."""
    mesh, shown = surface.mesh, _looks(surface, targets)
    turns = [target.light_from_world for target in targets if target.light_from_world is not None]
    compared = unexplained_looks(surface, shown, torch.stack(turns)) if turns else [shown]
    around, found = averaging_matrix(mesh_edges(mesh.faces), len(mesh.vertices)), []
    for looks in compared:
        difference, views = _differences(looks)
        known = torch.where(views >= FEWEST_VIEWS, views, torch.zeros_like(views))
        sums = torch.stack([difference.nan_to_num(0.0) * known, known], -1)
        total, weight = averaged(around, sums, rings).unbind(1)
        found.append(torch.where(weight > 0.1 * FEWEST_VIEWS, total / weight.clamp(min=1e-6), torch.full_like(total, torch.inf)))
    return found


def _looks(surface: AbstractTracer, targets: list[ViewTarget]) -> Float[Tensor, "view vertex 3"]:
    """What each photograph shows at each vertex (display values); nan where it does not see it."""
    place, normals = surface.mesh.vertices, surface.mesh.normals
    shown = torch.full((len(targets), len(place), 3), torch.nan, device=place.device)
    for index, target in enumerate(targets):
        camera = target.camera
        offset = place - camera.center_world
        distance = offset.norm(dim=1)
        direction = offset / distance[:, None]
        in_camera = place @ camera.camera_from_world[:3, :3].T + camera.camera_from_world[:3, 3]
        homogeneous = in_camera @ camera.intrinsics.T
        pixel = homogeneous[:, :2] / homogeneous[:, 2:]
        size = torch.tensor([camera.width, camera.height], device=place.device)
        faces_eye = -(direction * normals).sum(1) > FACING
        seen = (faces_eye & (in_camera[:, 2] > 0) & (pixel > 1).all(1) & (pixel < size - 1).all(1)).nonzero().squeeze(1)
        first = trace_rays(camera.center_world.expand_as(direction[seen]), direction[seen], surface)
        seen = seen[first.distance > distance[seen] - 8 * surface.lift]
        grid = (2 * pixel[seen] / size - 1)[None, None]
        picture = torch.cat([target.saturation, target.mask[..., None]], -1).permute(2, 0, 1)[None]
        sampled = torch.nn.functional.grid_sample(picture, grid, mode="bilinear", align_corners=False)[0, :, 0].T
        inside = sampled[:, 3] > INSIDE
        shown[index, seen[inside]] = sampled[inside, :3]
    return shown


def _differences(shown: Float[Tensor, "view vertex 3"]) -> tuple[Float[Tensor, "vertex"], Float[Tensor, "vertex"]]:
    """Of each vertex the mean difference from the median colour among the views that see it, without the third that differs most, and how many those are."""
    difference = (shown - shown.nanmedian(0).values).abs().mean(-1)
    count = (~torch.isnan(difference)).sum(0)
    ordered = difference.nan_to_num(nan=torch.inf).sort(0).values
    kept = torch.arange(len(shown), device=shown.device)[:, None] < (TRIMMED * count).ceil()
    total = torch.where(kept, ordered, torch.zeros_like(ordered)).sum(0)
    return total / kept.sum(0).clamp(min=1), count.float()
