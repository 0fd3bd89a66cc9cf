"""An object of any number of faces: a ball with bumps, the same surface however finely it is cut."""

import math

import numpy as np
import torch

from drgs.render.intersect.horizon import find_horizons, stored_horizons
from drgs.render.intersect.tracer import mesh_extent
from drgs.scene.asset import Asset
from drgs.scene.environment import Environment
from drgs.scene.mesh import TriangleMesh, vertex_normals
from drgs.scene.sun_and_sky import paint_sun_and_sky

BUMP = 0.12
"""Height of the bumps over the radius: deep enough that the ball shades and lights itself."""
WAVES = 7.0
SKY_HEIGHT = 64


def bumpy_ball(face_count: int, device: torch.device, turn: float = 0.0) -> Asset:
    """An asset with horizons, as builds store them; of about as many faces, 12 n² for the nearest n.

    Args:
        turn: shifts the bumps [radians], so that assets differ.
    """
    cells = max(1, round(math.sqrt(face_count / 12)))
    lattice, faces = _cube_lattice(cells)
    directions = np.tan((lattice * (2 / cells) - 1) * (math.pi / 4))  # nearly even on the ball
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    waves = np.sin(WAVES * directions + turn)
    vertices = torch.from_numpy(directions * (1 + BUMP * waves.prod(-1, keepdims=True))).float()
    albedo = torch.from_numpy(0.5 + 0.3 * np.sin(3 * directions)).float()
    roughness = torch.from_numpy(0.5 + 0.3 * waves[:, 0]).float()
    indices = torch.from_numpy(faces).int()
    columns = (vertices, indices, vertex_normals(vertices, indices), albedo, roughness, torch.zeros(len(vertices)))
    mesh = TriangleMesh(*(values.to(device) for values in columns))
    sky = Environment(torch.from_numpy(paint_sun_and_sky(height=SKY_HEIGHT)).float().to(device))
    return Asset(None, mesh, None, sky, horizons=stored_horizons(find_horizons(mesh, mesh_extent(mesh)[1])))


def _cube_lattice(cells: int) -> tuple[np.ndarray, np.ndarray]:
    """Points with whole coordinates 0..cells on a cube's surface, each once, and triangles seen counter-clockwise from outside."""
    u, v = np.meshgrid(np.arange(cells), np.arange(cells), indexing="ij")
    corners = np.stack([np.stack([u + a, v + b], -1) for a, b in ((0, 0), (1, 0), (1, 1), (0, 1))], -2).reshape(-1, 4, 2)
    quads = []
    for axis in range(3):
        for side in (0, cells):
            points = np.empty((len(corners), 4, 3), np.int64)
            points[..., axis] = side
            points[..., (axis + 1) % 3], points[..., (axis + 2) % 3] = corners[..., 0], corners[..., 1]
            quads.append(points if side else points[:, ::-1])
    quad = np.concatenate(quads)
    keys = (quad[..., 0] * (cells + 1) + quad[..., 1]) * (cells + 1) + quad[..., 2]
    kept, numbers = np.unique(keys, return_inverse=True)
    numbers = numbers.reshape(-1, 4)
    lattice = np.stack([kept // (cells + 1) ** 2, kept // (cells + 1) % (cells + 1), kept % (cells + 1)], -1)
    return lattice.astype(np.float64), np.concatenate([numbers[:, [0, 1, 2]], numbers[:, [0, 2, 3]]])
