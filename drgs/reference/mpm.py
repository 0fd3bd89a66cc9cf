"""Twins of the simulation's laws and of one of its steps: closed forms in float64, every particle against every node.

Source of the formulas: docs/sources.md (stomakhin2012, stomakhin2013, klar2016); the stresses are checked against the derivatives of
`drgs.deform.matter.mpm.diagnostics.energy_density` by autograd, so that no factor can slip in.
"""

import torch
from torch import Tensor


def decompose(f: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """U, s, V of F (n, 3, 3) with U and V rotations; the sign of det F stands in the last s."""
    u, s, vt = torch.linalg.svd(f)
    du, dv = torch.sign(torch.linalg.det(u)), torch.sign(torch.linalg.det(vt))
    last = torch.ones_like(s)
    last[:, 2] = du
    other = torch.ones_like(s)
    other[:, 2] = dv
    sign = torch.ones_like(s)
    sign[:, 2] = du * dv
    return u * last[:, None], s * sign, (vt * other[:, :, None]).mT


def respond(law: str, trial: Tensor, plastic: Tensor, parameters: Tensor, affine: Tensor, dt: float) -> tuple[Tensor, Tensor, Tensor]:
    """F_e (n, 3, 3), plastic number (n,) and Kirchhoff stress (n, 3, 3) after a step to F_e = trial, as the kernel has them."""
    a, b, c, d = parameters.unbind(-1)
    one = torch.eye(3, dtype=trial.dtype).expand_as(trial)
    if law == "neo_hookean":
        j = torch.linalg.det(trial).clamp(min=0.05)
        return trial, plastic, a[:, None, None] * (trial @ trial.mT - one) + (b * torch.log(j))[:, None, None] * one
    if law == "fluid":
        trace = affine.diagonal(dim1=1, dim2=2).sum(-1)
        j = (plastic * (1 + dt * trace)).clamp(0.2, 1.1)
        viscous = affine + affine.mT - (2 / 3) * trace[:, None, None] * one
        tau = -(j * b * (j**-c - 1))[:, None, None] * one + (j * a)[:, None, None] * viscous
        return (j ** (1 / 3))[:, None, None] * one, j, tau
    u, s, v = decompose(trial)
    j = s.prod(-1)
    if law == "fixed_corotated":
        tau = 2 * a[:, None, None] * (trial - u @ v.mT) @ trial.mT + (b * j * (j - 1))[:, None, None] * one
        return trial, plastic, tau
    if law == "snow":
        kept = torch.minimum(torch.maximum(s, (1 - c)[:, None]), (1 + d)[:, None])
        plastic = (plastic * s.prod(-1) / kept.prod(-1)).clamp(0.05, 20)
        factor = torch.exp(10 * (1 - plastic)).clamp(0.1, 5)
        j = kept.prod(-1)
        t = 2 * (factor * a)[:, None] * (kept - 1) * kept + (factor * b * j * (j - 1))[:, None]
        return u @ torch.diag_embed(kept) @ v.mT, plastic, u @ torch.diag_embed(t) @ u.mT
    e = torch.log(s.clamp(0.05, 20))
    if law == "von_mises":
        dev = e - e.mean(-1, keepdim=True)
        size = dev.norm(dim=-1).clamp(min=1e-10)
        excess = (size - (2 / 3) ** 0.5 * (c + plastic) / (2 * a)).clamp(min=0) / (1 + (2 / 3) ** 0.5 * d)
        e = e - (excess / size)[:, None] * dev
        plastic = plastic + 2 * a * d * excess
    else:
        before = e.sum(-1)
        e = e + plastic[:, None] / 3
        trace = e.sum(-1)
        dev = e - e.mean(-1, keepdim=True)
        size = dev.norm(dim=-1).clamp(min=1e-10)
        excess = (size + (3 * b + 2 * a) / (2 * a) * trace * c).clamp(min=0)
        e = torch.where(trace[:, None] >= 0, torch.zeros_like(e), e - (excess / size)[:, None] * dev)
        plastic = plastic + before - e.sum(-1)
    t = 2 * a[:, None] * e + (b * e.sum(-1))[:, None]
    return u @ torch.diag_embed(torch.exp(e)) @ v.mT, plastic, u @ torch.diag_embed(t) @ u.mT


def step(
    positions: Tensor,
    velocities: Tensor,
    affine: Tensor,
    stress: Tensor,
    masses: Tensor,
    volumes: Tensor,
    dx: float,
    dt: float,
    gravity: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:
    """Positions, velocities and C after one APIC step far from all walls, on a dense grid whose node 0 lies at the world's origin."""
    base = torch.floor(positions / dx - 0.5)
    f = positions / dx - base
    w = torch.stack([0.5 * (1.5 - f) ** 2, 0.75 - (f - 1) ** 2, 0.5 * (f - 0.5) ** 2], -1)  # (n, axis, node)
    size = int(base.max()) + 3
    mass, momentum = torch.zeros(size**3, dtype=positions.dtype), torch.zeros(size**3, 3, dtype=positions.dtype)
    reach = [(i, j, k) for i in range(3) for j in range(3) for k in range(3)]
    force = -(4 * dt / dx**2) * volumes[:, None, None] * stress
    places = []
    for i, j, k in reach:
        node = base.long() + torch.tensor([i, j, k])
        place = (node[:, 0] * size + node[:, 1]) * size + node[:, 2]
        weight = w[:, 0, i] * w[:, 1, j] * w[:, 2, k]
        arm = node * dx - positions
        places.append((place, weight, arm))
        pushed = masses[:, None] * velocities + ((masses[:, None, None] * affine + force) @ arm[..., None])[..., 0]
        mass.index_add_(0, place, weight * masses)
        momentum.index_add_(0, place, weight[:, None] * pushed)
    node_velocity = torch.where(mass[:, None] > 0, momentum / mass.clamp(min=1e-300)[:, None], torch.zeros_like(momentum)) + dt * gravity
    velocity, gradient = torch.zeros_like(velocities), torch.zeros_like(affine)
    for place, weight, arm in places:
        velocity += weight[:, None] * node_velocity[place]
        gradient += (4 / dx**2) * weight[:, None, None] * node_velocity[place][:, :, None] * arm[:, None]
    return positions + dt * velocity, velocity, gradient
