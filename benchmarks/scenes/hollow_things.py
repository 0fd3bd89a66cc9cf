"""A mug and a potted plant: most of what their hulls hold is empty, and no outline shows it.

In: how finely they are cut. Out: triangle meshes in the unit ball, z up, with paint: bands of gold and glaze on the mug, stripes on thin leaves.
"""

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from benchmarks.scenes.fields import CELLS, Paint, blended, grid, painted, rounded_cylinder
from drgs.scene.mesh import TriangleMesh

MUG_HEIGHT, MUG_RADIUS, WALL = 1.24, 0.5, 0.06
LEAVES = 9
LEAF = 0.012
"""Half the thickness; a pixel of 400 is 0.006."""


def mug(cells: int = CELLS) -> TriangleMesh:
    """A glazed mug that is empty to its floor."""
    x, y, z = grid(cells)
    radius, top = np.hypot(x, y), MUG_HEIGHT / 2
    outside = rounded_cylinder(radius, z, MUG_RADIUS, -top, top)
    inside = rounded_cylinder(radius, z, MUG_RADIUS - WALL, WALL - top, 2 * top)
    ring = np.hypot(x - 0.52, 0.8 * z) - 0.3
    handle = np.maximum(np.hypot(ring, y) - 0.06, MUG_RADIUS - WALL / 2 - radius)
    return painted(blended(np.maximum(outside, -inside), handle, 0.05), _paint_of_mug)


def _paint_of_mug(places: Float[ndarray, "vertex 3"]) -> Paint:
    x, y, z = places.T
    radius, angle, top = np.hypot(x, y), np.arctan2(y, x), MUG_HEIGHT / 2
    inner = (radius < MUG_RADIUS - WALL / 2) & (z > WALL - top)
    striped = (np.sin(9 * angle + 4 * np.sin(6 * z)) > 0.55) & ~inner & (radius < MUG_RADIUS + 0.03) & (z < 0.45)
    albedo, roughness = np.tile([0.05, 0.16, 0.36], (len(x), 1)), np.full(len(x), 0.22)
    for where, color, rough in (
        (striped, (0.75, 0.62, 0.42), 0.45),
        (inner, (0.78, 0.76, 0.72), 0.3),
        (z > 0.5, (0.9, 0.66, 0.3), 0.18),
        (z < 0.02 - top, (0.5, 0.42, 0.35), 0.8),
    ):
        albedo[where], roughness[where] = color, rough
    return albedo, roughness, (z > 0.5).astype(float)


def plant(cells: int = CELLS) -> TriangleMesh:
    """Leaves two pixels thick in a pot of earth."""
    x, y, z = grid(cells)
    radius = np.hypot(x, y)
    rim = 0.34 + 0.18 * (z + 0.85)
    pot = np.maximum(np.maximum(radius - rim, -(z + 0.9)), z + 0.35)
    above_earth = np.maximum(np.maximum(radius - (rim - 0.05), -(z + 0.45)), z - 0.1)
    shape, random = np.maximum(pot, -above_earth), np.random.default_rng(3)
    for number in range(LEAVES):
        angle = 2 * np.pi * number / LEAVES + 0.3 * random.random()
        length, lean, width = 0.75 + 0.35 * random.random(), 0.35 + 0.6 * random.random(), 0.13 + 0.06 * random.random()
        outward, aside = np.cos(angle) * x + np.sin(angle) * y, np.cos(angle) * y - np.sin(angle) * x
        height = np.clip(z + 0.5, 0, length)
        steepness = np.hypot(1, 2 * lean * height / length)
        sheet = np.abs(outward - 0.05 - lean * height**2 / length - 0.1 * aside**2 / width) / steepness - LEAF
        half = width * np.sin(np.pi * (height / length) ** 0.7) + 0.015
        shape = np.minimum(shape, np.maximum(np.maximum(sheet, np.abs(aside) - half), np.maximum(z + 0.5 - length, -0.52 - z)))
    return painted(shape, _paint_of_plant)


def _paint_of_plant(places: Float[ndarray, "vertex 3"]) -> Paint:
    x, y, z = places.T
    radius, stripes = np.hypot(x, y), np.sin(40 * z + 13 * np.arctan2(y, x))
    albedo, roughness = np.array([0.1, 0.32, 0.06]) + stripes[:, None] * np.array([0.06, 0.1, 0.02]), np.full(len(x), 0.35)
    of_pot = (z < -0.33) & (radius > 0.29)
    earth = (z < -0.4) & ~of_pot
    albedo[of_pot], roughness[of_pot] = (0.55, 0.22, 0.12), 0.75
    albedo[earth], roughness[earth] = (0.08, 0.05, 0.035), 0.95
    return albedo, roughness, np.zeros(len(x))
