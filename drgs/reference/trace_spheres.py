"""Particles as balls of their own volume, met by rays: what a picture of matter is held against where no mesh is true any more.

In: centres and radii, rays. Out: for each ray the first ball, how far it is, and its outward normal there; float64, every ray against every ball.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor

RAYS_AT_ONCE = 512
"""Bounds the memory: so many rays against all balls."""


def trace_spheres(
    centers: Float[Tensor, "ball 3"], radii: Float[Tensor, "ball"], origin: Float[Tensor, "3"], directions: Float[Tensor, "ray 3"]
) -> tuple[Float[Tensor, "ray"], Int[Tensor, "ray"], Float[Tensor, "ray 3"]]:
    """Distances (ray,) along unit directions, +inf where nothing is met; balls (ray,), -1 there; unit normals (ray, 3), zero there."""
    centers, radii, origin, directions = (values.double() for values in (centers, radii, origin, directions))
    towards = centers - origin
    # |o + t d - c|^2 = r^2 with |d| = 1: t = d.(c - o) - sqrt((d.(c - o))^2 - |c - o|^2 + r^2).
    beyond = towards.square().sum(-1) - radii.square()
    # Filled in place: small results between large ones that come and go would keep the memory of all.
    depth, ball = directions.new_empty(len(directions)), torch.empty(len(directions), dtype=torch.int64, device=centers.device)
    for start in range(0, len(directions), RAYS_AT_ONCE):
        part = slice(start, start + RAYS_AT_ONCE)
        along = directions[part] @ towards.T
        inside = along.square() - beyond
        distance = torch.where((inside >= 0) & (along > 0), along - inside.clamp(min=0).sqrt(), torch.inf)
        depth[part], ball[part] = distance.min(-1)
    hit = depth.isfinite()
    normal = (origin + depth.where(hit, torch.zeros_like(depth))[:, None] * directions - centers[ball]) / radii[ball][:, None]
    return depth, ball.where(hit, torch.full_like(ball, -1)), normal * hit[:, None]
