"""Maps in planes, one number of each pixel after another, as the filter that takes sixteen pixels at once reads them.

In: the size of a picture. Out: zeros, kept from picture to picture. Planes are `height` rows of `pitch` pixels, of which PAD at both ends are empty.
"""

import threading
from pathlib import Path

import torch
import warp as wp
from torch import Tensor

from drgs.warp_torch import warp_array

PAD = wp.constant(32)
"""Empty pixels at both ends of a row: as far as the widest kernel reaches."""
VARIANCE, LIGHT_PLANES = wp.constant(8), wp.constant(10)
"""Of light in planes: diffuse and specular, the luminance of both, the variance of both."""
MOST_KEPT_NUMBERS = 1 << 24
"""In the planes, 67 MB of them, that are kept for the next picture: 500 000 pixels with their pads."""
PLANE_ROUND, PLANE_SKEW = 1024, 80
"""Planes begin a whole number of 4096 bytes and five cache lines after each other: a round reads eighteen of them at once, and where they are all
as far from a multiple of 4096 bytes, as of windows of 384 rows of 256 pixels, they drive each other out of the first cache."""
PLANES = Path(__file__).with_name("planes.h")
PLANES_APART = {"PLANE_ROUND": PLANE_ROUND, "PLANE_SKEW": PLANE_SKEW}


class Planes:
    """Final. What pictures of one size are filtered in."""

    def __init__(self, height: int, width: int, memory: Tensor | None = None) -> None:
        """
        Args:
            memory: taken, and set to 0, where there is enough of it.
        """
        # An odd number of cache lines, so that rows lie in different parts of the cache, as planes do.
        self.pitch = 16 * (-(-width // 16) | 1) + 2 * PAD
        self.apart = -(-height * self.pitch // PLANE_ROUND) * PLANE_ROUND + PLANE_SKEW
        count = 8 + 2 + 2 * int(LIGHT_PLANES)
        if memory is None or len(memory) < count * self.apart:
            memory = torch.zeros(count * self.apart)
        else:
            memory[: count * self.apart].zero_()
        self.memory = memory
        every = memory[: count * self.apart].view(count, self.apart)[:, : height * self.pitch].view(count, height, self.pitch)
        self.guides, self.smooth, self.light, self.other = every.split([8, 2, LIGHT_PLANES, LIGHT_PLANES])

    def new_light(self) -> Tensor:
        """(LIGHT_PLANES, height, pitch) zeros of their own."""
        height, pitch = self.light.shape[1:]
        return torch.zeros(LIGHT_PLANES, self.apart)[:, : height * pitch].view(LIGHT_PLANES, height, pitch)


class _PlanesOfThread(threading.local):
    """Final. Each thread's own, kept from picture to picture: memory asked for anew costs more than a round reads."""

    def __init__(self) -> None:
        self._shape, self._planes = (0, 0), Planes(0, 0)

    def fit(self, height: int, width: int) -> Planes:
        """For a picture of this size. Guides and light may still hold another picture's, but for both ends of each row, which are 0, as the other
        light is. Planes of large pictures are not kept."""
        if self._shape == (height, width):
            self._planes.other.zero_()
            return self._planes
        planes = Planes(height, width, self._planes.memory)
        if len(planes.memory) <= MOST_KEPT_NUMBERS:
            self._shape, self._planes = (height, width), planes
        return planes


_of_thread = _PlanesOfThread()


def planes_for(height: int, width: int) -> Planes:
    """The calling thread's, for a picture of this size; until the thread asks again."""
    return _of_thread.fit(height, width)


def flat(planes: Tensor) -> wp.array:
    """From the first number of the first plane to the last of the last."""
    count, size, apart = len(planes), planes[0].numel(), planes.stride(0)
    return warp_array(planes.as_strided(((count - 1) * apart + size,), (1,)))
