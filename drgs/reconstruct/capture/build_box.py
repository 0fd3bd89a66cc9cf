"""The box that a build is kept in: what lies outside is not built.

Its sides are those of the asset's world, which is the capture's, turned so that z is up (turn_up). In: two corners. Out: what it holds, and places moved
into it. Who cuts by it: the hull (visual_hull), the masks (cut_to_box), the first mesh (fuse_depth), and the surface whenever it moves (moving_surface).
"""

import math
from dataclasses import dataclass

from jaxtyping import Bool, Float
from torch import Tensor

Corner = tuple[float, float, float]


@dataclass(frozen=True)
class BuildBox:
    """Two opposite corners [world units].

    Raises:
        ValueError: they span no box.
    """

    low: Corner
    high: Corner

    def __post_init__(self) -> None:
        finite = all(math.isfinite(value) for value in (*self.low, *self.high))
        if not finite or not all(low < high for low, high in zip(self.low, self.high, strict=True)):
            raise ValueError(f"box: {self} is none, expected two finite corners, each number of the first below that of the second.")

    def __str__(self) -> str:
        return " to ".join("(" + ", ".join(f"{value:g}" for value in corner) + ")" for corner in (self.low, self.high))

    @property
    def center(self) -> Corner:
        x, y, z = ((low + high) / 2 for low, high in zip(self.low, self.high, strict=True))
        return x, y, z

    @property
    def longest_half(self) -> float:
        """Half the longest side."""
        return max(high - low for low, high in zip(self.low, self.high, strict=True)) / 2

    @property
    def radius(self) -> float:
        """Of the sphere around it."""
        return math.dist(self.low, self.high) / 2

    def holds(self, points: Float[Tensor, "point 3"]) -> Bool[Tensor, "point"]:
        """Whether each point lies in it; NaN does not."""
        return ((points >= points.new_tensor(self.low)) & (points <= points.new_tensor(self.high))).all(-1)

    def clamped(self, points: Float[Tensor, "point 3"]) -> Float[Tensor, "point 3"]:
        """Each point, or the nearest place of the box."""
        return points.clamp(points.new_tensor(self.low), points.new_tensor(self.high))


def whole_or_within(box: BuildBox | None, points: Float[Tensor, "point 3"]) -> Float[Tensor, "point 3"]:
    """The points themselves where there is no box."""
    return points if box is None else box.clamped(points)
