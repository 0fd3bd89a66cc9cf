"""How often each colour occurs, as smoothed histograms of 8-bit sRGB, and what that says of a pixel.

In: colours as cell numbers. Out: shares of cells, and logarithms of how much more likely a colour is on the object than around it.
"""

from collections.abc import Iterable

import numpy as np
from jaxtyping import Bool, Float32, Int32, UInt8
from numpy import ndarray
from scipy import ndimage

BITS = 4
"""Of each channel: sixteen steps."""
STEPS = 1 << BITS
CELLS = STEPS**3
BLUR = 0.8
"""Standard deviation [steps]: light on one paint differs by about that."""

Shares = Float32[ndarray, "cell"]
"""Of each cell of colours; they sum to 1, or are 0 where nothing was counted."""


def cells_of(color_srgb: UInt8[ndarray, "height width 3"]) -> Int32[ndarray, "height width"]:
    """The number of each pixel's cell."""
    red, green, blue = (color_srgb[..., channel].astype(np.int32) >> (8 - BITS) for channel in range(3))
    return (red * STEPS + green) * STEPS + blue


def color_shares(counted: Iterable[tuple[Int32[ndarray, "height width"], Bool[ndarray, "height width"]]]) -> Shares:
    """Of the pixels that are chosen, over any number of pictures."""
    counts = np.zeros(CELLS)
    for cells, chosen in counted:
        counts += np.bincount(cells[chosen], minlength=CELLS)
    smooth = ndimage.gaussian_filter(counts.reshape(STEPS, STEPS, STEPS), BLUR, mode="nearest").reshape(-1)
    return (smooth / max(smooth.sum(), 1.0)).astype(np.float32)


def log_odds(inside: Shares, around: Shares, strays_inside: float, strays_around: float, most: float) -> Shares:
    """Of each cell, log(share inside / share around), at most `most` either way.

    Args:
        strays_inside, strays_around: share of colours that occur although nothing was counted of them.
    """
    uniform = np.float32(1 / CELLS)
    odds = np.log((1 - strays_inside) * inside + strays_inside * uniform) - np.log((1 - strays_around) * around + strays_around * uniform)
    return odds.clip(-most, most).astype(np.float32)
