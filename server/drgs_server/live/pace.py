"""How large a moving picture may be: from the measured cost of full-size ones, floored, so that it cannot spiral down.

Known failure of such controllers: small pictures cost more a pixel, so an estimate taken from them asks for still smaller ones, and
so on (service reference, 4.4). Hence: pictures at full size set the estimate, reduced ones only ever improve it, the scale has a
floor and few steps, and a change of step needs a clear reason.
"""

TARGET_SECONDS = 1 / 12
"""Wanted for one moving picture."""
STEPS = (1.0, 0.75, 0.5)
SMALLEST_SIDE = 240
"""Pixels; a picture that was asked for smaller than this is never reduced."""
HYSTERESIS = 1.25
"""A larger step is taken only if it would fit with this much to spare."""
_WEIGHT = 0.4
"""Of the newest measurement."""


class Pace:
    """Final. One a viewer; the state is the cost a pixel and the present step."""

    def __init__(self) -> None:
        self._seconds_per_pixel: float | None = None
        self._step = 0

    def measured(self, width: int, height: int, scale: float, seconds: float) -> None:
        """A first picture of `width` x `height` took this long; `scale` is its share of the asked-for width."""
        cost = seconds / (width * height)
        old = self._seconds_per_pixel
        if scale < 1 and (old is None or cost >= old):
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
        return STEPS[fits]
