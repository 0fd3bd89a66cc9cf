"""Upright panels on a base, from half a hundredth to three hundredths of its size thick, a lid that leans against them and a hoop of wire.

In: how finely they are cut. Out: a triangle mesh in the unit ball, z up: painted panels of five colours with stripes, a grey base, a speckled lid, a gold hoop.
"""

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from benchmarks.scenes.fields import CELLS, Field, Paint, grid, painted, rounded_box
from drgs.scene.mesh import TriangleMesh

THICKNESSES = (0.012, 0.018, 0.026, 0.038, 0.056)
"""Of the panels; a cell of the build's grid of 200 is 0.008 here."""
FIRST, PITCH = -0.5, 0.25
LID_THICKNESS = 0.03
LID_LEANS = np.radians(35.0)
WIRE = 0.02
"""Radius of the hoop's wire."""
COLOURS = ((0.6, 0.12, 0.08), (0.08, 0.3, 0.5), (0.55, 0.45, 0.1), (0.12, 0.4, 0.16), (0.45, 0.2, 0.45))


def panels(cells: int = CELLS) -> TriangleMesh:
    x, y, z = grid(cells)
    shape = rounded_box(x, y, z + 0.6, (0.75, 0.45, 0.06), 0.02)
    for k in range(len(THICKNESSES)):
        shape = np.minimum(shape, _panel(x, y, z, k))
    shape = np.minimum(shape, _lid(x, y, z))
    return painted(np.minimum(shape, _hoop(x, y, z)), _paint)


def _panel(x: Field, y: Field, z: Field, k: int) -> Field:
    half = THICKNESSES[k] / 2
    return rounded_box(x - FIRST - k * PITCH, y + 0.1, z + 0.1, (half, 0.28, 0.48), 0.8 * half)


def _lid(x: Field, y: Field, z: Field) -> Field:
    """A round plate whose lower edge stands on the base."""
    across, along = (
        np.cos(LID_LEANS) * (y - 0.3) - np.sin(LID_LEANS) * (z + 0.2),
        np.sin(LID_LEANS) * (y - 0.3) + np.cos(LID_LEANS) * (z + 0.2),
    )
    return np.maximum(np.hypot(x, along) - 0.4, np.abs(across) - LID_THICKNESS / 2)


def _hoop(x: Field, y: Field, z: Field) -> Field:
    return np.hypot(np.hypot(x, z - 0.35) - 0.4, y + 0.1) - WIRE


def _paint(places: Float[ndarray, "vertex 3"]) -> Paint:
    x, y, z = places.T
    parts = [_panel(x, y, z, k) for k in range(len(THICKNESSES))] + [_lid(x, y, z), _hoop(x, y, z)]
    nearest = np.stack(parts).argmin(0)
    on_base = np.abs(z + 0.6) < 0.063
    stripes = 1 + 0.4 * np.sign(np.sin(22 * y + 9 * z))[:, None]
    albedo, roughness = np.full((len(x), 3), 0.35), np.full(len(x), 0.5)
    for k, color in enumerate(COLOURS):
        albedo = np.where((nearest == k)[:, None], np.array(color) * stripes, albedo)
    lid, hoop = nearest == len(THICKNESSES), (nearest == len(THICKNESSES) + 1) & ~on_base
    speckles = np.sin(31 * x) * np.sin(29 * z) > 0.3
    albedo[lid] = np.where(speckles[lid, None], (0.7, 0.66, 0.6), (0.3, 0.16, 0.1))
    albedo[on_base], roughness[on_base] = 0.35, 0.5
    albedo[hoop], roughness[hoop] = (0.9, 0.66, 0.3), 0.2
    return albedo, roughness, hoop.astype(float)
