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
from torch import Tensor

from drgs.reconstruct.geometry.closed_outlines import closed_outlines
from drgs.reconstruct.kept_with_views import kept_with_views
from drgs.render.intersect.trace_rays import trace_rays
from drgs.render.intersect.tracer import AbstractTracer
from drgs.render.records import Hits
from drgs.scene.camera import Camera, world_from_pixel
from drgs.scene.views import Views

FARTHEST = 6
"""[pixels] beyond which an outline of the mesh and one of the mask are not the same."""
HALVINGS = 6
"""Of the one or two pixels in which rays begin to miss the mesh."""
MARGIN = 2.0
"""[pixels] to the picture's border, where masks end because the picture does."""


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
    outlines = closed_outlines(coverage.cpu().numpy())
    if not outlines:
        return None
    together = zip(*((outline.points, outline.normals, outline.lengths) for outline in outlines), strict=True)
    return MaskOutline(*(torch.from_numpy(np.concatenate(values)).float() for values in together))


@kept_with_views
def mask_outlines(views: Views) -> list[MaskOutline | None]:
    """Of every view."""
    return [mask_outline(mask.float() / 255) for mask in views.coverage]


@dataclass(frozen=True, eq=False)
class OutlineRays:
    """Of all places of all masks' outlines: a ray through s pixels outside such a place has the direction `straight` + s `sideways`."""

    origin: Float[Tensor, "place 3"]
    straight: Float[Tensor, "place 3"]
    """Not of unit length."""
    sideways: Float[Tensor, "place 3"]
    """[1 / pixel]"""
    normals: Float[Tensor, "place 2"]
    lengths: Float[Tensor, "place"]
    camera_from_world: Float[Tensor, "place 3 4"]
    focal: Float[Tensor, "place 2"]
    """[pixels]"""

    def __getitem__(self, chosen: Int[Tensor, "chosen"]) -> "OutlineRays":
        return OutlineRays(*(values.index_select(0, chosen) for values in vars(self).values()))

    def hits(self, tracer: AbstractTracer, outside: Float[Tensor, "place"]) -> Hits:
        """What rays so many pixels outside meet."""
        direction = torch.nn.functional.normalize(self.straight + outside[:, None] * self.sideways, dim=-1)
        return trace_rays(self.origin, direction, tracer)


def outline_rays(cameras: tuple[Camera, ...], outlines: list[MaskOutline | None], device: torch.device) -> OutlineRays:
    """Of places that are not at a picture's border."""
    parts = [_rays_of_view(camera, outline) for camera, outline in zip(cameras, outlines, strict=True) if outline is not None]
    if not parts:
        tails = ((3,), (3,), (3,), (2,), (), (3, 4), (2,))
        return OutlineRays(*(torch.zeros(0, *tail, device=device) for tail in tails))
    return OutlineRays(*(torch.cat(values).to(device) for values in zip(*(vars(part).values() for part in parts), strict=True)))


def _rays_of_view(camera: Camera, outline: MaskOutline) -> OutlineRays:
    camera = camera.to("cpu")
    points, normals, lengths = outline.points, outline.normals, outline.lengths
    size = torch.tensor([camera.width, camera.height]).to(points)
    within = ((points > MARGIN) & (points < size - MARGIN)).all(1)
    points, normals, lengths = points[within], normals[within], lengths[within]
    matrix, one = world_from_pixel(camera).to(points), torch.ones_like(points[:, :1])
    straight, sideways = (torch.cat([values, last], 1) @ matrix.T for values, last in ((points, one), (normals, 0 * one)))
    of_camera = (camera.center_world, camera.camera_from_world[:3, :4], torch.diagonal(camera.intrinsics)[:2])
    origin, transform, focal = (values.to(points).expand(len(points), *values.shape) for values in of_camera)
    return OutlineRays(origin, straight, sideways, normals, lengths, transform, focal)


@torch.no_grad()
def outline_residuals(tracer: AbstractTracer, rays: OutlineRays) -> OutlineResiduals:
    """How far the mesh's outlines lie from the masks'."""
    mesh = tracer.mesh
    # Nearly everywhere the mesh ends within a pixel; only the other places are looked at farther off.
    inside, outside = -torch.ones_like(rays.lengths), torch.ones_like(rays.lengths)
    found = rays.hits(tracer, inside).hit & ~rays.hits(tracer, outside).hit
    other = (~found).nonzero().squeeze(1)
    offsets = torch.arange(-FARTHEST, FARTHEST + 1).to(rays.lengths)
    farther = rays[other]
    hit = torch.stack([farther.hits(tracer, offset.expand(len(other))).hit for offset in offsets], 1)
    far = torch.where(hit[:, :-1] & ~hit[:, 1:], (offsets[:-1] + 0.5).abs(), torch.inf)
    inside[other] = offsets[far.argmin(1)]
    outside[other] = inside[other] + 1
    found[other] = far.amin(1) < torch.inf
    chosen = found.nonzero().squeeze(1)
    rays, inside, outside = rays[chosen], inside[chosen], outside[chosen]
    for _ in range(HALVINGS):
        middle = 0.5 * (inside + outside)
        hit = rays.hits(tracer, middle).hit
        inside, outside = torch.where(hit, middle, inside), torch.where(hit, outside, middle)
    last = rays.hits(tracer, inside)
    corners = mesh.faces[last.face.long()].long()
    weights = torch.cat([1 - last.barycentric.sum(-1, keepdim=True), last.barycentric], -1)
    place = (mesh.vertices[corners] * weights[..., None]).sum(1)
    rotation, translation = rays.camera_from_world[:, :, :3], rays.camera_from_world[:, :, 3]
    x, y, z = ((rotation @ place[..., None])[..., 0] + translation).unbind(1)
    across, down = (rays.focal * rays.normals).unbind(1)
    by_camera = torch.stack([across / z, down / z, -(across * x + down * y) / z**2], 1)
    gradient = (by_camera[:, None] @ rotation)[:, 0]
    return OutlineResiduals(corners, weights, 0.5 * (inside + outside), gradient, rays.lengths)
