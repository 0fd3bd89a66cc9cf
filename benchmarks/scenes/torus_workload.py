"""A workload of `rasterize` that needs no file of the user's: opaque surfels all over a torus, seen from above."""

import math
from pathlib import Path

import numpy as np

MAJOR_RADIUS, MINOR_RADIUS = 1.0, 0.4
WIDTH, HEIGHT = 400, 400
FOCAL_PIXELS = 480.0
DISTANCE = 4.0
TILT_DEGREES = 50.0
"""Of the torus' axis against the viewing axis."""
CHANNELS = 12


def write_torus_workload(path: Path, surfel_count: int) -> None:
    """Write an .npz as benchmarks/render/rasterize.py describes it, the same for the same count."""
    generator = np.random.default_rng(0)
    around, across = generator.uniform(0, 2 * math.pi, (2, surfel_count))
    zero = np.zeros(surfel_count)
    outwards = np.stack([np.cos(around), np.sin(around), zero], -1)
    normals = np.cos(across)[:, None] * outwards + np.sin(across)[:, None] * np.array([0, 0, 1])
    tangents_u = np.stack([-np.sin(around), np.cos(around), zero], -1)
    area = 4 * math.pi**2 * MAJOR_RADIUS * MINOR_RADIUS
    turn = math.radians(180 - TILT_DEGREES)
    camera_from_world = np.eye(4)
    camera_from_world[1:3, 1:3] = [[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]]
    camera_from_world[2, 3] = DISTANCE
    arrays = {
        "centers": MAJOR_RADIUS * outwards + MINOR_RADIUS * normals,
        "tangents_u": tangents_u,
        "tangents_v": np.cross(normals, tangents_u),
        "scales": math.sqrt(area / surfel_count) * generator.uniform(0.5, 1, (surfel_count, 2)),  # neighbours overlap
        "opacities": generator.uniform(0.3, 0.95, surfel_count),
        "features": generator.uniform(0, 1, (surfel_count, CHANNELS)),
        "K": np.array([[FOCAL_PIXELS, 0, WIDTH / 2], [0, FOCAL_PIXELS, HEIGHT / 2], [0, 0, 1]]),
        "camera_from_world": camera_from_world,
    }
    np.savez(path, size=np.array([WIDTH, HEIGHT]), **{name: values.astype(np.float32) for name, values in arrays.items()})
