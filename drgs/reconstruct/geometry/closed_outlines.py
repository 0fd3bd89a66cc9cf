"""Where masks end, to a fraction of a pixel: the closed lines of level 0.5.

In: a mask. Out: ClosedOutline, one a line.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.ndimage import map_coordinates
from skimage.measure import find_contours

SMOOTHED = 2
"""Neighbours on either side over which a mask's normals are averaged: single pixels have staircase normals."""


@dataclass(frozen=True, eq=False)
class ClosedOutline:
    """One closed line of a mask's level 0.5, as arrays of NumPy."""

    points: Float[ndarray, "point 2"]
    """[pixels; column and row, centres at +0.5]"""
    normals: Float[ndarray, "point 2"]
    """Unit, outwards."""
    lengths: Float[ndarray, "point"]
    """[pixels]"""


def closed_outlines(alpha: Float[ndarray, "height width"]) -> list[ClosedOutline]:
    """The outlines of a mask 0..1, but specks; where the object leaves the picture they follow its border."""
    padded, outlines = np.pad(alpha.astype(np.float64), 1), []
    for contour in find_contours(padded, 0.5):
        along = np.diff(contour, axis=0)
        length = np.linalg.norm(along, axis=1)
        some = length > 1e-6
        if some.sum() < 2 * SMOOTHED + 1:
            continue
        middle = 0.5 * (contour[1:] + contour[:-1])[some]
        normal = np.stack([along[some, 1], -along[some, 0]], 1) / length[some, None]
        outside, inside = (map_coordinates(padded, (middle + side * normal).T, order=1) for side in (1.0, -1.0))
        normal[outside > inside] *= -1
        normal = sum(np.roll(normal, shift, 0) for shift in range(-SMOOTHED, SMOOTHED + 1))
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
        # Padding moved everything by 1; pixel centres lie at +0.5.
        outlines.append(ClosedOutline(middle[:, ::-1] - 0.5, normal[:, ::-1], length[some]))
    return outlines
