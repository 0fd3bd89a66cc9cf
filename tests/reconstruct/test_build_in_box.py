"""A build that is kept in a box holds what lies in it, and nothing else."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from drgs.evaluate.evaluate_asset import evaluate_asset
from drgs.reconstruct.build_asset import BuildSettings, BuildStopped, build_asset
from drgs.reconstruct.capture import find_masks as find_masks_module
from drgs.reconstruct.capture.build_box import BuildBox
from drgs.reconstruct.presets import PRESETS
from drgs.scene.asset import Asset, load_asset, load_photographs
from tests.reconstruct.capture.test_find_masks import before_surroundings
from tests.reconstruct.test_build_asset import WITHOUT_HOLLOWS
from tests.reconstruct.tiny_capture import SPHERE_CENTER, SPHERE_RADIUS, sphere_views, write_nerf_synthetic

X, Y, Z = SPHERE_CENTER.tolist()
UPPER = BuildBox((X - 1, Y - 1, Z), (X + 1, Y + 1, Z + 1))
SETTINGS = BuildSettings(preset="tiny", device="cpu", box=UPPER)


@pytest.fixture(autouse=True)
def _tiny_preset(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(PRESETS, "tiny", WITHOUT_HOLLOWS)


def check_upper_half(asset: Asset, volume_error: float) -> None:
    vertices = asset.mesh.vertices
    assert bool(UPPER.holds(vertices).all())
    mesh = trimesh.Trimesh(vertices.numpy(), asset.mesh.faces.numpy(), process=False)
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(2 / 3 * np.pi * SPHERE_RADIUS**3, rel=volume_error)
    assert mesh.bounds[1, 2] == pytest.approx(Z + SPHERE_RADIUS, abs=0.1 * SPHERE_RADIUS)
    flat = vertices[:, 2] < Z + 1e-5
    # A disc, cut flat: there are vertices on it, and they reach over most of it.
    assert int(flat.sum()) > 10 and float((vertices[flat, :2] - torch.tensor([X, Y])).norm(dim=-1).max()) > 0.8 * SPHERE_RADIUS


@pytest.mark.slow
def test_half_a_ball_is_built_of_the_pictures_of_a_ball(tmp_path: Path) -> None:
    capture, out = write_nerf_synthetic(tmp_path / "capture", sphere_views(24, square=True)), tmp_path / "half"
    asset = build_asset(capture, out, SETTINGS)
    check_upper_half(asset, 0.2)
    loaded = load_asset(out)
    assert loaded.provenance["box"] == [list(UPPER.low), list(UPPER.high)]
    # Views from below see the lower half in front of the upper one.
    assert 8 <= len(loaded.cameras) < 24 and all(camera.center_world[2] > -1 for camera in loaded.cameras)
    assert load_photographs(out) is not None
    with pytest.raises(ValueError, match="without --box"):
        evaluate_asset(loaded, write_test_cameras(capture))
    with pytest.raises(ValueError, match="is of another build"):
        build_asset(capture, out, replace(SETTINGS, resume=True, box=BuildBox(UPPER.low, (X + 1, Y + 1, Z + 2))))


def write_test_cameras(capture: Path) -> Path:
    (capture / "transforms_test.json").write_text((capture / "transforms_train.json").read_text())
    return capture


@pytest.mark.slow
def test_without_masks_the_surfels_in_the_box_are_the_object(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(PRESETS, "tiny", replace(WITHOUT_HOLLOWS, fit=replace(WITHOUT_HOLLOWS.fit, iterations=40)))
    monkeypatch.setattr(find_masks_module, "ITERATIONS", 100)
    capture = write_nerf_synthetic(tmp_path / "capture", [before_surroundings(view) for view in sphere_views(24, square=True)])
    asked = iter(range(10**6))
    with pytest.raises(BuildStopped):  # between two steps of stage 1, after the search
        build_asset(capture, tmp_path / "half", SETTINGS, should_stop=lambda: next(asked) > 120)
    asset = build_asset(capture, tmp_path / "half", replace(SETTINGS, resume=True))
    assert bool(UPPER.holds(asset.mesh.vertices).all())
    top = asset.mesh.vertices.amax(0) - torch.tensor([X, Y, Z])
    assert float(top[2]) == pytest.approx(SPHERE_RADIUS, rel=0.25)
    # Views from below see what was not to be built in front of the rest.
    assert 8 <= len(asset.cameras) < 24
