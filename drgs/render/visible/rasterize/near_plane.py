"""The distance before which no surfel is drawn: a share of the object's size, so that pictures and fits know no unit."""

from torch import Tensor

NEAR_SHARE = 0.01
"""Of the object's radius."""


def near_plane(radius: float) -> float:
    """Distance from the camera that drawing starts at [world units]; radius: of the object's bounding sphere [world units]."""
    return NEAR_SHARE * radius


def near_plane_of(centers: Tensor) -> float:
    """The same where only surfels are known: half the longest side of the box of their centres (surfel, 3) stands for the radius; 0 for none."""
    if len(centers) == 0:
        return 0.0
    low, high = centers.detach().aminmax(dim=0)
    return near_plane(0.5 * float((high - low).max()))
