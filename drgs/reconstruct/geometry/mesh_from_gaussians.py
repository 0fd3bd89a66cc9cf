"""The surfels that cameras see, and the mesh around them: grey, since bake_materials gives it its materials."""

from collections.abc import Callable
from dataclasses import fields, replace
from typing import TypeVar

import igl
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from drgs.reconstruct.capture.build_box import BuildBox, whole_or_within
from drgs.reconstruct.capture.initial_points import InitialPoints
from drgs.reconstruct.geometry.extract_mesh import DepthMap, MeshSettings, clean_mesh, extract_mesh
from drgs.reconstruct.geometry.extract_mesh.clean_mesh import component_labels, face_areas, used_only
from drgs.render.visible.rasterize import RasterSettings, rasterize
from drgs.render.visible.rasterize.near_plane import near_plane
from drgs.scene.binding import Binding
from drgs.scene.camera import Camera
from drgs.scene.gaussians import Gaussians, surfel_tangents
from drgs.scene.mesh import TriangleMesh, vertex_normals

Surfels = TypeVar("Surfels", Gaussians, Binding)

SMALLEST_PART = 0.01
"""Of the largest part's area: below, a part of the mesh is taken for floating bits."""
BEYOND_HULL = 0.02
"""Of the bounds' radius: farther outside the hull nothing is the object."""
PART_IN_HULL = 0.9
"""Share of a part's vertices that the hull must hold."""


def drop_unseen(gaussians: Gaussians, cameras: tuple[Camera, ...], radius: float, least_weight: float = 0.02) -> Gaussians:
    """Without the surfels that no camera sees with a blending weight above `least_weight`: what hides inside would only cast shadows."""
    return chosen_surfels(gaussians, seen_surfels(gaussians, cameras, radius, least_weight))


def seen_surfels(gaussians: Gaussians, cameras: tuple[Camera, ...], radius: float, least_weight: float = 0.02) -> Bool[Tensor, "surfel"]:
    """(surfel,) whether some camera sees the surfel with a blending weight above `least_weight`."""
    weight = torch.zeros(len(gaussians.centers), 1, device=gaussians.centers.device)
    tangents, opacities = surfel_tangents(gaussians), torch.sigmoid(gaussians.opacity_logits)
    settings = RasterSettings(near_plane(radius), depth=False)
    for camera in cameras:
        # The gradient of sum_p w(p) f with respect to f is the surfel's total weight in the picture.
        feature = torch.zeros_like(weight, requires_grad=True)
        maps = rasterize(gaussians.centers, tangents, opacities, feature, camera.to(weight.device), settings)
        weight = torch.maximum(weight, torch.autograd.grad(maps.features.sum(), feature)[0])
    return weight[:, 0] > least_weight


def chosen_surfels(record: Surfels, kept: Bool[Tensor, "surfel"] | Int[Tensor, "kept"]) -> Surfels:
    """The entries of a record whose every field is by surfel, where `kept` (surfel,) is True, or those that it names, in its order."""
    return type(record)(*(getattr(record, entry.name)[kept] for entry in fields(record)))


def reduced_mesh(mesh: TriangleMesh, face_limit: int, radius: float) -> TriangleMesh:
    """The mesh with at most `face_limit` faces, grey again where its vertices are new."""
    if len(mesh.faces) <= face_limit:
        return mesh
    settings = MeshSettings(smoothing_passes=0, face_limit=face_limit, keep_component_fraction=0.0)
    return _grey_mesh(*clean_mesh(mesh.vertices, mesh.faces, settings, shortest_edge=1e-5 * radius))


def mesh_from_gaussians(
    gaussians: Gaussians,
    cameras: tuple[Camera, ...],
    points: InitialPoints,
    settings: MeshSettings,
    box: BuildBox | None = None,
    outside: Callable[[Float[Tensor, "point 3"]], Float[Tensor, "point"]] | None = None,
) -> TriangleMesh:
    """Fuse the median depth of every training view (mean depth draws a second sheet between two surfaces).

    Things that stand apart are kept, where a hull says that they are the object; without one the largest alone is.

    Args:
        box: of the build, which cuts the surface flat. outside: as extract_mesh takes it.

    Raises:
        ValueError: as extract_mesh.
    """
    center, radius = points.bounds_center, points.bounds_radius
    if box is not None and box.longest_half < radius:
        center, radius = torch.tensor(box.center), box.longest_half
    tangents, opacities = surfel_tangents(gaussians), torch.sigmoid(gaussians.opacity_logits)
    maps = median_depths(gaussians.centers, tangents, opacities, cameras, points.bounds_radius)
    if points.hull_vertices is None or points.hull_faces is None:
        vertices, faces = extract_mesh(maps, center, radius, settings, box, outside)
        return _grey_mesh(whole_or_within(box, vertices), faces)
    settings = replace(settings, keep_component_fraction=SMALLEST_PART)
    vertices, faces = extract_mesh(maps, center, radius, settings, box, outside)
    vertices, faces = parts_in_hull(vertices, faces, points.hull_vertices, points.hull_faces, BEYOND_HULL * points.bounds_radius)
    return _grey_mesh(whole_or_within(box, vertices), faces)


def median_depths(
    centers: Float[Tensor, "surfel 3"],
    tangents: Float[Tensor, "surfel 3 2"],
    opacities: Float[Tensor, "surfel"],
    cameras: tuple[Camera, ...],
    radius: float,
) -> list[DepthMap]:
    """What each camera sees of the surfels.

    Args:
        radius: of the object's bounding sphere [world units].
    """
    empty, settings, maps = torch.zeros_like(centers[:, :1]), RasterSettings(near_plane(radius), median=True), []
    for camera in cameras:
        drawn = rasterize(centers, tangents, opacities, empty, camera.to(empty.device), settings)
        assert drawn.median_depth is not None  # asked for by RasterSettings.median
        maps.append(DepthMap(camera.to(empty.device), drawn.median_depth, drawn.coverage))
    return maps


def parts_in_hull(
    vertices: Float[Tensor, "vertex 3"],
    faces: Int[Tensor, "face 3"],
    hull_vertices: Float[Tensor, "corner 3"],
    hull_faces: Int[Tensor, "triangle 3"],
    reach: float,
) -> tuple[Float[Tensor, "new_vertex 3"], Int[Tensor, "new_face 3"]]:
    """The largest part, and those that lie in the hull or no farther than `reach` [world units] outside."""
    places, triangles = vertices.cpu().double().numpy(), faces.cpu().numpy().astype(np.int64)
    label = component_labels(len(places), triangles)
    if label.max() == 0:
        return vertices, faces
    outer, outer_faces = hull_vertices.cpu().double().numpy(), hull_faces.cpu().numpy().astype(np.int64)
    held = igl.fast_winding_number(outer, outer_faces, places) > 0.5
    held |= igl.point_mesh_squared_distance(places, outer, outer_faces)[0] < reach * reach
    kept = np.bincount(label, held) >= PART_IN_HULL * np.bincount(label)
    # Where poses or masks contradict each other the hull is too small for the object itself.
    kept[np.bincount(label[triangles[:, 0]], face_areas(places, triangles)).argmax()] = True
    points, triangles = used_only(places, triangles[kept[label[triangles[:, 0]]]])
    return torch.from_numpy(points).to(vertices), torch.from_numpy(triangles).to(faces)


def _grey_mesh(vertices: Float[Tensor, "vertex 3"], faces: Int[Tensor, "face 3"]) -> TriangleMesh:
    """Shape alone; bake_materials gives it its materials."""
    grey = torch.full((len(vertices),), 0.5, device=vertices.device)
    return TriangleMesh(vertices, faces, vertex_normals(vertices, faces), grey[:, None].repeat(1, 3), grey, torch.zeros_like(grey))
