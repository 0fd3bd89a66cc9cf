"""Gains of photographs from how much more each was exposed than the others, and what cameras wrote of it into their files.

In: stops, or exposures. Out: gains, whose logarithms have the mean 0. Knows neither views nor points, so that reading cameras loads nothing
that finds these (exposures.py).
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from numpy import ndarray

WRITTEN_STOPS = 0.05
"""Spread of what cameras wrote into their files; less is rounding."""
MOST_STOPS = 4.0
"""Of a gain, either way: more is a picture of something else."""


def gains_of_files(exposures: Sequence[float | None]) -> tuple[float, ...] | None:
    """What cameras wrote into their files; None where one did not, or all are alike.

    Args:
        exposures: time times sensitivity over the f-number's square.
    """
    if not exposures or any(exposure is None for exposure in exposures):
        return None
    stops = np.log2(np.array(exposures, np.float64))
    return gains_of_stops(stops) if spread(stops) > WRITTEN_STOPS else None


def gains_of_stops(stops: Float[ndarray, "view"]) -> tuple[float, ...]:
    """Relative to their mean; what is not known (nan) is taken for it."""
    known = np.isfinite(stops)
    mean = float(stops[known].mean()) if known.any() else 0.0
    centred = np.where(known, stops - mean, 0.0)
    return tuple((2.0 ** np.clip(centred, -MOST_STOPS, MOST_STOPS)).tolist())


def spread(stops: Sequence[float] | Float[ndarray, "view"]) -> float:
    """Standard deviation of what is known; 0 where nothing is."""
    known = np.array(stops)[np.isfinite(stops)]
    return float(known.std()) if len(known) else 0.0
