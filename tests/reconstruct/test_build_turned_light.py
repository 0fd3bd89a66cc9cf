"""A ball on a turntable becomes an asset whose light stands still with the camera: found out or said, kept, resumed, rendered."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from drgs.reconstruct.build_asset import BuildSettings, BuildStopped, build_asset
from drgs.reconstruct.capture import exposures
from drgs.reconstruct.capture.turning_light import LightChoice
from drgs.reconstruct.fit.surface import surface_passes
from drgs.reconstruct.fit.surface.fit_mesh_materials import MeshMaterialSettings
from drgs.reconstruct.fit.surface.fit_surface import SurfaceSettings
from drgs.reconstruct.fit.surface.surface_passes import PassSettings, SurfaceFit
from drgs.reconstruct.presets import PRESETS, UnderTurningLight
from drgs.reconstruct.progress import Progress
from drgs.render.records import RenderSettings
from drgs.render.render_cameras import render_cameras
from drgs.scene.asset import Asset, light_from_world, load_asset, save_asset
from drgs.scene.edits import EnvironmentEdit
from drgs.scene.posed_scene import PosedScene
from tests.reconstruct.capture.test_turning_light import write_turntable
from tests.reconstruct.test_build_asset import WITHOUT_HOLLOWS, asset_tensors

SETTINGS = BuildSettings(preset="tiny", device="cpu")
SMALL = replace(WITHOUT_HOLLOWS, image_side=48)
FEW_RAYS = WITHOUT_HOLLOWS.surface.surface.moves
LONGER = replace(
    WITHOUT_HOLLOWS,
    fit=replace(WITHOUT_HOLLOWS.fit, iterations=14),
    surface=replace(WITHOUT_HOLLOWS.surface, passes=1, surface=SurfaceSettings(rounds=1, steps_a_round=14, moves=FEW_RAYS)),
    materials=MeshMaterialSettings(iterations=4, moves=FEW_RAYS, points_a_step=256, samples=WITHOUT_HOLLOWS.materials.samples),
)


@pytest.fixture(autouse=True)
def _presets(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(PRESETS, "tiny", SMALL)
    monkeypatch.setitem(PRESETS, "longer", LONGER)


@pytest.fixture(scope="module")
def turntable(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_turntable(tmp_path_factory.mktemp("turntable"), lamp_on_camera=True, same_around=True)


@pytest.fixture(scope="module")
def half_turntable(turntable: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Every other picture: enough to find the light out, for builds of whose pictures nothing else is asked."""
    half = shutil.copytree(turntable, tmp_path_factory.mktemp("half") / "turntable")
    document = json.loads((half / "transforms.json").read_text())
    (half / "transforms.json").write_text(json.dumps(document | {"frames": document["frames"][::2]}))
    return half


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of `through`."""
    return tmp_path_factory.mktemp("through") / "asset"


@pytest.fixture(scope="module")
def through(half_turntable: Path, folder: Path) -> Asset:
    """Built of the turntable without a word about its light, and never stopped."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(PRESETS, "tiny", SMALL)
        return build_asset(half_turntable, folder, SETTINGS)


@pytest.mark.slow
def test_light_that_turns_is_found_out_kept_and_goes_on_where_it_stopped(
    through: Asset, folder: Path, half_turntable: Path, tmp_path: Path
) -> None:
    assert through.light_frame == "camera" and through.provenance["light"]["frame"] == "camera"
    assert "what is around the object stays the same" in through.provenance["light"]["why"]
    assert load_asset(folder).light_frame == "camera"
    told: list[str] = []
    said = replace(SETTINGS, light="camera")
    with pytest.raises(BuildStopped):
        build_asset(half_turntable, tmp_path / "b", said, lambda p: told.append(p.stage), lambda: told.count("surface") > 3)
    resumed = build_asset(half_turntable, tmp_path / "b", replace(said, resume=True))
    for name, value in asset_tensors(through).items():
        assert torch.equal(asset_tensors(resumed)[name], value), name
    with pytest.raises(ValueError, match="of another build"):
        build_asset(half_turntable, tmp_path / "b", replace(SETTINGS, light="object", resume=True))


@pytest.mark.slow
def test_what_was_built_without_a_turn_does_not_go_on_with_one(half_turntable: Path, tmp_path: Path) -> None:
    told: list[str] = []
    with pytest.raises(BuildStopped):
        build_asset(
            half_turntable, tmp_path / "a", replace(SETTINGS, light="object"), lambda p: told.append(p.stage), lambda: "fit" in told
        )
    with pytest.raises(ValueError, match="of another build"):
        build_asset(half_turntable, tmp_path / "a", replace(SETTINGS, light="camera", resume=True))


def error_of_renders(asset: Asset, folder: Path, turntable: Path) -> float:
    """Root mean square difference from the photographs, inside the ball, of display values 0..1 after one factor: so short a fit is too bright."""
    scene = PosedScene(None, asset.mesh, asset.environment, preferred="mesh")
    cameras = asset.cameras[:6]
    render_cameras(scene, cameras, folder, RenderSettings(samples_per_pixel=32), light_from_world=light_from_world(asset, []))
    pairs = []
    for camera in cameras:
        shown = np.asarray(Image.open(folder / f"{camera.name}.png"), float) / 255
        photo = np.asarray(Image.open(turntable / f"{camera.name}.png"), float)[..., :3] / 255
        inside = (shown[..., 3] > 0.99) & (np.asarray(Image.open(turntable / f"{camera.name}_mask.png")) > 250)
        pairs.append(np.stack([shown[..., :3][inside], photo[inside]]))
    shown, photo = np.concatenate(pairs, 1)
    return float(np.sqrt(np.mean((photo - shown * (shown * photo).sum() / (shown * shown).sum()) ** 2)))


@pytest.mark.slow
def test_with_the_right_frame_pictures_are_explained_and_with_the_wrong_one_not(turntable: Path, tmp_path: Path) -> None:
    right, wrong = (
        build_asset(turntable, tmp_path / light, BuildSettings(preset="longer", device="cpu", light=light))
        for light in ("camera", "object")
    )
    errors = [error_of_renders(asset, tmp_path / f"{asset.light_frame}_renders", turntable) for asset in (right, wrong)]
    assert errors[0] < 0.05 and errors[0] < 0.7 * errors[1], errors


@pytest.mark.slow
@pytest.mark.parametrize(("light", "exposed", "passes"), [("camera", False, 2), ("object", True, 1)])
def test_what_light_that_turns_changes_is_not_taken_for_exposures_and_it_has_more_of_what_shape_needs(
    light: LightChoice, exposed: bool, passes: int, half_turntable: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(exposures, "VARIED_STOPS", 0.0)  # so that points find exposures in any capture, ...
    monkeypatch.setattr(exposures, "LEFT_STOPS", 1e9)  # ... and so short a fit, which explains little, in none
    once = replace(SMALL.surface, passes=1)
    monkeypatch.setitem(PRESETS, "tiny", replace(SMALL, surface=once, turning=UnderTurningLight(2, passes=1, displacement_steps=2)))
    displaced: list[int] = []
    begun = surface_passes.start_displacement

    def start_displacement(fit: SurfaceFit, settings: PassSettings, radius: float) -> None:
        displaced.append(settings.displacement_steps)
        begun(fit, settings, radius)

    monkeypatch.setattr(surface_passes, "start_displacement", start_displacement)
    told: list[Progress] = []
    asset = build_asset(half_turntable, tmp_path / "a", replace(SETTINGS, light=light), told.append)
    assert ("exposure_stops" in asset.provenance) == exposed
    assert any(f"pass {passes} of {passes}," in p.message for p in told)
    assert displaced == ([2] if light == "camera" else [])
    assert max(p.iterations for p in told if p.stage == "fit") == SMALL.fit.iterations * passes


def test_where_light_turns_more_is_done_and_nothing_less() -> None:
    given = replace(PRESETS["full"], turning=UnderTurningLight(times_stage_one=2, passes=1, displacement_steps=50))
    more = given.under_turning_light()
    assert more.fit == replace(given.fit, iterations=2 * given.fit.iterations)
    assert more.surface == given.surface.with_more_passes(1)  # which has more than 50 already
    few = replace(given, surface=replace(given.surface, displacement_steps=0)).under_turning_light()
    assert few.surface.displacement_steps == 50


@pytest.mark.slow
def test_another_light_stands_still_with_the_object(through: Asset) -> None:
    camera = through.cameras[3]
    turn = light_from_world(through, [EnvironmentEdit(op="environment", rotation=30.0)])(camera)
    assert turn is not None and not torch.allclose(turn, torch.eye(3), atol=0.1)
    assert light_from_world(through, [EnvironmentEdit(op="environment", file="sky.exr")])(camera) is None
    assert light_from_world(replace(through, light_frame="object"), [])(camera) is None


@pytest.mark.slow
def test_an_asset_without_cameras_cannot_have_light_that_stands_still_with_them(through: Asset, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="it has no cameras"):
        save_asset(replace(through, cameras=()), tmp_path / "none")


def test_an_unknown_frame_is_refused(turntable: Path, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="light 'sun' is unknown; expected one of auto, object, camera"):
        build_asset(turntable, tmp_path / "a", BuildSettings(preset="tiny", light="sun"))  # type: ignore[arg-type]
