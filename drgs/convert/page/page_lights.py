"""The lights that a page offers, filtered for each roughness beforehand: the asset's own, a studio, and a day at two hours.

In: an environment. Out: lat-long tables that a browser has only to look up, and spherical harmonics for what is diffuse.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from torch import Tensor

from drgs.maths.spherical_harmonics import sh_basis
from drgs.reconstruct.fit.light.split_sum import ENVIRONMENT_SIZE, LEVELS, filter_environment, level_table
from drgs.scene.environment import Environment, environment_radiance
from drgs.scene.lat_long import texel_directions, texel_solid_angles
from drgs.scene.sun_and_sky import paint_sun_and_sky
from drgs.scene.three_point_lights import paint_three_point_lights

LEVEL_ROWS = (128, 64, 32, 32, 16, 16)
"""Of the tables of a page, one for each of split_sum's LEVELS: no finer than its lobe shows."""
HARMONICS_DEGREE = 2
NOON_DEGREES, EVENING_DEGREES = 40.0, 7.0
"""How high the sun stands."""


@dataclass(frozen=True, eq=False)
class PageLight:
    """One light. Written by page_lights, read by encode_page."""

    name: str
    """For a button."""
    tables: tuple[Float[ndarray, "_ _ 3"], ...]
    """Mean radiance of the lobe of each roughness of LEVELS about each direction, linear."""
    harmonics: Float[ndarray, "9 3"]
    """Of the radiance, in the basis of drgs/maths/spherical_harmonics.py."""


def page_lights(own: Environment) -> tuple[PageLight, ...]:
    """The asset's own light first."""
    rows = ENVIRONMENT_SIZE[0]
    made = {
        "Studio": paint_three_point_lights(rows),
        "Day": paint_sun_and_sky(NOON_DEGREES, rows),
        "Evening": paint_sun_and_sky(EVENING_DEGREES, rows),
    }
    lights = {"As captured": _resized(own)} | {name: torch.from_numpy(radiance) for name, radiance in made.items()}
    return tuple(_page_light(name, radiance) for name, radiance in lights.items())


def _resized(environment: Environment) -> Float[Tensor, "128 256 3"]:
    radiance = environment.radiance.float().cpu()
    if tuple(radiance.shape[:2]) == ENVIRONMENT_SIZE:
        return radiance
    if radiance.shape[0] < ENVIRONMENT_SIZE[0]:
        return environment_radiance(Environment(radiance), torch.from_numpy(texel_directions(ENVIRONMENT_SIZE[0])).float())
    return torch.nn.functional.interpolate(radiance.permute(2, 0, 1)[None], ENVIRONMENT_SIZE, mode="area")[0].permute(1, 2, 0).contiguous()


def _page_light(name: str, radiance: Float[Tensor, "128 256 3"]) -> PageLight:
    filtered = filter_environment(radiance)
    tables = []
    for level, ((_, rows), wanted) in enumerate(zip(LEVELS, LEVEL_ROWS, strict=True)):
        table = level_table(filtered, level).clamp(min=0).permute(2, 0, 1)
        tables.append(torch.nn.functional.avg_pool2d(table, rows // wanted).permute(1, 2, 0).numpy())
    rows = radiance.shape[0]
    weight = torch.from_numpy(texel_solid_angles(rows)).float()[:, None, None]
    basis = sh_basis(torch.from_numpy(texel_directions(rows)).float(), HARMONICS_DEGREE)
    harmonics = torch.einsum("ijk,ijc->kc", basis, radiance * weight)
    return PageLight(name, tuple(tables), harmonics.numpy().astype(np.float64))
