"""How large a moving picture may be: from the measured cost of full-size ones, floored, so that it cannot spiral down.

Known failure of such controllers: small pictures cost more a pixel, so an estimate taken from them asks for still smaller ones, and
so on (service reference, 4.4). Hence: pictures at full size set the estimate, reduced ones only ever improve it, the scale has a
floor and few steps, and a change of step needs a clear reason. For the same reason an estimate from a slow moment, such as a session's first
pictures, would keep them small for ever: now and then one is tried a step larger, and what it costs counts like one at full size. And reduced ones that take longer than wanted do ask for
smaller ones: others may have come to use the machine.
"""

TARGET_SECONDS = 1 / 13
"""Wanted for one moving picture, so that twelve a second come though some are late."""
REDUCED_SECONDS = 1 / 15
"""From one reduced picture to the next at least: what is left is for those who made the reduction necessary."""
CROWDED_SHARE = 0.8
"""Of the time that reduced pictures take at most where others want the cores: on a slow day they take all of REDUCED_SECONDS, and leave nothing."""
STEPS = (1.0, 0.75, 0.6, 0.5)
SMALLEST_SIDE = 240
"""Pixels; a picture that was asked for smaller than this is never reduced."""
HYSTERESIS = 1.25
"""A larger step is taken only if it would fit with this much to spare."""
TRIED_AFTER = (24, 192)
"""Reduced pictures before one that is tried a step larger, at first, and at most: each that was too slow doubles them."""
MOST_TRIED = 2.0
"""Times the wanted seconds, which the larger one is expected to take at most."""
_WEIGHT = 0.4
"""Of the newest measurement."""


class Pace:
    """Final. One a viewer; the state is the cost a pixel, the present step, and when a larger one is tried."""

    def __init__(self) -> None:
        self._seconds_per_pixel: float | None = None
        self._step = 0
        self._reduced = 0
        """Pictures since the last one that was tried larger."""
        self._tried_after = TRIED_AFTER[0]
        self._trying = False

    def measured(self, width: int, height: int, scale: float, seconds: float) -> None:
        """A first picture of `width` x `height` took this long; `scale` is its share of the asked-for width."""
        cost = seconds / (width * height)
        old, tried, self._trying = self._seconds_per_pixel, self._trying, False
        too_slow = seconds > TARGET_SECONDS
        if scale < 1 and not tried and (old is None or cost >= old) and not too_slow:
            return
        self._seconds_per_pixel = cost if old is None else old + _WEIGHT * (cost - old)

    def scale(self, width: int, height: int) -> float:
        """Share of the width (and height) for the next moving picture, at least 1/2."""
        if self._seconds_per_pixel is None:
            return STEPS[self._step]
        full = self._seconds_per_pixel * width * height
        fits = next((k for k, step in enumerate(STEPS) if full * step**2 <= TARGET_SECONDS), len(STEPS) - 1)
        if fits < self._step:
            spare = next((k for k, step in enumerate(STEPS) if full * step**2 * HYSTERESIS <= TARGET_SECONDS), len(STEPS) - 1)
            fits = min(self._step, spare)
        while fits > 0 and min(width, height) * STEPS[fits] < SMALLEST_SIDE:
            fits -= 1
        self._step = fits
        return STEPS[fits - self._try_larger(full)]

    def _try_larger(self, full_seconds: float) -> bool:
        """Whether the next picture is one step larger than the cost so far asks for."""
        if self._step == 0:
            self._reduced, self._tried_after = 0, TRIED_AFTER[0]
            return False
        self._reduced += 1
        if self._reduced <= self._tried_after or full_seconds * STEPS[self._step - 1] ** 2 > MOST_TRIED * TARGET_SECONDS:
            return False
        self._reduced, self._tried_after = 0, min(2 * self._tried_after, TRIED_AFTER[1])
        self._trying = True
        return True
