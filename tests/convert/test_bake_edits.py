"""Edits put into an asset for good."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from drgs.convert.bake_edits import bake_edits
from drgs.deform.pose_scene import pose_scene
from drgs.scene.asset import Asset, load_asset, save_asset
from drgs.scene.certainty import Certainty
from drgs.scene.edits import parse_edits
from drgs.scene.gaussians import surfel_tangents
from tests.reconstruct.surfel_spheres import surfel_sphere
from tests.scene.grey_cube import grey_cube, material


@pytest.fixture(scope="module")
def cube() -> Asset:
    return grey_cube()


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


def test_a_version_keeps_what_the_photographs_said_of_each_vertex(tmp_path: Path, cube: Asset) -> None:
    values = torch.linspace(0, 1, len(cube.mesh.vertices)).half()
    known = replace(cube, certainty=Certainty(values, values, values, values))
    twisted = parse_edits([material(roughness=0.2), {"op": "deform", "map": {"type": "twist", "rate": 0.5}}])
    save_asset(bake_edits(known, twisted, tmp_path, 2), tmp_path / "asset")
    kept = load_asset(tmp_path / "asset").certainty
    assert kept is not None and torch.equal(kept.roughness, values)
