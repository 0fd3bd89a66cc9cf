"""When a tile of the image is good enough: running variance in, tiles that need more rays out.

A pixel's error is the standard deviation of its mean luminance over sqrt(luminance^2 + DARK), the pixel's part of the relative mean
squared error that benchmarks report; a tile's is the root mean square over its pixels, widened to the worst of its neighbours, since
noise that a few passes did not show yet is rarely alone. Tiles are looked at when their passes have doubled: to stop whenever the
estimate happens to be small would favour dark estimates.
"""

import torch
from torch import Tensor

from drgs.render.progressive.frame_state import FrameState
from drgs.render.progressive.frame_sums import DARK
from drgs.render.visible.image_tiles import TILE, Window, tile_grid

MIN_PASSES = 8
"""Fewer say too little about the variance."""


def mean_variance(luminance: Tensor, luminance_squared: Tensor, scatter: Tensor, passes: Tensor) -> Tensor:
    """(pixel,) variance of the mean over passes of the luminance; from the scatter inside the one pass where there is no second.

    Args:
        luminance, luminance_squared: sums over passes, 0 for a pass that found no surface. scatter: sum of the passes' own estimates.
    """
    count = passes.clamp(min=1)
    mean = luminance / count
    between = (luminance_squared / count - mean * mean).clamp(min=0) / (count - 1).clamp(min=1)
    return torch.where(passes > 1, between, scatter)


def tile_errors(luminance: Tensor, variance: Tensor, covered: Tensor, width: int, height: int) -> Tensor:
    """(tile,) relative error of each tile and its neighbours; 0 where nothing is covered.

    Args:
        luminance, variance: (pixel,) mean and variance of the mean. covered: (pixel,) bool.
    """
    across, down = tile_grid(width, height)
    square = torch.where(covered, variance / (luminance.square() + DARK), 0.0)
    maps = torch.nn.functional.pad(torch.stack([square, covered.float()]).view(2, height, width), (0, -width % TILE, 0, -height % TILE))
    total, count = maps.view(2, down, TILE, across, TILE).sum((2, 4))
    mean = (total / count.clamp(min=1)).view(1, 1, down, across)
    return torch.nn.functional.max_pool2d(mean, 3, 1, 1).reshape(-1).sqrt()


def tiles_to_go_on(errors: Tensor, passes: Tensor, target: float) -> Tensor:
    """(tile,) bool: tiles above the target, and those that have had too few passes to tell or are between two looks."""
    looked_at = (passes >= MIN_PASSES) & ((passes & (passes - 1)) == 0)
    return ~looked_at | (errors > target)


def frame_errors(state: FrameState) -> Tensor:
    """(tile,) relative error of each tile of a frame so far (tile_errors); 0 outside the window."""
    sums, window, places = state.sums, state.window, state.places_in_window
    luminance = state.in_window(sums.luminance)
    variance = mean_variance(luminance, state.in_window(sums.luminance_squared), state.in_window(sums.scatter)[..., 0], places)
    mean = luminance / places.clamp(min=1)
    height, width = mean.shape
    errors = tile_errors(mean.flatten(), variance.flatten(), (state.in_window(sums.weight) > 0).flatten(), width, height)
    across, down = tile_grid(width, height)
    of_all = Window(*tile_grid(window.width, window.height)[::-1], *window.tiles)
    return of_all.pad(errors.view(down, across)).flatten()


def still_active(state: FrameState, active: Tensor) -> Tensor:
    """(tile,) bool: the active tiles without those below the error asked for."""
    target = state.inputs.settings.target_error
    return active.clone() if target is None else active & tiles_to_go_on(frame_errors(state), state.tiles.passes, target)
