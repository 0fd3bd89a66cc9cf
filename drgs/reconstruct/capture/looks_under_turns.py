"""What pictures of places on a surface show beyond the light that turns with the camera.

Under such light nothing looks alike from picture to picture: other sides are lit, and shadows wander. A first surface says which part of the sky
each of its places sees, so what arrives there is linear in the light, and the light is one for all of them: a few harmonics, found together with
each place's paint. What paint under that light explains is taken out. The surface is coarse, and what it says of normals is not exact; so of what is
left, each place may explain a little by slopes of its own by how the light is turned (as_if_still).

Source: Ramamoorthi and Hanrahan 2001, for irradiance by few harmonics (docs/sources.md: ramamoorthi2001).

In: looks of vertices, how the light is turned in each photograph. Out: what is left of the looks.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from drgs.maths.color import linear_from_srgb, srgb_from_linear
from drgs.maths.sampling import sphere_lattice
from drgs.maths.spherical_harmonics import sh_basis
from drgs.reconstruct.fit.light.turned_light import BOUNCES, SeenSky, seen_sky
from drgs.render.intersect.tracer import AbstractTracer

HELD = (1.0, 30.0)
"""Of each slope of looks by how the light is turned, against the sum over views of squared entries of the turns: few views do not say much of nine.
With little held, what lies close before a surface looks nearly as alike as the surface; with much, coarse normals of a right one make it unlike."""
SENT_BACK = 0.5
"""Albedo of what is met instead of the sky; nothing is known of it yet."""
LIGHT_PLACES = 5000
"""Vertices that say what the light is."""
LIGHT_ROUNDS = 8
"""Of paint for the light of before, and light for that paint."""
UNEXPLAINED = 0.1
"""Relative difference from which on a look counts less: gloss and shadows that the surface does not cast."""
DARK = 0.05
"""Albedo to which differences are relative at least."""
LEAST_IRRADIANCE = 1e-3
"""Over the light's mean."""
LATTICE = 256
"""Directions by which harmonics are turned."""
HOLD_LIGHT = 1e-3
"""Of the harmonics, against what places say of them in the mean."""


def unexplained_looks(
    surface: AbstractTracer, shown: Float[Tensor, "view vertex 3"], light_from_world: Float[Tensor, "view 3 3"]
) -> list[Float[Tensor, "view vertex 3"]]:
    """Looks (SRGB; nan: none) of the surface's vertices less what the paint that explains most of them looks like in the turned light, and less slopes
    that are held as each of HELD says."""
    arrives, turned = irradiance_by_harmonics(seen_sky(surface)), turned_harmonics(light_from_world)
    linear = linear_from_srgb(shown)
    every = slice(None, None, 1 + len(arrives) // LIGHT_PLACES)
    light = light_of_looks(arrives[every], turned, linear[:, every])
    irradiance = _irradiance(arrives, turned, light)
    painted = (_paint(linear, irradiance) * irradiance).clamp(0, 1)
    left = shown - srgb_from_linear(painted)
    return [as_if_still(left, light_from_world, held) for held in HELD]


def irradiance_by_harmonics(sky: SeenSky) -> Float[Tensor, "vertex 16"]:
    """Of each vertex the irradiance over pi that arrives from light of each harmonic, less what the surface hides, and with what it sends back."""
    coarse = sky.coarse
    each = sh_basis(coarse.directions) * (4 / len(coarse.directions))
    unhidden = (coarse.normals @ coarse.directions.T).clamp(min=0) @ each
    met = (coarse.first_met[1:] - coarse.first_met[:-1]).long()
    vertex = torch.repeat_interleave(torch.arange(len(met), device=met.device), met)

    def gathered(values: Float[Tensor, "met 16"]) -> Float[Tensor, "vertex 16"]:
        return torch.zeros_like(unhidden).index_add_(0, vertex, sky.met_cosine[:, None] * values)

    direct = unhidden - gathered(each[coarse.met_direction.long()])
    arriving = direct
    for _ in range(BOUNCES):
        arriving = direct + gathered(SENT_BACK * 4 / len(coarse.directions) * arriving[sky.sender.long()])
    return arriving


def turned_harmonics(light_from_world: Float[Tensor, "view 3 3"]) -> Float[Tensor, "view 16 16"]:
    """Matrices that take a light's harmonics to those of the same light turned as in each view, in the world."""
    lattice = sphere_lattice(LATTICE).to(light_from_world)
    return torch.linalg.pinv(sh_basis(lattice)) @ sh_basis(lattice @ light_from_world.mT)


def light_of_looks(
    arrives: Float[Tensor, "vertex 16"], turned: Float[Tensor, "view 16 16"], linear: Float[Tensor, "view vertex 3"]
) -> Float[Tensor, "16 3"]:
    """Harmonics of the light, of mean 1, by which one paint a vertex explains its looks best; paint and light in turns, by reweighted least squares."""
    light = torch.zeros(16, 3, device=arrives.device)
    light[0] = 1 / sh_basis(arrives.new_tensor([0.0, 0.0, 1.0]), 0)
    even, known, looks = light[0, 0].clone(), ~linear.isnan(), linear.nan_to_num(0.0)
    for _ in range(LIGHT_ROUNDS):
        irradiance = _irradiance(arrives, turned, light)
        paint = _paint(linear, irradiance).nan_to_num(0.0)
        relative = 1 / (paint + DARK)
        weight = known * relative.square() / (1 + ((looks - paint * irradiance) * relative / UNEXPLAINED).square())
        columns = []
        for channel in range(3):
            squares = torch.einsum("kv,vi,vj->kij", weight[..., channel] * paint[:, channel].square(), arrives, arrives)
            sums = (weight * paint * looks)[..., channel] @ arrives
            matrix = (turned.mT @ squares @ turned).sum(0).double()
            held = HOLD_LIGHT * matrix.diagonal().mean() * torch.eye(16, dtype=torch.float64, device=matrix.device)
            columns.append(torch.linalg.solve(matrix + held, (turned.mT @ sums[..., None]).sum(0).double()[:, 0]))
        light = torch.stack(columns, 1).float()
        light = light * (even / light[0].mean())
    return light


def _irradiance(arrives: Tensor, turned: Tensor, light: Tensor) -> Float[Tensor, "view vertex 3"]:
    return (arrives @ (turned @ light)).clamp(min=LEAST_IRRADIANCE)


def _paint(linear: Tensor, irradiance: Tensor) -> Float[Tensor, "vertex 3"]:
    """The median over views; nan where none shows it."""
    return (linear / irradiance).nanmedian(0).values


def as_if_still(
    shown: Float[Tensor, "view vertex 3"], light_from_world: Float[Tensor, "view 3 3"], held: float
) -> Float[Tensor, "view vertex 3"]:
    """Looks (nan: none) without what goes linearly with how the light is turned: irradiance of degree 1 does, whatever shadows the place lies in.

    A place that is not on the surface shows another one from each side, of which nine slopes explain the less the more they are held.
    """
    basis = torch.cat([torch.ones_like(light_from_world[:, 0, :1]), light_from_world.flatten(1)], 1)
    count = basis.shape[1]
    seen = (~shown.isnan().any(-1)).float()
    squares = (seen.T @ (basis[:, :, None] * basis[:, None]).flatten(1)).reshape(-1, count, count)
    ridge = torch.full_like(basis[0], held).diag()
    ridge[0, 0] = 1e-4  # the constant is free; of places that nobody sees there is none
    fitted = torch.linalg.solve(squares + ridge, (shown.nan_to_num(0.0).permute(1, 2, 0) @ basis).mT)
    return shown - torch.einsum("ki,vic->kvc", basis[:, 1:], fitted[:, 1:])
