"""A chair and a machine of toy bricks: thin rods, slats with gaps, flat faces with sharp edges, studs, wheels below a body.

In: how finely they are cut. Out: triangle meshes in the unit ball, z up, with paint: woven cloth, wood and brass; plastic of four colours, rubber and steel.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from benchmarks.scenes.fields import CELLS, Field, Paint, grid, painted, rod, rounded_box
from drgs.scene.mesh import TriangleMesh

SEAT = -0.12
"""Height of the chair's cushion above its middle."""
LEG = 0.036
STUD, PITCH = 0.052, 0.16
"""Radius of a brick's stud, and from one stud to the next."""
BRICK = 0.2
"""Its height."""
WHEEL = 0.2

Box = tuple[tuple[float, float, float], tuple[float, float, float], int]
"""Lower and upper corner in studs and bricks; which colour."""

BRICKS: Sequence[Box] = (
    ((-5, -2, 0), (5, 2, 0.5), 3),
    ((-5, -2, 0.5), (-1, 2, 1.5), 0),
    ((-4, -2, 1.5), (-2, 2, 2.5), 1),
    ((-1, -2, 0.5), (5, -1, 1.5), 2),
    ((-1, 1, 0.5), (5, 2, 1.5), 2),
    ((3, -1, 0.5), (4, 1, 2.5), 1),
    ((-4, -1, 2.5), (-2, 1, 3.0), 0),
)
COLOURS = ((0.62, 0.03, 0.03), (0.75, 0.5, 0.03), (0.04, 0.13, 0.5), (0.3, 0.32, 0.33))
LOW = -0.3
"""Where the lowest brick begins."""


def chair(cells: int = CELLS) -> TriangleMesh:
    x, y, z = grid(cells)
    shape = rounded_box(x, y, z - SEAT, (0.42, 0.42, 0.06), 0.05)
    for along in (-0.37, 0.37):
        for across in (-0.37, 0.37):
            shape = np.minimum(shape, rod(x - along * (1 + 0.12 * (SEAT - z)), y - across * (1 + 0.12 * (SEAT - z)), z, LEG, -0.85, SEAT))
        shape = np.minimum(shape, rod(x - along - 0.05 * (z - SEAT), y - 0.38, z, LEG, SEAT, 0.85))
        shape = np.minimum(shape, rod(x - along * 1.04, z + 0.5, y, 0.022, -0.38, 0.38))
    for height in (0.25, 0.78):
        shape = np.minimum(shape, rounded_box(x, y - 0.38, z - height, (0.38, 0.022, 0.05), 0.015))
    for along in np.linspace(-0.24, 0.24, 5):
        shape = np.minimum(shape, rounded_box(x - along, y - 0.38, z - 0.5, (0.028, 0.012, 0.26), 0.01))
    return painted(shape, _paint_of_chair)


def _paint_of_chair(places: Float[ndarray, "vertex 3"]) -> Paint:
    x, y, z = places.T
    grain = np.sin(60 * x + 9 * np.sin(7 * z)) * np.sin(50 * y + 5 * np.sin(9 * z))
    albedo = np.array([0.3, 0.14, 0.06]) * (1 + 0.35 * grain[:, None])
    roughness, metallic = np.full(len(x), 0.4), np.zeros(len(x))
    cloth = (np.abs(z - SEAT) < 0.065) & (np.maximum(np.abs(x), np.abs(y)) < 0.425)
    weave = np.sign(np.sin(42 * x) * np.sin(42 * y))[:, None]
    albedo[cloth] = (np.array([0.32, 0.3, 0.22]) + weave * np.array([0.18, 0.14, 0.05]))[cloth]
    roughness[cloth] = 0.9
    brass = (z < -0.74) | (z > 0.83)
    albedo[brass], roughness[brass], metallic[brass] = (0.87, 0.68, 0.33), 0.25, 1.0
    return albedo, roughness, metallic


def bricks(cells: int = CELLS) -> TriangleMesh:
    x, y, z = grid(cells)
    shape = np.full_like(x, 9.0)
    for low, high, _ in BRICKS:
        shape = np.minimum(shape, _brick(x, y, z, low, high))
        top = LOW + high[2] * BRICK
        if high[2] == 0.5:
            continue
        for i in np.arange(low[0] + 0.5, high[0]):
            for j in np.arange(low[1] + 0.5, high[1]):
                shape = np.minimum(shape, rod(x - i * PITCH, y - j * PITCH, z, STUD, top - 0.01, top + 0.045))
    for along in (-0.5, 0.5):
        for side in (-1, 1):
            wheel = rod(x - along, z - LOW, y - side * 0.43, WHEEL, -0.08, 0.08)
            hub = rod(x - along, z - LOW, y - side * 0.52, 0.1, -0.06, 0.06)
            shape = np.minimum(shape, np.maximum(wheel, -hub))
        shape = np.minimum(shape, rod(x - along, z - LOW, y, 0.05, -0.5, 0.5))
    return painted(shape, _paint_of_bricks)


def _paint_of_bricks(places: Float[ndarray, "vertex 3"]) -> Paint:
    x, y, z = places.T
    nearest, which = np.full(len(x), 9.0), np.zeros(len(x), int)
    for low, high, color in BRICKS:
        far = np.abs(_brick(x, y, z, low, (high[0], high[1], high[2] + 0.3)))
        which, nearest = np.where(far < nearest, color, which), np.minimum(far, nearest)
    albedo, roughness, metallic = np.array(COLOURS)[which], np.full(len(x), 0.22), np.zeros(len(x))
    rubber = np.stack([np.hypot(x - along, z - LOW) for along in (-0.5, 0.5)]).min(0) < WHEEL + 0.01
    rubber &= np.abs(y) > 0.345
    steel = rubber & (np.stack([np.hypot(x - along, z - LOW) for along in (-0.5, 0.5)]).min(0) < 0.098)
    albedo[rubber], roughness[rubber] = (0.03, 0.03, 0.03), 0.7
    albedo[steel], roughness[steel], metallic[steel] = (0.6, 0.59, 0.57), 0.2, 1.0
    return albedo, roughness, metallic


def _brick(x: Field, y: Field, z: Field, low: Sequence[float], high: Sequence[float]) -> Field:
    middle = [(a + b) / 2 for a, b in zip(low, high, strict=True)]
    half = [(b - a) / 2 for a, b in zip(low, high, strict=True)]
    return rounded_box(
        x - middle[0] * PITCH,
        y - middle[1] * PITCH,
        z - LOW - middle[2] * BRICK,
        (half[0] * PITCH - 0.004, half[1] * PITCH - 0.004, half[2] * BRICK),
        0.008,
    )
