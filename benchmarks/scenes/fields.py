"""Shapes as functions of space that are below 0 within, on a grid around the unit ball, and triangle meshes where they are 0."""

from collections.abc import Callable, Sequence

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from skimage.measure import marching_cubes

from drgs.scene.mesh import TriangleMesh, vertex_normals

HALF_SIDE = 1.05
"""Of the cube of the grid, around the unit ball."""
CELLS = 300

Field = Float[ndarray, "..."]
Paint = tuple[Float[ndarray, "vertex 3"], Float[ndarray, "vertex"], Float[ndarray, "vertex"]]
"""Albedo (linear), roughness, metallic."""


def grid(cells: int) -> tuple[Field, Field, Field]:
    along = np.linspace(-HALF_SIDE, HALF_SIDE, cells, dtype=np.float32)
    x, y, z = np.meshgrid(along, along, along, indexing="ij")
    return x, y, z


def rounded_cylinder(radius: Field, z: Field, most: float, low: float, high: float, edge: float = 0.05) -> Field:
    """Signed distance; `edge`: radius of the rounded edges."""
    apart = np.stack([radius - most + edge, np.abs(z - (low + high) / 2) - (high - low) / 2 + edge])
    return np.minimum(apart.max(0), 0) + np.linalg.norm(np.maximum(apart, 0), axis=0) - edge


def rounded_box(x: Field, y: Field, z: Field, half: Sequence[float], edge: float) -> Field:
    """Signed distance; `edge`: radius of the rounded edges."""
    apart = np.stack([np.abs(along) - side + edge for along, side in zip((x, y, z), half, strict=True)])
    return np.minimum(apart.max(0), 0) + np.linalg.norm(np.maximum(apart, 0), axis=0) - edge


def rod(across: Field, aside: Field, along: Field, radius: float, low: float, high: float) -> Field:
    return np.maximum(np.hypot(across, aside) - radius, np.maximum(low - along, along - high))


def blended(first: Field, second: Field, width: float) -> Field:
    """The union, with a fillet that is about `width` wide (a polynomial smooth minimum)."""
    share = np.clip(0.5 + 0.5 * (second - first) / width, 0, 1)
    return second * (1 - share) + first * share - width * share * (1 - share)


def painted(field: Field, paint: Callable[[Float[ndarray, "vertex 3"]], Paint]) -> TriangleMesh:
    """Where the field, which is below 0 within, is 0."""
    vertices, faces, _, _ = marching_cubes(
        field, 0.0, spacing=(2 * HALF_SIDE / (len(field) - 1),) * 3, gradient_direction="descent", allow_degenerate=False
    )
    places = vertices - HALF_SIDE
    at, corners = (torch.from_numpy(values) for values in (places.astype(np.float32), faces.astype(np.int32)))
    albedo, roughness, metallic = (torch.from_numpy(values.astype(np.float32)) for values in paint(places))
    return TriangleMesh(at, corners, vertex_normals(at, corners), albedo, roughness, metallic)
