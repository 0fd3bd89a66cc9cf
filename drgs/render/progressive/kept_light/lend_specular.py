"""What rough paint mirrors is alike in neighbouring pixels: one of four has rays for it, and lends it to the others.

In: the points of a moving picture, which of them read their diffuse light from the mesh. Out: which of those need rays, and the light that the rest takes over.
With three rays a point what differs between such neighbours is mostly noise, and the filter averages over more of them than that. Smoother points keep rays of their own, and so does whoever has no neighbour on the same surface that has some.
"""

from dataclasses import dataclass
from typing import Any

import torch
import warp as wp
from jaxtyping import Int
from torch import Tensor

from drgs.render.integrate.integrator import light_sums
from drgs.render.integrate.sample_arrays import PointArrays, point_arrays
from drgs.render.integrate.sum_samples import LightSums
from drgs.render.progressive.demodulate_albedo import mean_square, specular_reflectance
from drgs.render.progressive.kept_light.read_light import READ
from drgs.render.progressive.neighbours import SIDES, Neighbourhood, neighbour_alike, point_beside
from drgs.render.records import PrimaryPoints, ShadedPoints
from drgs.warp_torch import launch, warp_array, warp_device

wp.set_module_options({"enable_backward": False})

ROUGH_ENOUGH = wp.constant(0.3)
"""From which on points borrow. Errors of pictures with and without, of a camera that turns by a degree a picture: 1 to 3 % more of the demo's sample and none of a bunny;
with 0.2 and every other pixel 5 and 4 %, with 0 7 and 47 % (docs/decisions/0004)."""


@dataclass(frozen=True, eq=False)
class Lenders:
    """Of points that read their diffuse light."""

    with_rays: Int[Tensor, "point"]
    """int32; the numbers of those that need rays."""
    borrowers: Int[Tensor, "point"]
    """The same of those that do not."""
    sides: Any
    """Of each point of the picture, a bit for each side on which one lends; a Warp array."""
    there: Any
    """Neighbourhood."""


@wp.func
def has_rays(points: PointArrays, there: Neighbourhood, p: int) -> bool:
    """Whatever its neighbours are."""
    row = points.pixel[p] // there.image_width
    column = points.pixel[p] % there.image_width
    return points.roughness[p] < ROUGH_ENOUGH or (row % 2 == 0 and column % 2 == 0)


@wp.kernel
def look_for_lenders(
    first: int,
    points: PointArrays,
    depth: wp.array[float],
    verdict: wp.array[int],
    there: Neighbourhood,
    # outputs
    sides: wp.array[wp.uint8],
):
    p = first + wp.tid()
    found = int(0)
    if verdict[p] == READ and not has_rays(points, there, p):
        for side in range(SIDES):
            q = neighbour_alike(points, depth, there, p, side)
            if q >= 0:  # noqa: SIM102 (some of Warp's `and` evaluate both)
                if verdict[q] == READ and has_rays(points, there, q):
                    found = found | (1 << side)
    sides[p] = wp.uint8(found)


@wp.kernel
def lend(
    first: int,
    borrowers: wp.array[int],
    points: PointArrays,
    there: Neighbourhood,
    sides: wp.array[wp.uint8],
    # in and out; who lends is not written to
    light: LightSums,
):
    p = borrowers[first + wp.tid()]
    specular = wp.vec3(0.0, 0.0, 0.0)
    variance = wp.float32(0.0)
    count = wp.float32(0.0)
    for side in range(SIDES):
        if (int(sides[p]) & (1 << side)) != 0:
            q = point_beside(points, there, p, side)
            s = specular_reflectance(points.albedo[q], points.metallic[q])
            specular += wp.cw_div(light.specular[q], s)
            variance += light.variance[q][2] / mean_square(s)
            count += 1.0
    own = specular_reflectance(points.albedo[p], points.metallic[p])
    light.specular[p] = wp.cw_mul(own, specular / count)
    light.variance[p] = wp.vec3(0.0, 0.0, mean_square(own) * variance / (count * count))


def find_lenders(primary: PrimaryPoints, verdict: Tensor, there: Any) -> Lenders:
    """Of a moving picture's points.

    Args:
        verdict: LightThere's. there: Neighbourhood.
    """
    sides = torch.empty(len(verdict), dtype=torch.uint8, device=verdict.device)
    inputs = [point_arrays(primary.points), warp_array(primary.depth), warp_array(verdict), there]
    launch(look_for_lenders, len(verdict), inputs, [warp_array(sides)], warp_device(verdict))
    borrows, read = sides > 0, verdict == int(READ)
    with_rays, borrowers = (torch.nonzero(chosen).squeeze(-1).int() for chosen in (read & ~borrows, borrows))
    return Lenders(with_rays, borrowers, warp_array(sides), there)


def lend_specular(lenders: Lenders, primary: PrimaryPoints, light: ShadedPoints) -> None:
    """Write what borrowers mirror into `light`, which has that of all others."""
    inputs = [warp_array(lenders.borrowers), point_arrays(primary.points), lenders.there, lenders.sides]
    launch(lend, len(lenders.borrowers), inputs, [light_sums(light)], warp_device(light.specular))
