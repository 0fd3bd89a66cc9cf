"""The painted sphere's capture and meshes for the fits on a mesh."""

import dataclasses
from pathlib import Path

import torch

from drgs.reconstruct.capture.load_views import load_views
from drgs.reconstruct.fit.light.environment_pyramid import ENVIRONMENT_PYRAMID
from drgs.scene.mesh import TriangleMesh
from drgs.scene.views import Views
from tests.reconstruct.tiny_capture import SPHERE_CENTER, SPHERE_RADIUS, sphere_views, write_nerf_synthetic
from tests.render.closed_form_scenes import sphere_mesh

CENTER = torch.tensor(SPHERE_CENTER, dtype=torch.float32)


def painted_views(folder: Path, count: int = 8) -> Views:
    return load_views(write_nerf_synthetic(folder, sphere_views(count, square=True)))


def placed_sphere(share: float = 1.0, subdivisions: int = 3) -> TriangleMesh:
    """The capture's sphere, `share` times as large."""
    unit = sphere_mesh(subdivisions=subdivisions)
    return dataclasses.replace(unit, vertices=share * SPHERE_RADIUS * unit.vertices + CENTER)


def grey_light() -> dict[str, torch.Tensor]:
    return {f"environment_{rows}": torch.zeros(1, 3, rows, 2 * rows) for rows in ENVIRONMENT_PYRAMID}
