"""A small asset that is nothing but a mesh under a white sky, and edits of its material."""

import numpy as np
import torch
import trimesh

from drgs.scene.asset import Asset
from drgs.scene.environment import Environment
from drgs.scene.mesh import TriangleMesh, vertex_normals


def grey_cube() -> Asset:
    """Of side 1, around the origin."""
    box = trimesh.creation.box((1.0, 1.0, 1.0)).subdivide()
    vertices = torch.tensor(np.array(box.vertices), dtype=torch.float32)
    faces = torch.tensor(np.array(box.faces), dtype=torch.int32)
    grey = torch.full((len(vertices),), 0.5)
    mesh = TriangleMesh(vertices, faces, vertex_normals(vertices, faces), grey[:, None].repeat(1, 3), grey, torch.zeros_like(grey))
    return Asset(None, mesh, None, Environment(torch.ones(8, 16, 3)))


def material(**values: object) -> dict:
    """An edit of the whole asset."""
    return {"op": "material", "select": {"all": True}, "set": values, "mode": "absolute"}
