"""Where masks end, to a fraction of a pixel, and how far the mesh's outlines lie from there.

In: views with masks; a mesh through its tracer. Out: signed distances of the mesh's outline in every picture [pixels], each with its
derivative by position: what integrate_normals pulls straight. Photographs' masks are the sharpest measurement of shape there is; they
are used as such, instead of through the blurred rim that surfels draw.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree
from skimage.measure import find_contours
from torch import Tensor

from drgs.reconstruct.geometry.mesh_edges import MeshEdges
from drgs.render.intersect.trace_rays import trace_rays
from drgs.render.intersect.tracer import AbstractTracer
from drgs.scene.camera import Camera, world_from_pixel
from drgs.scene.views import Views

FARTHEST = 6.0
"""[pixels] beyond which an outline of the mesh and one of the mask are not the same."""
ALIKE = 0.7
"""Least cosine between their normals."""
CLEAR = (1.0, 2.0)
"""[pixels] outside an outermost edge at which nothing of the mesh may be seen: edges before other parts of the object are none."""
SMOOTHED = 2
"""Neighbours on either side over which a mask's normals are averaged: single pixels have staircase normals."""


@dataclass(frozen=True, eq=False)
class MaskOutline:
    """The level 0.5 of one mask."""

    tree: cKDTree
    """Of `points`."""
    points: Float[Tensor, "point 2"]
    """[pixels; centres at +0.5]"""
    normals: Float[Tensor, "point 2"]
    """Unit, outwards."""


@dataclass(frozen=True, eq=False)
class OutlineResiduals:
    """Of all views, one entry for each edge of the mesh that is part of an outline."""

    edge: Int[Tensor, "residual"]
    distance: Float[Tensor, "residual"]
    """[pixels]; positive where the edge's middle lies outside the mask."""
    gradient: Float[Tensor, "residual 3"]
    """Of the distance by the world position of the edge's middle [pixels per world unit]."""
    length: Float[Tensor, "residual"]
    """Of the edge in the picture [pixels]."""


def mask_outline(coverage: Tensor) -> MaskOutline | None:
    """The outline of one mask (height, width) 0..1; None where it has none."""
    alpha = np.pad(coverage.cpu().numpy().astype(np.float64), 1)
    points, normals = [], []
    for contour in find_contours(alpha, 0.5):
        along = np.diff(contour, axis=0)
        length = np.linalg.norm(along, axis=1)
        some = length > 1e-6
        if some.sum() < 2 * SMOOTHED + 1:
            continue
        middle = 0.5 * (contour[1:] + contour[:-1])[some]
        normal = np.stack([along[some, 1], -along[some, 0]], 1) / length[some, None]
        outside, inside = (map_coordinates(alpha, (middle + side * normal).T, order=1) for side in (1.0, -1.0))
        normal[outside > inside] *= -1
        normal = sum(np.roll(normal, shift, 0) for shift in range(-SMOOTHED, SMOOTHED + 1))
        points.append(middle[:, ::-1] - 0.5)  # padding moved everything by 1; pixel centres lie at +0.5
        normals.append((normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9))[:, ::-1])
    if not points:
        return None
    at = np.concatenate(points)
    return MaskOutline(cKDTree(at), torch.from_numpy(at).float(), torch.from_numpy(np.concatenate(normals)).float())


def mask_outlines(views: Views) -> list[MaskOutline | None]:
    """Of every view."""
    return [mask_outline(mask.float() / 255) for mask in views.coverage]


def outline_residuals(
    edges: MeshEdges, tracer: AbstractTracer, cameras: tuple[Camera, ...], outlines: list[MaskOutline | None]
) -> OutlineResiduals:
    """How far the mesh's outermost outlines lie from the masks'."""
    vertices, face_normals = tracer.mesh.vertices, tracer.face_normals
    middle = 0.5 * (vertices[edges.vertices[:, 0]] + vertices[edges.vertices[:, 1]])
    parts = [
        _residuals_of_view(edges, middle, tracer, face_normals, camera, outline)
        for camera, outline in zip(cameras, outlines, strict=True)
        if outline is not None
    ]
    if not parts:
        device = vertices.device
        return OutlineResiduals(
            torch.zeros(0, dtype=torch.int64, device=device), *(torch.zeros(0, *tail, device=device) for tail in ((), (3,), ()))
        )
    return OutlineResiduals(*(torch.cat([getattr(part, name) for part in parts]) for name in ("edge", "distance", "gradient", "length")))


def _residuals_of_view(
    edges: MeshEdges, middle: Tensor, tracer: AbstractTracer, face_normals: Tensor, camera: Camera, outline: MaskOutline
) -> OutlineResiduals:
    device, vertices = middle.device, tracer.mesh.vertices
    rotation = camera.camera_from_world[:3, :3].to(device)
    translation = camera.camera_from_world[:3, 3].to(device)
    facing = (face_normals[edges.faces] * (middle - camera.center_world.to(device))[:, None]).sum(-1)
    edge = (facing[:, 0] * facing[:, 1] <= 0).nonzero().squeeze(1)  # one face looks here, the other away
    at = middle[edge] @ rotation.T + translation
    ahead = at[:, 2] > 1e-6
    edge, at = edge[ahead], at[ahead]
    place = _pixels(at, camera)
    outward = torch.nn.functional.normalize(face_normals[edges.faces[edge]].sum(1) @ rotation.T, dim=-1)[:, :2]
    outward = torch.nn.functional.normalize(outward, dim=-1)
    margin = CLEAR[-1]
    size = torch.tensor([camera.width, camera.height], device=device)
    within = (place > margin).all(1) & (place < size - margin).all(1)
    edge, at, place, outward = (x[within] for x in (edge, at, place, outward))
    for step in CLEAR:
        beyond = torch.minimum((place + step * outward).floor().long().clamp(min=0), size - 1)
        free = ~_covered(camera, tracer, beyond)
        edge, at, place, outward = (x[free] for x in (edge, at, place, outward))

    distance, nearest = outline.tree.query(place.cpu().numpy())
    index = torch.from_numpy(nearest)
    normal = outline.normals[index].to(device)
    signed = ((place - outline.points[index].to(device)) * normal).sum(-1)
    same = ((normal * outward).sum(-1) > ALIKE) & (torch.from_numpy(distance).to(device) < FARTHEST)
    fx, fy = float(camera.intrinsics[0, 0]), float(camera.intrinsics[1, 1])
    x, y, z = at.unbind(1)
    by_camera = torch.stack([normal[:, 0] * fx / z, normal[:, 1] * fy / z, -(normal[:, 0] * fx * x + normal[:, 1] * fy * y) / z**2], 1)
    ends = [_pixels(vertices[edges.vertices[edge, k]] @ rotation.T + translation, camera) for k in (0, 1)]
    return OutlineResiduals(edge[same], signed[same], (by_camera @ rotation)[same], (ends[0] - ends[1]).norm(dim=-1)[same])


def _covered(camera: Camera, tracer: AbstractTracer, pixels: Tensor) -> Tensor:
    """(n,) whether the centres of pixels (n, 2), column and row, show the mesh."""
    center = torch.cat([pixels + 0.5, torch.ones_like(pixels[:, :1])], -1).to(tracer.mesh.vertices)
    direction = torch.nn.functional.normalize(center @ world_from_pixel(camera).T, dim=-1)
    return trace_rays(camera.center_world.expand_as(direction), direction, tracer).hit


def _pixels(at_camera: Tensor, camera: Camera) -> Tensor:
    """(n, 2) places in the picture of points (n, 3) in the camera's frame."""
    homogeneous = at_camera @ camera.intrinsics.T.to(at_camera.device)
    return homogeneous[:, :2] / homogeneous[:, 2:]
