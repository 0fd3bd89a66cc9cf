"""Twin of deform/carry/gmls: every point against all particles, in float64, in the form that shows the Taylor correction."""

import torch
from torch import Tensor


def interpolate(
    particles: Tensor,
    points: Tensor,
    moved: Tensor,
    gradients: Tensor,
    neighbours: int = 16,
    reach: float = 1.25,
    ridge: float = 1e-6,
) -> tuple[Tensor, Tensor]:
    """y and F of points (point, 3) from particles (n, 3), moved (n, 3), with gradients (n, 3, 3).

    y = sum psi_k (x_k + F_k (Y - X_k) / 2) + F r / 2 with F = sum psi_k F_k and r = Y - sum psi_k X_k.
    """
    distance, index = torch.cdist(points, particles, compute_mode="donot_use_mm_for_euclid_dist").topk(
        min(neighbours, len(particles)), largest=False
    )
    h = distance[:, -1:]
    w = (1 - (distance / (reach * h)) ** 2).clamp(min=0) ** 4
    w = w / w.sum(1, keepdim=True)
    p = torch.cat([torch.ones_like(w)[..., None], (particles[index] - points[:, None]) / h[..., None]], -1)
    moments = torch.einsum("mk,mki,mkj->mij", w, p, p) + ridge * torch.diag(p.new_tensor([0, 1, 1, 1]))
    first = p.new_tensor([1, 0, 0, 0]).expand(len(p), 4)
    psi = w * torch.einsum("mki,mi->mk", p, torch.linalg.solve(moments, first))
    blended = torch.einsum("mk,mkij->mij", psi, gradients[index])
    arm = points[:, None] - particles[index]
    residual = (psi[..., None] * arm).sum(1)  # Y - sum psi X
    y = (psi[..., None] * (moved[index] + 0.5 * torch.einsum("mkij,mkj->mki", gradients[index], arm))).sum(1)
    return y + 0.5 * torch.einsum("mij,mj->mi", blended, residual), blended
