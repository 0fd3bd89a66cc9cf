"""Lenses that bend straight lines: COLMAP's camera models, from a direction to a place on the picture.

In: a lens and directions in front of the camera, as places on the plane at distance 1 (OpenCV axes: x to the right, y down).
Out: pixels, centres at + 0.5, as in COLMAP and as everywhere here. The way back is not needed: a picture is undistorted by asking
for each pixel of the new one where it lies in the old one.

Sources: COLMAP's documentation of its camera models for names and parameters; the formulas are those of docs/sources.md: brown1966 (radial
and tangential), kannala2006 (fisheye), devernay2001 (FOV), fitzgibbon2001 (division), weng1992 (thin prism), khomutenko2016 (EUCM).
Panoramas (EQUIRECTANGULAR) are no lens: no pinhole picture shows what they show.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

PARAMETER_NAMES = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
    "OPENCV_FISHEYE": ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"),
    "FULL_OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "FOV": ("fx", "fy", "cx", "cy", "omega"),
    "SIMPLE_RADIAL_FISHEYE": ("f", "cx", "cy", "k"),
    "RADIAL_FISHEYE": ("f", "cx", "cy", "k1", "k2"),
    "THIN_PRISM_FISHEYE": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "sx1", "sy1"),
    "RAD_TAN_THIN_PRISM_FISHEYE": (
        "fx", "fy", "cx", "cy", "k0", "k1", "k2", "k3", "k4", "k5", "p0", "p1", "s0", "s1", "s2", "s3",
    ),
    "SIMPLE_DIVISION": ("f", "cx", "cy", "k"),
    "DIVISION": ("fx", "fy", "cx", "cy", "k"),
    "SIMPLE_FISHEYE": ("f", "cx", "cy"),
    "FISHEYE": ("fx", "fy", "cx", "cy"),
    "EUCM": ("fx", "fy", "cx", "cy", "alpha", "beta"),
}  # fmt: skip
"""COLMAP's models in the order of their numbers, with their parameters in the order of its files; focal lengths and principal points [pixels]."""
BENT_WITHOUT_COEFFICIENTS = ("OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "THIN_PRISM_FISHEYE",
                             "RAD_TAN_THIN_PRISM_FISHEYE", "SIMPLE_FISHEYE", "FISHEYE")  # fmt: skip
"""Models that are no pinhole with all coefficients zero."""
STRAIGHT_OMEGA = 1e-4
"""[rad] a field of view below which the FOV model is the pinhole: there its formula divides zero by zero."""

Coordinates = Float64[ndarray, "*places"]


@dataclass(frozen=True)
class Lens:
    """How the pictures of one camera were taken, as it was calibrated."""

    model: str
    """A key of PARAMETER_NAMES."""
    parameters: tuple[float, ...]
    """In COLMAP's order."""
    width: int
    """Of the picture that the lens made [pixels]."""
    height: int

    @property
    def focal_lengths(self) -> tuple[float, float]:
        """(fx, fy) [pixels]."""
        return (self.parameters[0], self.parameters[0 if PARAMETER_NAMES[self.model][0] == "f" else 1])

    @property
    def principal_point(self) -> tuple[float, float]:
        """(cx, cy) [pixels]."""
        at = PARAMETER_NAMES[self.model].index("cx")
        return (self.parameters[at], self.parameters[at + 1])

    @property
    def coefficients(self) -> tuple[float, ...]:
        """What bends: the parameters after the principal point."""
        return self.parameters[PARAMETER_NAMES[self.model].index("cy") + 1 :]

    @property
    def is_pinhole(self) -> bool:
        """Straight lines stay straight."""
        if self.model == "EUCM":
            return self.coefficients[0] == 0
        return self.model not in BENT_WITHOUT_COEFFICIENTS and not any(self.coefficients)


def pixels_from_plane(lens: Lens, plane: Float64[ndarray, "*places 2"]) -> Float64[ndarray, "*places 2"]:
    """Where the picture shows what lies in the directions (x, y, 1) [pixels].

    NaN or infinite, without a warning, where the model's formula ends.
    """
    bend = _BENDS.get(lens.model)
    x, y = plane[..., 0], plane[..., 1]
    with np.errstate(all="ignore"):
        bent_x, bent_y = (x, y) if bend is None else bend(x, y, lens.coefficients)
        (fx, fy), (cx, cy) = lens.focal_lengths, lens.principal_point
        return np.stack([fx * bent_x + cx, fy * bent_y + cy], -1)


def _polynomial(square: Coordinates, coefficients: tuple[float, ...]) -> Coordinates:
    """1 + c0 s + c1 s^2 + ..."""
    value = np.zeros_like(square)
    for coefficient in reversed(coefficients):
        value = (value + coefficient) * square
    return 1 + value


def _tangential(x: Coordinates, y: Coordinates, p1: float, p2: float) -> tuple[Coordinates, Coordinates]:
    """What decentred elements add to x and to y."""
    square, product = x * x + y * y, 2 * x * y
    return p1 * product + p2 * (square + 2 * x * x), p2 * product + p1 * (square + 2 * y * y)


def _radial(x: Coordinates, y: Coordinates, k: tuple[float, ...]) -> tuple[Coordinates, Coordinates]:
    scale = _polynomial(x * x + y * y, k)
    return scale * x, scale * y


def _opencv(x: Coordinates, y: Coordinates, coefficients: tuple[float, ...]) -> tuple[Coordinates, Coordinates]:
    k1, k2, p1, p2, *rest = coefficients
    square = x * x + y * y
    scale = _polynomial(square, (k1, k2, *rest[:1])) / _polynomial(square, tuple(rest[1:]))
    more_x, more_y = _tangential(x, y, p1, p2)
    return scale * x + more_x, scale * y + more_y


def _fov(x: Coordinates, y: Coordinates, coefficients: tuple[float, ...]) -> tuple[Coordinates, Coordinates]:
    omega = coefficients[0]
    if abs(omega) < STRAIGHT_OMEGA:
        return x, y
    radius, slope = np.hypot(x, y), 2 * np.tan(omega / 2)
    scale = np.where(radius > 0, np.arctan(radius * slope) / np.where(radius > 0, radius, 1), slope) / omega
    return scale * x, scale * y


def _equidistant(x: Coordinates, y: Coordinates) -> tuple[Coordinates, Coordinates]:
    """The direction's angle from the axis [rad], as a place at that distance from the middle."""
    radius = np.hypot(x, y)
    scale = np.where(radius > 0, np.arctan(radius) / np.where(radius > 0, radius, 1), 1)
    return scale * x, scale * y


def _fisheye(x: Coordinates, y: Coordinates, k: tuple[float, ...]) -> tuple[Coordinates, Coordinates]:
    return _radial(*_equidistant(x, y), k)


def _thin_prism_fisheye(x: Coordinates, y: Coordinates, coefficients: tuple[float, ...]) -> tuple[Coordinates, Coordinates]:
    k1, k2, p1, p2, k3, k4, sx1, sy1 = coefficients
    x, y = _equidistant(x, y)
    square = x * x + y * y
    scale, (more_x, more_y) = _polynomial(square, (k1, k2, k3, k4)), _tangential(x, y, p1, p2)
    return scale * x + more_x + sx1 * square, scale * y + more_y + sy1 * square


def _rad_tan_thin_prism_fisheye(x: Coordinates, y: Coordinates, coefficients: tuple[float, ...]) -> tuple[Coordinates, Coordinates]:
    p0, p1, s0, s1, s2, s3 = coefficients[6:]
    x, y = _fisheye(x, y, coefficients[:6])
    square = x * x + y * y
    more_x, more_y = _tangential(x, y, p1, p0)  # here the first one belongs to x
    return x + more_x + square * (s0 + s1 * square), y + more_y + square * (s2 + s3 * square)


def _division(x: Coordinates, y: Coordinates, coefficients: tuple[float, ...]) -> tuple[Coordinates, Coordinates]:
    """Of the two places p with p / (1 + k |p|^2) = (x, y) the nearer one."""
    scale = 2 / (1 + np.sqrt(1 - 4 * coefficients[0] * (x * x + y * y)))
    return scale * x, scale * y


def _eucm(x: Coordinates, y: Coordinates, coefficients: tuple[float, ...]) -> tuple[Coordinates, Coordinates]:
    alpha, beta = coefficients
    below = alpha * np.sqrt(beta * (x * x + y * y) + 1) + 1 - alpha
    return x / below, y / below


_BENDS: dict[str, Callable[[Coordinates, Coordinates, tuple[float, ...]], tuple[Coordinates, Coordinates]]] = {
    "SIMPLE_RADIAL": _radial,
    "RADIAL": _radial,
    "OPENCV": _opencv,
    "OPENCV_FISHEYE": _fisheye,
    "FULL_OPENCV": _opencv,
    "FOV": _fov,
    "SIMPLE_RADIAL_FISHEYE": _fisheye,
    "RADIAL_FISHEYE": _fisheye,
    "THIN_PRISM_FISHEYE": _thin_prism_fisheye,
    "RAD_TAN_THIN_PRISM_FISHEYE": _rad_tan_thin_prism_fisheye,
    "SIMPLE_DIVISION": _division,
    "DIVISION": _division,
    "SIMPLE_FISHEYE": _fisheye,
    "FISHEYE": _fisheye,
    "EUCM": _eucm,
}
"""From the plane at distance 1 to where focal lengths take it from; the models that are not here are pinholes."""
