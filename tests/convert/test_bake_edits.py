"""Edits put into an asset for good."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from drgs.convert.bake_edits import bake_edits
from drgs.deform.pose_scene import pose_scene
from drgs.scene.asset import Asset, load_asset, save_asset
from drgs.scene.edits import parse_edits
from drgs.scene.environment import Environment
from drgs.scene.gaussians import surfel_tangents
from drgs.scene.mesh import TriangleMesh, vertex_normals
from tests.reconstruct.surfel_spheres import surfel_sphere


def material(**values: object) -> dict:
    return {"op": "material", "select": {"all": True}, "set": values, "mode": "absolute"}


@pytest.fixture(scope="module")
def cube() -> Asset:
    box = trimesh.creation.box((1.0, 1.0, 1.0)).subdivide()
    vertices = torch.tensor(np.array(box.vertices), dtype=torch.float32)
    faces = torch.tensor(np.array(box.faces), dtype=torch.int32)
    grey = torch.full((len(vertices),), 0.5)
    mesh = TriangleMesh(vertices, faces, vertex_normals(vertices, faces), grey[:, None].repeat(1, 3), grey, torch.zeros_like(grey))
    return Asset(None, mesh, None, Environment(torch.ones(8, 16, 3)))


def test_a_version_looks_at_rest_as_its_edits_made_the_asset(tmp_path: Path, cube: Asset) -> None:
    surfels = surfel_sphere(200)
    asset = replace(cube, gaussians=surfels)
    edits = parse_edits(
        [
            material(roughness=0.125),
            {"op": "deform", "map": {"type": "bend", "curvature": 0.5}},
            {"op": "deform", "map": {"type": "twist", "rate": 0.7}},
            {"op": "environment", "rotation": 45.0, "intensity": 2.0},
        ]
    )
    version = bake_edits(asset, edits, tmp_path, 2)
    posed = pose_scene(asset, edits)
    assert torch.equal(version.mesh.vertices, posed.mesh.vertices) and torch.equal(version.mesh.roughness, posed.mesh.roughness)
    assert torch.equal(version.environment.radiance, 2 * cube.environment.radiance)
    assert version.gaussians is not None and posed.surfels is not None
    made, wanted = surfel_tangents(version.gaussians).double(), posed.surfels.tangents.double()
    torch.testing.assert_close(made @ made.mT, wanted @ wanted.mT, rtol=1e-4, atol=1e-7)
    sides = torch.linalg.cross(made[..., 0], made[..., 1]) * torch.linalg.cross(wanted[..., 0], wanted[..., 1])
    assert bool((sides.sum(-1) > 0).all())
    save_asset(version, tmp_path / "asset")
    assert load_asset(tmp_path / "asset").provenance["versions"] == json.loads(json.dumps(version.provenance["versions"]))


def test_a_version_keeps_the_horizons_of_a_mesh_that_stayed_as_it_was(tmp_path: Path, cube: Asset) -> None:
    known = replace(cube, horizons=torch.zeros(len(cube.mesh.faces), 8, dtype=torch.uint8))
    painted, twisted = (parse_edits([edit]) for edit in (material(roughness=0.2), {"op": "deform", "map": {"type": "twist", "rate": 0.5}}))
    assert bake_edits(known, painted, tmp_path, 2).horizons is known.horizons
    assert bake_edits(known, twisted, tmp_path, 2).horizons is None
