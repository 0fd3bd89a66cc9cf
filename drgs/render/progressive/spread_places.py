"""Where passes look: more often through pixels whose places differ, less often through those whose places agree.

In: sums so far. Out: rates, and from them the camera rays of a pass. A pass costs about what it would cost without; which pixels it goes to is decided
anew when passes have doubled, of each row of tiles by itself, so that a picture does not depend on its bands.

What a pixel's own places have found has no part in how many it gets, or the mean would not stay exact: bright finds would be followed by more places than
dark ones. Its neighbours decide, whose places know nothing of its own.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Int
from torch import Tensor

from drgs.render.progressive.frame_sums import DARK, FrameSums
from drgs.render.visible.image_tiles import TILE, tile_grid

FIRST_LOOK = 4
"""Passes before rates are decided first; fewer say too little. Every rate has whole places in as many."""
ONE = 4
"""Rates are in quarters of a place a pass."""
LEAST, MOST = 2, 32
"""Rates are powers of two."""
EMPTY_COST = 0.2
"""Of a place that shows nothing, where one that shows a surface costs 1."""
ROUNDS = 6
"""Of the search for a row's scale, each of which corrects what rounding to powers of two has left."""


@dataclass(frozen=True, eq=False)
class Looks:
    """Camera rays of several passes; of a pixel, pass after pass."""

    pixels: Int[Tensor, "ray"]
    """int32, in the image."""
    rounds: Int[Tensor, "ray"]
    """int32, which of its pixel's places each looks through."""
    passes: Int[Tensor, "ray"]
    """int32, of which pass it is."""


def is_look(index: int) -> bool:
    """Whether rates are decided before pass `index`."""
    return index >= FIRST_LOOK and index & (index - 1) == 0


def next_look(index: int) -> int:
    """The first pass behind `index` before which rates are decided."""
    return max(FIRST_LOOK, 1 << index.bit_length())


def last_look(index: int) -> int:
    """The last one before which they were."""
    return 1 << (index.bit_length() - 1)


def decide_rates(sums: FrameSums, rates: Tensor | None, tiles: Tensor, width: int, height: int) -> Tensor:
    """(pixel,) int32 rates of chosen tiles (tile,) bool after the sums so far; the others keep theirs.

    Args:
        rates: so far; None: a place of each pixel a pass.
        width, height: of the frame [pixels].
    """
    if rates is None:
        rates = torch.full_like(sums.places, ONE, dtype=torch.int32)
    across, down = tile_grid(width, height)

    def rows(values: Tensor) -> Tensor:
        """(row of tiles, row, column); 0 below the image."""
        return torch.nn.functional.pad(values.view(height, width), (0, 0, 0, -height % TILE)).view(down, TILE, width)

    chosen = tiles.view(down, 1, across).repeat_interleave(TILE, 2)[..., :width].expand(down, TILE, width)
    count = rows(sums.places).clamp(min=1)
    mean = rows(sums.luminance) / count
    variance = (rows(sums.luminance_squared) / count - mean * mean).clamp(min=0) * count / (count - 1).clamp(min=1)
    found = rates_of_rows(mean, variance, rows(sums.weight) / count, chosen)
    return torch.where(chosen, found, rows(rates)).view(-1, width)[:height].reshape(-1).contiguous()


def rates_of_rows(mean: Tensor, variance: Tensor, covered: Tensor, chosen: Tensor) -> Tensor:
    """(row of tiles, row, column) int32 rates in quarters. Least error for a row's cost: in proportion to a place's scatter over the root of its cost.

    Args:
        mean: (row of tiles, row, column) luminance. variance: of one place's. covered: share of the places that show a surface.
        chosen: the pixels that share the cost.
    """
    # An error counts relative to what a pixel shows, which its neighbours only guess: where one of them is dark, it may be.
    around = _of_neighbours(torch.stack([variance, 1.0 / (mean * mean + DARK), covered]))
    cost = (EMPTY_COST + (1.0 - EMPTY_COST) * around[2]) * chosen
    wanted = torch.sqrt(around[0] * around[1] / cost.clamp(min=EMPTY_COST))
    budget, exponent = cost.sum((1, 2), keepdim=True), torch.log2(wanted)
    scale = budget / (cost * wanted).sum((1, 2), keepdim=True).clamp(min=1e-30)
    for _ in range(ROUNDS):
        rates = _powers_of_two(exponent + torch.log2(scale))
        scale = scale * budget / rates.mul_(cost).sum((1, 2), keepdim=True).clamp(min=1e-30)
    rates = _powers_of_two(exponent + torch.log2(scale)).mul_(ONE).int()
    # Without any light nothing says where to look, and light whose square is beyond float32 says it wrongly.
    is_known = torch.isfinite(wanted).flatten(1).all(1) & torch.isfinite(scale).flatten(1).all(1) & (wanted * chosen > 0).flatten(1).any(1)
    return torch.where(is_known[:, None, None], rates, ONE)


def _of_neighbours(values: Tensor) -> Tensor:
    """Mean of the eight pixels around each one, (..., row, column), as far as they lie in its row of tiles."""
    sums = torch.nn.functional.avg_pool2d(values, 3, 1, 1, divisor_override=1) - values
    count = torch.nn.functional.avg_pool2d(torch.ones_like(values[:1, :1]), 3, 1, 1, divisor_override=1) - 1.0
    return sums.div_(count.clamp(min=1)).clamp_(min=0)


def _powers_of_two(exponents: Tensor) -> Tensor:
    """The nearest that are allowed, of places a pass, to powers with these exponents; -inf is no place."""
    return torch.exp2(exponents.clamp(math.log2(LEAST / ONE), math.log2(MOST / ONE)).round())


def places_between(rates: Tensor, first: int, last: int) -> Tensor:
    """How many places pixels of these rates look through in the passes from `first` on, before `last`; no look lies between."""
    begin = last_look(first)
    return rates * (last - begin) // ONE - rates * (first - begin) // ONE


def list_looks(pixels: Tensor, first: int, last: int, rates: Tensor | None, places: Tensor | None) -> Looks:
    """The camera rays of the passes from `first` on, before `last`, through some pixels (pixel,) int32; no look lies between.

    Args:
        rates, places: (pixel,) int32 of these pixels, `places` before pass `first`; None: one place of each a pass.
    """
    if rates is None or places is None:
        passes = torch.arange(first, last, dtype=torch.int32, device=pixels.device).repeat_interleave(len(pixels))
        return Looks(pixels.repeat(last - first), passes, passes)
    count, begin = places_between(rates, first, last), last_look(first)
    before = torch.cumsum(count, 0, dtype=torch.int32) - count
    # All that a ray takes from its pixel at once; with its number in the list the second and last become its own.
    of_pixel = torch.stack([pixels, places - before, rates, rates * (first - begin) // ONE - before + 1], 1)
    pixel, place, rate, kth = of_pixel.repeat_interleave(count.long(), 0).unbind(1)
    number = torch.arange(len(pixel), dtype=torch.int32)
    # Place k behind a look comes in the first pass in which rate / ONE times the passes since that look reaches k.
    passes = begin - 1 + (ONE * (kth + number) + rate - 1) // rate
    return Looks(pixel.contiguous(), place + number, passes)


def count_places(sums: FrameSums, pixels: Tensor, rates: Tensor | None, first: int, last: int) -> None:
    """Book the places of the passes from `first` on, before `last`, of pixels (pixel,) int64 of the frame, in place."""
    sums.places[pixels] += last - first if rates is None else places_between(rates[pixels], first, last)
