"""What the material point method knows: materials, matter, its state, the grid around it and what acts on it.

All lengths in one unit of the caller's choice, and masses, seconds and moduli to match (simulate.py works in world units).
"""

import math
from dataclasses import dataclass, field
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

Law = Literal["fixed_corotated", "neo_hookean", "von_mises", "drucker_prager", "fluid", "snow"]
LAWS: tuple[Law, ...] = ("fixed_corotated", "neo_hookean", "von_mises", "drucker_prager", "fluid", "snow")
"""A particle stores the place of its law in this list."""
Triple = tuple[float, float, float]
SNOW_STIFFENING = 5.0
"""The most that packed snow stiffens."""


@dataclass(frozen=True)
class Material:
    """One kind of matter. Laws take what they need of it."""

    law: Law = "fixed_corotated"
    density: float = 1000.0
    """kg per cubic unit."""
    young_modulus: float = 1e5
    """E [Pa]; all laws but fluid."""
    poisson_ratio: float = 0.3
    """nu, below 0.5."""
    yield_stress: float = math.inf
    """von_mises: uniaxial [Pa]."""
    hardening: float = 0.0
    """von_mises: growth of the yield stress, xi, in 2 mu xi per unit of plastic strain."""
    friction_angle: float = 35.0
    """drucker_prager [degrees]."""
    bulk_modulus: float = 1e5
    """fluid: k [Pa]."""
    exponent: float = 7.0
    """fluid: gamma of the equation of state."""
    viscosity: float = 0.0
    """fluid: eta [Pa s]."""
    critical_compression: float = 2.5e-2
    critical_stretch: float = 4.5e-3
    """snow: strains beyond which it breaks."""

    def __post_init__(self) -> None:
        if self.law not in LAWS:
            raise ValueError(f"the material law {self.law!r} is unknown; expected one of {', '.join(LAWS)}")
        positive = {"density": self.density, "young_modulus": self.young_modulus, "bulk_modulus": self.bulk_modulus}
        for name, value in positive.items():
            if not (0 < value < math.inf):
                raise ValueError(f"the material's {name} is {value}; expected a positive number")
        if not 0 <= self.poisson_ratio <= 0.49:
            raise ValueError(f"the material's poisson_ratio is {self.poisson_ratio}; expected 0 to 0.49")
        if not 0 <= self.friction_angle < 90 or self.viscosity < 0 or self.hardening < 0 or self.yield_stress < 0 or self.exponent <= 1:
            raise ValueError(
                "a material's friction_angle lies in 0 to 90 degrees, its viscosity, hardening and yield_stress are not negative, its exponent exceeds 1"
            )

    @property
    def lame(self) -> tuple[float, float]:
        """mu and lambda [Pa]."""
        e, nu = self.young_modulus, self.poisson_ratio
        return e / (2 * (1 + nu)), e * nu / ((1 + nu) * (1 - 2 * nu))

    @property
    def wave_speed(self) -> float:
        """Of pressure waves, in the stiffest state that the law reaches without being compressed."""
        if self.law == "fluid":
            return math.sqrt(self.bulk_modulus * self.exponent / self.density)
        mu, lam = self.lame
        stiffening = SNOW_STIFFENING if self.law == "snow" else 1.0
        return math.sqrt(stiffening * (lam + 2 * mu) / self.density)

    @property
    def parameters(self) -> tuple[float, float, float, float]:
        """The four numbers that the law's kernel reads."""
        mu, lam = self.lame
        if self.law == "fluid":
            return self.viscosity, self.bulk_modulus, self.exponent, 0.0
        if self.law == "von_mises":
            return mu, lam, min(self.yield_stress, 1e30), self.hardening
        if self.law == "drucker_prager":
            sine = math.sin(math.radians(self.friction_angle))
            return mu, lam, math.sqrt(2 / 3) * 2 * sine / (3 - sine), 0.0
        if self.law == "snow":
            return mu, lam, self.critical_compression, self.critical_stretch
        return mu, lam, 0.0, 0.0


@dataclass(frozen=True)
class Plane:
    point: Triple
    normal: Triple
    """Outward: matter stays on this side."""


@dataclass(frozen=True)
class Sphere:
    center: Triple
    radius: float


@dataclass(frozen=True)
class Box:
    minimum: Triple
    maximum: Triple


@dataclass(frozen=True, eq=False)
class Solid:
    """A closed surface of triangles, as distances from it on a lattice (drgs/deform/matter/measure_solid.py makes it)."""

    minimum: Triple
    """Where the lattice's first node lies; beyond the lattice nothing is inside."""
    spacing: float
    distances: Float[Tensor, "x y z"]
    """Negative inside."""


@dataclass(frozen=True)
class Condition:
    """Something that acts on the grid's nodes inside a shape, while it lasts.

    sticky: nodes take the velocity (a pin, or a handle that drags). slip: nothing crosses the surface. separate: nothing enters,
    and friction acts on what presses. push: an acceleration, of gravity's kind.
    """

    shape: Plane | Sphere | Box | Solid
    effect: Literal["sticky", "slip", "separate", "push"] = "separate"
    friction: float = 0.0
    """Coulomb's coefficient; separate only."""
    velocity: Triple = (0.0, 0.0, 0.0)
    """Of the shape, which moves along [units/s]; for push, the acceleration [units/s^2] in a shape that stays."""
    start: float = 0.0
    end: float = math.inf
    """Seconds."""


@dataclass(frozen=True)
class GridSettings:
    minimum: Triple
    maximum: Triple
    """The room: matter cannot leave this box."""
    dx: float
    """Spacing of the nodes."""


@dataclass(frozen=True)
class MpmSettings:
    courant: float = 0.4
    """C of dt = C dx / (wave speed + speed); 0.9 at most."""
    transfer: Literal["apic", "pic"] = "apic"
    """pic: the paper's printed transfer, which loses angular momentum."""
    strain_damping: float = 0.0
    """Part r of the symmetric velocity gradient removed at each step; 1 leaves rigid motion only."""
    velocity_damping: float = 0.0
    """Rate of decay of all velocities [1/s]."""
    max_substeps: int = 2000
    """Of one call; more are refused with a sentence."""
    retries: int = 4
    """Halvings of the time step after a failure, before matter is frozen."""

    def __post_init__(self) -> None:
        if not 0 < self.courant <= 0.9:
            raise ValueError(f"courant is {self.courant}; expected above 0 and at most 0.9, where the method stays stable")
        if not 0 <= self.strain_damping <= 1 or self.velocity_damping < 0:
            raise ValueError("strain_damping lies in 0 to 1, velocity_damping is not negative")


@dataclass(frozen=True, eq=False)
class Model:
    """What does not change while time passes."""

    rest: Float[Tensor, "particle 3"]
    """Positions at rest."""
    volumes: Float[Tensor, "particle"]
    """At rest."""
    masses: Float[Tensor, "particle"]
    """kg"""
    laws: Int[Tensor, "particle"]
    """int32, places in LAWS."""
    parameters: Float[Tensor, "particle 4"]
    """See Material.parameters."""
    wave_speed: float
    """The fastest material's."""
    grid: GridSettings
    gravity: Triple = (0.0, 0.0, 0.0)
    """Acceleration [units/s^2]."""
    conditions: tuple[Condition, ...] = field(default_factory=tuple)


@dataclass(frozen=True, eq=False)
class State:
    """Matter at one time."""

    positions: Float[Tensor, "particle 3"]
    velocities: Float[Tensor, "particle 3"]
    affine: Float[Tensor, "particle 3 3"]
    """C, the local velocity gradient."""
    total: Float[Tensor, "particle 3 3"]
    """F against rest; a rotation for fluid and sand, whose stretches mean nothing once they have mixed."""
    elastic: Float[Tensor, "particle 3 3"]
    """F_e: what stress comes from."""
    stress: Float[Tensor, "particle 3 3"]
    """Kirchhoff stress of F_e."""
    plastic: Float[Tensor, "particle"]
    """von_mises: growth of the yield stress; drucker_prager: volume gained; snow: J_p; fluid: J."""
    frozen: Bool[Tensor, "particle"]
    """Taken out of the motion after repeated failure."""
    time: float
    """Seconds."""


def make_model(
    positions: Float[Tensor, "particle 3"],
    volumes: Float[Tensor, "particle"],
    materials: tuple[Material, ...],
    material_of: Int[Tensor, "particle"],
    grid: GridSettings,
    gravity: Triple = (0.0, 0.0, 0.0),
    conditions: tuple[Condition, ...] = (),
) -> Model:
    """Matter of `materials`, particle i being of materials[material_of[i]].

    Raises:
        ValueError: a particle lies outside the room, or values are not finite.
    """
    rest = positions.detach().float().contiguous()
    if not len(rest):
        raise ValueError("cannot simulate without particles")
    if not torch.isfinite(rest).all() or not (volumes > 0).all() or not torch.isfinite(volumes).all():
        raise ValueError("positions of particles must be finite, and volumes positive")
    low, high = (rest.new_tensor(corner) for corner in (grid.minimum, grid.maximum))
    outside = int(((rest < low) | (rest > high)).any(1).sum())
    if outside:
        raise ValueError(f"{outside} particles lie outside the room {grid.minimum} to {grid.maximum}")
    device = rest.device
    table = torch.tensor([m.parameters for m in materials], dtype=torch.float32, device=device)
    laws = torch.tensor([LAWS.index(m.law) for m in materials], dtype=torch.int32, device=device)
    density = torch.tensor([m.density for m in materials], dtype=torch.float32, device=device)
    which = material_of.long().to(device)
    present = which.unique().tolist()
    return Model(
        rest, volumes.float().contiguous(), (volumes * density[which]).float().contiguous(), laws[which].contiguous(),
        table[which].contiguous(), max(materials[k].wave_speed for k in present), grid, gravity, conditions,
    )  # fmt: skip


def rest_state(model: Model, velocity: Triple | Float[Tensor, "particle 3"] = (0.0, 0.0, 0.0)) -> State:
    """Matter at rest, unstrained, moving with one velocity or with one for each particle."""
    count, device = len(model.rest), model.rest.device
    velocities = torch.as_tensor(velocity, dtype=torch.float32, device=device).expand(count, 3).contiguous()
    identity = torch.eye(3, device=device).repeat(count, 1, 1)
    whole = (model.laws == LAWS.index("snow")) | (model.laws == LAWS.index("fluid"))
    return State(
        model.rest.clone(), velocities, torch.zeros_like(identity), identity, identity.clone(), torch.zeros_like(identity),
        whole.float(), torch.zeros(count, dtype=torch.bool, device=device), 0.0,
    )  # fmt: skip
