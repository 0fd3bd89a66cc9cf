"""Float64 twin of the depth fusion kernel: one view at a time, all points at once, no blocks."""

from collections.abc import Sequence

import torch
from torch import Tensor

from drgs.scene.camera import Camera

SILHOUETTE_RAMP = 3.0
"""[pixels]; the twin's own copy, so that a change in one place shows."""


def distance_field_at(
    points: Tensor,
    views: Sequence,
    pixels: Sequence[Tensor],
    truncation: float,
    soft_band: float,
    minimum_free_views: int,
    minimum_free_fraction: float,
) -> Tensor:
    """(N,) field at world points (N, 3).

    Args:
        views: records with a `camera` each.
        pixels: per view (height, width, 4): 1/depth, normal factor, weight, signed silhouette distance.
        soft_band: depth behind the surface from which a vote fades out is truncation minus this, as in the kernel.
    """
    weighted, weights, free, seen = (torch.zeros(points.shape[0], dtype=points.dtype) for _ in range(4))
    for view, image in zip(views, pixels, strict=True):
        value, weight, is_free, is_seen = vote_of_view(points, view.camera, image, truncation, soft_band)
        weighted, weights = weighted + weight * value, weights + weight
        free, seen = free + is_free, seen + is_seen
    field = torch.where(weights > 0, weighted / weights.clamp(min=1e-12), -1.0)
    needed = torch.stack([torch.full_like(seen, minimum_free_views), minimum_free_fraction * seen]).amax(0).minimum((0.5 * seen).ceil())
    field = torch.where((field > 0) & (free < needed), -1.0, field)
    return torch.where(seen > 0, field, 1.0).clamp(-1.0, 1.0)


def vote_of_view(
    points: Tensor, camera: Camera, image: Tensor, truncation: float, soft_band: float
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Value, weight, whether the view looks through the point, and whether it has it in frame; each (N,)."""
    height, width = image.shape[:2]
    intrinsics, camera_from_world = camera.intrinsics.to(points), camera.camera_from_world.to(points)
    local = points @ camera_from_world[:3, :3].T + camera_from_world[:3, 3]
    z = local[:, 2]
    uv = (local @ intrinsics.T)[:, :2] / z.clamp(min=1e-6)[:, None] - 0.5
    seen = (z > 1e-6) & (uv >= 0).all(-1) & (uv[:, 0] < width - 1) & (uv[:, 1] < height - 1)
    corner = uv.floor().long().clamp(min=0)
    column, row = corner[:, 0].clamp(max=width - 2), corner[:, 1].clamp(max=height - 2)
    fu, fv = uv[:, 0] - column, uv[:, 1] - row
    shares = torch.stack([(1 - fu) * (1 - fv), fu * (1 - fv), (1 - fu) * fv, fu * fv], -1)
    four = torch.stack([image[row, column], image[row, column + 1], image[row + 1, column], image[row + 1, column + 1]], 1)
    silhouette = (shares * four[..., 3]).sum(-1)
    valid = four[..., 0] > 0
    total = (shares * valid).sum(-1)
    mean = (shares[..., None] * four * valid[..., None]).sum(1) / total.clamp(min=1e-30)[:, None]
    near = 1 / four[..., 0].amax(-1).clamp(min=1e-30)
    far = 1 / torch.where(valid, four[..., 0], torch.inf).amin(-1)

    background = seen & (silhouette < 0)
    surface = seen & (silhouette >= 0) & (total > 0)
    smooth = surface & (far - near <= 2 * truncation)
    distance = (1 / mean[:, 0].clamp(min=1e-30) - z) * mean[:, 1]
    smooth = smooth & (distance > -truncation)
    edge = surface & ~(far - near <= 2 * truncation) & (z < near - truncation)

    value = torch.zeros_like(z)
    weight = torch.zeros_like(z)
    outline = (-silhouette * z / intrinsics[0, 0] / truncation).clamp(max=1)
    value, weight = (
        torch.where(background, outline, value),
        torch.where(background, (0.25 - silhouette / SILHOUETTE_RAMP).clamp(max=1), weight),
    )
    fade = ((distance + truncation) / (truncation - soft_band)).clamp(max=1)
    value, weight = torch.where(smooth, (distance / truncation).clamp(max=1), value), torch.where(smooth, mean[:, 2] * fade, weight)
    value, weight = torch.where(edge, torch.ones_like(z), value), torch.where(edge, mean[:, 2], weight)
    return value, weight, (background | edge | (smooth & (distance > 0))).to(z), seen.to(z)
