"""Where masks end, to a fraction of a pixel, and how far the mesh's outlines lie from there.

In: views with masks; a mesh through its tracer. Out: signed distances of the mesh's outline in every picture [pixels], each with its
derivative by position: what integrate_normals pulls straight. Photographs' masks are the sharpest measurement of shape there is; they
are used as such, instead of through the blurred rim that surfels draw.

The mesh's outline is looked for by rays, from each place of the mask's outline along its normal: where they begin to miss. Edges between a face
that looks here and one that looks away are no measure of it: on a mesh whose faces tilt by a degree or two they zigzag within the outline, on the
very truth, meshed anew, by 0.1 to 0.2 pixels, and a surface that is held to them is that much too large.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.ndimage import map_coordinates
from skimage.measure import find_contours
from torch import Tensor

from drgs.render.intersect.trace_rays import trace_rays
from drgs.render.intersect.tracer import AbstractTracer
from drgs.render.records import Hits
from drgs.scene.camera import Camera, world_from_pixel
from drgs.scene.views import Views
from drgs.warp_torch import by_pool

FARTHEST = 6
"""[pixels] beyond which an outline of the mesh and one of the mask are not the same."""
HALVINGS = 6
"""Of the one or two pixels in which rays begin to miss the mesh."""
MARGIN = 2.0
"""[pixels] to the picture's border, where masks end because the picture does."""
SMOOTHED = 2
"""Neighbours on either side over which a mask's normals are averaged: single pixels have staircase normals."""


@dataclass(frozen=True, eq=False)
class MaskOutline:
    """The level 0.5 of one mask."""

    points: Float[Tensor, "point 2"]
    """[pixels; centres at +0.5]"""
    normals: Float[Tensor, "point 2"]
    """Unit, outwards."""
    lengths: Float[Tensor, "point"]
    """Of the outline at each point [pixels]."""


@dataclass(frozen=True, eq=False)
class OutlineResiduals:
    """Of all views, one entry for each place of a mask's outline near which the mesh has one."""

    corners: Int[Tensor, "residual 3"]
    """Vertices around the place where the mesh ends."""
    weights: Float[Tensor, "residual 3"]
    """Of the corners."""
    distance: Float[Tensor, "residual"]
    """[pixels]; positive where the mesh ends outside the mask."""
    gradient: Float[Tensor, "residual 3"]
    """Of the distance by the world position of that place [pixels per world unit]."""
    length: Float[Tensor, "residual"]
    """Of the mask's outline there [pixels]."""


def mask_outline(coverage: Tensor) -> MaskOutline | None:
    """The outline of one mask (height, width) 0..1; None where it has none."""
    alpha = np.pad(coverage.cpu().numpy().astype(np.float64), 1)
    points, normals, lengths = [], [], []
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
        lengths.append(length[some])
    if not points:
        return None
    return MaskOutline(*(torch.from_numpy(np.concatenate(values)).float() for values in (points, normals, lengths)))


def mask_outlines(views: Views) -> list[MaskOutline | None]:
    """Of every view."""
    return [mask_outline(mask.float() / 255) for mask in views.coverage]


@torch.no_grad()
def outline_residuals(tracer: AbstractTracer, cameras: tuple[Camera, ...], outlines: list[MaskOutline | None]) -> OutlineResiduals:
    """How far the mesh's outlines lie from the masks'."""
    views = [(camera, outline) for camera, outline in zip(cameras, outlines, strict=True) if outline is not None]
    parts = by_pool(lambda k, _: _residuals_of_view(tracer, *views[k]), range(len(views) + 1), tracer.mesh.vertices.device)
    if not parts:
        nothing = tracer.mesh.vertices.new_zeros(0)
        return OutlineResiduals(nothing.new_zeros(0, 3).long(), *(nothing.new_zeros(0, *tail) for tail in ((3,), (), (3,), ())))
    names = ("corners", "weights", "distance", "gradient", "length")
    return OutlineResiduals(*(torch.cat([getattr(part, name) for part in parts]) for name in names))


def _residuals_of_view(tracer: AbstractTracer, camera: Camera, outline: MaskOutline) -> OutlineResiduals:
    mesh = tracer.mesh
    points, normals, lengths = (values.to(mesh.vertices) for values in (outline.points, outline.normals, outline.lengths))
    size = torch.tensor([camera.width, camera.height]).to(points)
    within = ((points > MARGIN) & (points < size - MARGIN)).all(1)
    points, normals, lengths = points[within], normals[within], lengths[within]

    # Nearly everywhere the mesh ends within a pixel; only the other places are looked at farther off.
    inside, outside = -torch.ones_like(lengths), torch.ones_like(lengths)
    ends = _hits(camera, tracer, _outside(points, normals, torch.stack([inside, outside], 1))).hit.view(-1, 2)
    other = (~(ends[:, 0] & ~ends[:, 1])).nonzero().squeeze(1)
    offsets = torch.arange(-FARTHEST, FARTHEST + 1).to(points)
    hit = _hits(camera, tracer, _outside(points[other], normals[other], offsets.expand(len(other), -1))).hit.view(-1, len(offsets))
    far = torch.where(hit[:, :-1] & ~hit[:, 1:], (offsets[:-1] + 0.5).abs(), torch.inf)
    inside[other] = offsets[far.argmin(1)]
    outside[other] = inside[other] + 1
    found = torch.ones_like(ends[:, 0])
    found[other] = far.amin(1) < torch.inf
    points, normals, lengths, inside, outside = (values[found] for values in (points, normals, lengths, inside, outside))
    for _ in range(HALVINGS):
        middle = 0.5 * (inside + outside)
        hit = _hits(camera, tracer, _outside(points, normals, middle[:, None])).hit
        inside, outside = torch.where(hit, middle, inside), torch.where(hit, outside, middle)
    last = _hits(camera, tracer, _outside(points, normals, inside[:, None]))
    corners = mesh.faces[last.face.long()].long()
    weights = torch.cat([1 - last.barycentric.sum(-1, keepdim=True), last.barycentric], -1)
    rotation, translation = (values.to(points) for values in (camera.camera_from_world[:3, :3], camera.camera_from_world[:3, 3]))
    x, y, z = ((mesh.vertices[corners] * weights[..., None]).sum(1) @ rotation.T + translation).unbind(1)
    fx, fy = float(camera.intrinsics[0, 0]), float(camera.intrinsics[1, 1])
    across, down = fx * normals[:, 0], fy * normals[:, 1]
    by_camera = torch.stack([across / z, down / z, -(across * x + down * y) / z**2], 1)
    return OutlineResiduals(corners, weights, 0.5 * (inside + outside), by_camera @ rotation, lengths)


def _outside(
    points: Float[Tensor, "point 2"], normals: Float[Tensor, "point 2"], distance: Float[Tensor, "point place"]
) -> Float[Tensor, "all 2"]:
    """Places so many pixels outside the mask's outline, those of one point after another."""
    return (points[:, None] + distance[..., None] * normals[:, None]).reshape(-1, 2)


def _hits(camera: Camera, tracer: AbstractTracer, places: Tensor) -> Hits:
    """What rays through places (n, 2) of the picture meet."""
    pixel = torch.cat([places, torch.ones_like(places[:, :1])], -1)
    direction = torch.nn.functional.normalize(pixel @ world_from_pixel(camera).T.to(places), dim=-1)
    return trace_rays(camera.center_world.to(direction).expand_as(direction), direction, tracer)
