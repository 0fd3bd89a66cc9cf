"""Specification of drgs/render/visible/rasterize: the same maps by dense linear algebra, any float type, torch's own gradients.

For each pixel and each surfel, in order of centre depth: solve for (u, v) on the surfel's plane, take the wider of surfel and
screen-space filter, blend. Cost is pixels x surfels; `block` bounds the memory.
"""

import math

import torch
from torch import Tensor

from drgs.maths.constants import MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE
from drgs.render.visible.rasterize.project import DEPTH_CUTOFF, FILTER_CUTOFF_SQUARED
from drgs.render.visible.rasterize.rasterize import RasterMaps, RasterSettings
from drgs.scene.camera import Camera


def rasterize(
    centers: Tensor,
    tangents: Tensor,
    opacities: Tensor,
    features: Tensor,
    camera: Camera,
    settings: RasterSettings | None = None,
    depth_origin: float | None = None,
    block: int = 1024,
) -> RasterMaps:
    """As drgs.render.visible.rasterize.rasterize, in the precision of `centers`."""
    settings = settings or RasterSettings()
    dtype = centers.dtype
    pixel_from_world = camera.intrinsics.to(dtype) @ camera.camera_from_world[:3].to(dtype)
    columns = torch.cat([tangents, centers[:, :, None]], -1)  # (N, 3, 3): B_u, B_v, p
    m = pixel_from_world[:, :3] @ columns
    m = torch.cat([m[:, :, :2], (m[:, :, 2] + pixel_from_world[:, 3])[:, :, None]], -1)
    with torch.no_grad():
        axis, offset = camera.camera_from_world[2, :3].to(dtype), camera.camera_from_world[2, 3].to(dtype)
        if depth_origin is None:
            depth_origin = float(centers.mean(0) @ axis + offset) if len(centers) else 0.0
        reach = (2 * torch.log(opacities.clamp(min=MIN_ALPHA) / MIN_ALPHA)).sqrt() * m[:, 2, :2].norm(dim=-1)
        kept = (opacities >= MIN_ALPHA) & (m[:, 2, 2] + reach > settings.near)
        order = kept.nonzero().squeeze(1)
        order = order[torch.sort(m[order, 2, 2], stable=True).indices]
    m, opacity, feature = m[order], opacities[order], features[order]
    tu, tv, tw = m.unbind(1)

    cutoff = torch.tensor([FILTER_CUTOFF_SQUARED, FILTER_CUTOFF_SQUARED, -1.0], dtype=dtype)
    d9 = (cutoff * tw * tw).sum(-1)
    boxed = d9 < 0
    f = cutoff / torch.where(boxed, d9, -torch.ones_like(d9))[:, None]
    safe_z = torch.where(tw[:, 2] > settings.near, tw[:, 2], torch.ones_like(d9))
    middle = torch.stack([(f * tu * tw).sum(-1), (f * tv * tw).sum(-1)], -1)
    mean = torch.stack([tu[:, 2], tv[:, 2]], -1) / safe_z[:, None]
    filter_center = torch.where(boxed[:, None], middle, mean)
    filtered = tw[:, 2] > settings.near

    ax, ay, a1 = torch.linalg.cross(tv, tw), torch.linalg.cross(tw, tu), torch.linalg.cross(tu, tv)
    determinant = (a1 * tw).sum(-1)
    side = torch.where(determinant < 0, -1.0, 1.0).to(dtype).detach()
    xs = torch.arange(camera.width, dtype=dtype) + 0.5
    ys = torch.arange(camera.height, dtype=dtype) + 0.5
    pixels = torch.stack([xs.expand(camera.height, -1), ys[:, None].expand(-1, camera.width)], -1).reshape(-1, 2)

    def blend(pixel: Tensor) -> tuple[Tensor, ...]:
        if len(opacity) == 0:
            nothing = pixel.new_zeros(len(pixel))
            return pixel.new_zeros(len(pixel), features.shape[1]), nothing, nothing, nothing
        h = side[:, None] * (pixel[:, None, :1] * ax + pixel[:, None, 1:] * ay + a1)  # (P, M, 3)
        hx, hy, hz = h.unbind(-1)
        radius2 = hx * hx + hy * hy
        front = hz > 0
        safe_hz = torch.where(front, hz, torch.ones_like(hz))
        front = front & (tw[:, 2] + (tw[:, 0] * hx + tw[:, 1] * hy) / safe_hz > settings.near)
        huge = torch.full_like(hz, 1e30)
        rho_plane = torch.where(front, radius2 / (safe_hz * safe_hz), huge)
        difference = pixel[:, None, :] - filter_center
        rho_screen = torch.where(filtered, settings.filter_sigma**-2 * (difference * difference).sum(-1), huge)
        rho = torch.minimum(rho_plane, rho_screen)
        alpha = (opacity * torch.exp(-0.5 * rho)).clamp(max=MAX_ALPHA)
        alpha = torch.where(rho <= 2 * torch.log(opacity / MIN_ALPHA).detach(), alpha, torch.zeros_like(alpha))
        through = torch.cumprod(1 - alpha, 1)
        before = torch.cat([torch.ones_like(through[:, :1]), through[:, :-1]], 1)
        live = (before.detach() >= MIN_TRANSMITTANCE) & (alpha.detach() > 0)
        w = torch.where(live, alpha * before, torch.zeros_like(alpha))
        radius = torch.sqrt(radius2 + torch.finfo(dtype).tiny)
        reach = torch.maximum(hz.abs(), radius / DEPTH_CUTOFF)
        z = tw[:, 2] + (tw[:, 0] * hx + tw[:, 1] * hy) / reach
        relative = z - depth_origin
        ordinal = torch.arange(len(opacity)).expand_as(w)
        last = torch.where(live & (before.detach() > 0.5), ordinal, torch.full_like(ordinal, -1)).amax(1)
        median = torch.where(last >= 0, z.gather(1, last.clamp(min=0)[:, None])[:, 0], torch.zeros_like(z[:, 0]))
        return w @ feature, w.sum(1), (w * relative).sum(1), median

    parts = [blend(pixels[k : k + block]) for k in range(0, len(pixels), block)]
    image, coverage, first, median = (torch.cat(x) for x in zip(*parts, strict=True))
    size = (camera.height, camera.width)
    depth_sum, median_depth = (x.reshape(size) if k < settings.depth_planes else None for k, x in enumerate((first, median)))
    return RasterMaps(image.T.reshape(-1, *size), coverage.reshape(size), depth_sum, median_depth, depth_origin)


def look_at_camera(width: int, height: int, focal: float, distance: float = 4.0, angle: float = 0.4) -> Camera:
    """A camera that circles the origin; for tests."""
    world_from_camera = torch.eye(4)
    forward = -torch.tensor([math.cos(angle), math.sin(angle), 0.3])
    forward = forward / forward.norm()
    right = torch.linalg.cross(forward, torch.tensor([0.0, 0.0, 1.0]))
    right = right / right.norm()
    down = torch.linalg.cross(forward, right)
    world_from_camera[:3, :3] = torch.stack([right, down, forward], 1)
    world_from_camera[:3, 3] = -distance * forward
    intrinsics = torch.tensor([[focal, 0.0, width / 2 + 1.3], [0.0, focal * 1.05, height / 2 - 0.7], [0.0, 0.0, 1.0]])
    return Camera(torch.linalg.inv(world_from_camera), intrinsics, width, height)
