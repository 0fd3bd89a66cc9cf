"""What a simulation should conserve: momentum, angular momentum and energy of a state."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from drgs.deform.matter.mpm.records import LAWS, Model, State
from drgs.deform.matter.mpm.stress_laws import (
    LEAST_STRETCH,
    LEAST_VOLUME,
    MOST_STRETCH,
    SNOW_HARDENING,
    SNOW_LEAST_FACTOR,
    SNOW_MOST_FACTOR,
)


@dataclass(frozen=True, eq=False)
class Balance:
    """Totals over all particles, in float64."""

    mass: float
    momentum: Float[Tensor, "3"]
    angular_momentum: Float[Tensor, "3"]
    """About the world's origin, with that of the affine velocities, for a grid of this dx."""
    kinetic: float
    """Energy of the velocities and of the affine velocities."""
    elastic: float
    potential: float
    """Of gravity, counted from the world's origin."""

    @property
    def energy(self) -> float:
        return self.kinetic + self.elastic + self.potential


def measure_balance(model: Model, state: State) -> Balance:
    """Momentum and energy of a state; quadratic B-splines hold a share dx^2/4 of the affine velocities."""
    m, x, v, c = (t.double() for t in (model.masses, state.positions, state.velocities, state.affine))
    inertia = model.grid.dx**2 / 4
    axial = torch.stack([c[:, 2, 1] - c[:, 1, 2], c[:, 0, 2] - c[:, 2, 0], c[:, 1, 0] - c[:, 0, 1]], -1)
    gravity = torch.tensor(model.gravity, dtype=torch.float64, device=m.device)
    return Balance(
        mass=float(m.sum()),
        momentum=(m[:, None] * v).sum(0),
        angular_momentum=(m[:, None] * (torch.linalg.cross(x, v) + inertia * axial)).sum(0),
        kinetic=float(0.5 * (m * (v.square().sum(-1) + inertia * c.square().sum((1, 2)))).sum()),
        elastic=elastic_energy(model, state),
        potential=float(-(m * (x @ gravity)).sum()),
    )


def energy_density(
    law: str, elastic: Float[Tensor, "n 3 3"], plastic: Float[Tensor, "n"], parameters: Float[Tensor, "n 4"]
) -> Float[Tensor, "n"]:
    """(n,) psi, the elastic energy in a cubic unit of rest volume: the specification that stresses are derived from.

    Args:
        elastic: F_e (n, 3, 3); differentiable where its singular values differ.
        plastic: (n,), see State.
        parameters: (n, 4), see Material.
    """
    a, b, c, _ = parameters.unbind(-1)
    j = torch.linalg.det(elastic)
    if law == "fluid":
        # Counted from J = 1, where k (J^(1 - gamma) / (gamma - 1) + J) itself is k gamma / (gamma - 1).
        return b * (plastic ** (1 - c) / (c - 1) + plastic - c / (c - 1))
    if law == "neo_hookean":
        volume = torch.log(j.clamp(min=float(LEAST_VOLUME)))
        return 0.5 * a * (elastic.square().sum((1, 2)) - 3) - a * volume + 0.5 * b * volume.square()
    u, s, vt = torch.linalg.svd(elastic)
    signed = torch.cat([s[:, :2], s[:, 2:] * torch.sign(torch.linalg.det(u @ vt))[:, None]], 1)
    if law in ("fixed_corotated", "snow"):
        energy = a * (signed - 1).square().sum(1) + 0.5 * b * (j - 1).square()
        if law == "fixed_corotated":
            return energy
        return energy * torch.exp(float(SNOW_HARDENING) * (1 - plastic)).clamp(float(SNOW_LEAST_FACTOR), float(SNOW_MOST_FACTOR))
    e = torch.log(signed.clamp(float(LEAST_STRETCH), float(MOST_STRETCH)))
    return a * e.square().sum(1) + 0.5 * b * e.sum(1).square()


def elastic_energy(model: Model, state: State) -> float:
    """Of all particles, in float64."""
    total = 0.0
    for number in model.laws.unique().tolist():
        chosen = model.laws == number
        values = (state.elastic[chosen].double(), state.plastic[chosen].double(), model.parameters[chosen].double())
        total += float((model.volumes[chosen].double() * energy_density(LAWS[number], *values)).sum())
    return total
