"""Twin of the surfel tracer: every ray against every surfel, sorted, differentiable, in the precision of its inputs."""

import torch
from torch import Tensor

from drgs.maths.spherical_harmonics import radiance_from_sh

MIN_ALPHA, MAX_ALPHA, MIN_TRANSMITTANCE, GRAZING_COSINE = 1 / 255, 0.99, 1e-4, 1e-4


def meet_surfels(
    origins: Tensor, directions: Tensor, centers: Tensor, tangents: Tensor, opacities: Tensor, min_alpha: float = MIN_ALPHA
) -> tuple[Tensor, Tensor]:
    """Alpha (R, N), 0 for a miss, and t (R, N) of rays (R, 3), (R, 3) with surfels (N, 3), (N, 3, 2), (N,)."""
    unit_normal = torch.nn.functional.normalize(torch.linalg.cross(tangents[:, :, 0], tangents[:, :, 1]), dim=-1)
    cosine = directions @ unit_normal.T
    met = cosine.abs() > GRAZING_COSINE
    offset = centers[None] - origins[:, None]
    t = (offset * unit_normal).sum(-1) / torch.where(met, cosine, torch.ones_like(cosine))
    in_plane = t[..., None] * directions[:, None] - offset
    # Least squares for in_plane = tangents @ (u, v): in_plane lies in the plane, so it is exact.
    gram = tangents.transpose(1, 2) @ tangents
    uv = torch.linalg.solve(gram, torch.einsum("nxk,rnx->rnk", tangents, in_plane)[..., None])[..., 0]
    alpha = (opacities * torch.exp(-0.5 * uv.square().sum(-1))).clamp(max=MAX_ALPHA)
    return torch.where(met & (alpha >= min_alpha), alpha, torch.zeros_like(alpha)), t


def trace_surfel_radiance(
    origins: Tensor, directions: Tensor, centers: Tensor, tangents: Tensor, opacities: Tensor, radiance: Tensor, t_min: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Radiance (R, 3), opacity (R,) and sum of weight times t (R,); radiance (N, 3) is constant, (N, C, 3) is SH."""
    alpha, t = meet_surfels(origins, directions, centers, tangents, opacities)
    alpha = torch.where(t > t_min, alpha, torch.zeros_like(alpha))
    # A stable sort breaks ties by index.
    t, order = torch.sort(t, dim=1, stable=True)
    alpha = alpha.gather(1, order)
    before = torch.cumprod(torch.cat([torch.ones_like(alpha[:, :1]), 1 - alpha[:, :-1]], 1), 1)
    weight = torch.where(before >= MIN_TRANSMITTANCE, before * alpha, torch.zeros_like(alpha))
    if radiance.ndim == 2:
        color = radiance.clamp(min=0)[order]
    else:
        ray_count, count = alpha.shape
        degree = {1: 0, 4: 1, 9: 2, 16: 3}[radiance.shape[1]]
        pairs = directions[:, None].expand(ray_count, count, 3).reshape(-1, 3)
        color = radiance_from_sh(radiance[order.reshape(-1)], pairs, degree).reshape(ray_count, count, 3)
    return (weight[..., None] * color).sum(1), weight.sum(1), (weight * t).sum(1)
