"""From a capture to an asset on a tiny preset: what is written, how it stops and resumes, and what is refused."""

import io
import json
import shutil
import zipfile
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
import pytest
import simplejpeg
import torch
from PIL import Image

from drgs.exchange.photographs import PHOTOGRAPHS, check_photographs, read_photograph
from drgs.reconstruct import report_progress
from drgs.reconstruct.build_asset import BuildSettings, BuildStopped, Progress, build_asset, kept_photographs
from drgs.reconstruct.capture.find_hollows import HollowSettings
from drgs.reconstruct.capture.load_views import load_views
from drgs.reconstruct.capture.open_vessels import VesselSettings
from drgs.reconstruct.capture.radiance_grid import RadianceGridSettings
from drgs.reconstruct.capture.visual_hull import VisualHullSettings
from drgs.reconstruct.facts_of_views import calibrations, facts_of_views
from drgs.reconstruct.fit.densify import DensifySettings
from drgs.reconstruct.fit.evidence import register_cameras
from drgs.reconstruct.fit.surface.fit_mesh_materials import MeshMaterialSettings
from drgs.reconstruct.fit.surface.fit_surface import SurfaceSettings
from drgs.reconstruct.fit.surface.moving_surface import MoveSettings
from drgs.reconstruct.fit.surface.surface_passes import PASS_MESH, PassSettings
from drgs.reconstruct.fit.surfel_parameters import parameters_from_gaussians
from drgs.reconstruct.fit.surfels.fit_gaussians import FitSettings
from drgs.reconstruct.fit.surfels.fit_materials import MaterialSettings
from drgs.reconstruct.fit.surfels.fit_mesh_surfels import MeshFitSettings
from drgs.reconstruct.geometry.bind_gaussians import points_from_binding
from drgs.reconstruct.geometry.divide_faces import DivisionSettings
from drgs.reconstruct.geometry.extract_mesh import MeshSettings
from drgs.reconstruct.geometry.mesh_from_gaussians import drop_unseen
from drgs.reconstruct.presets import PRESETS, Preset
from drgs.reconstruct.report_progress import BuildReporter, encode_preview
from drgs.reconstruct.stages import stage_two_preview
from drgs.render.records import SampleCounts
from drgs.scene.asset import Asset, load_asset, load_photographs
from drgs.scene.lens import Lens
from drgs.scene.views import Views
from tests.reconstruct.surfel_spheres import joined, surfel_sphere
from tests.reconstruct.tiny_capture import FEW_VIEWS, FX, HEIGHT, SPHERE_CENTER, SPHERE_RADIUS, WIDTH, sphere_views, write_nerf_synthetic
from tests.render.closed_form_scenes import front_camera

TINY = Preset(
    points=600,
    image_side=48,
    fit=FitSettings(iterations=20, densify=DensifySettings(every=5, budget=700)),
    mesh=MeshSettings(resolution=48, face_limit=2000),
    surface=PassSettings(
        2,
        SurfaceSettings(rounds=1, steps_a_round=3, moves=MoveSettings(solves=1, share_rays=4)),
        replace(PASS_MESH, resolution=32, face_limit=500),
        division=DivisionSettings(most_faces=2000),
        relief_steps=2,
    ),
    materials=MeshMaterialSettings(iterations=6, points_a_step=64, samples=SampleCounts(4, 2, 2)),
    hollows=HollowSettings(RadianceGridSettings(levels=((12, 4),), rays_a_step=64)),
    mesh_surfels=MeshFitSettings(iterations=6),
    surfel_materials=MaterialSettings(iterations=6, points_a_step=64, samples=SampleCounts(4, 2, 2)),
    hull=VisualHullSettings(coarse_cells=32, cell_pixels=1.0),
)
WITHOUT_HOLLOWS = replace(
    TINY,
    image_side=72,
    hollows=HollowSettings(RadianceGridSettings(levels=())),
    vessels=VesselSettings(walls=()),
    hull=VisualHullSettings(),
)
"""For tests of other files that ask nothing about hollows; pictures as they are, for some of them compare those."""
ON_SURFELS = replace(TINY, hollows=WITHOUT_HOLLOWS.hollows, vessels=WITHOUT_HOLLOWS.vessels, materials_on="surfels")
SETTINGS = BuildSettings(preset="tiny", device="cpu", light="object")
"""Of ten pictures of a few pixels nothing tells whose light it is: tests of that are elsewhere (try_light_frames, turning_light)."""


@pytest.fixture(autouse=True)
def _tiny_preset(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(PRESETS, "tiny", TINY)
    monkeypatch.setitem(PRESETS, "other", TINY)
    monkeypatch.setitem(PRESETS, "surfels", ON_SURFELS)
    monkeypatch.setattr(report_progress, "REPORT_SECONDS", 0.0)  # every step is told: some tests stop at one


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_nerf_synthetic(tmp_path_factory.mktemp("capture"), sphere_views(FEW_VIEWS, square=True))


@dataclass(frozen=True, eq=False)
class Build:
    asset: Asset
    path: Path
    progress: list[Progress]


@pytest.fixture(scope="module")
def build(capture: Path, tmp_path_factory: pytest.TempPathFactory) -> Build:
    """One build, never stopped."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(PRESETS, "tiny", TINY)
        patch.setattr(report_progress, "REPORT_SECONDS", 0.0)  # every step is told, however fast the machine
        progress: list[Progress] = []
        out = tmp_path_factory.mktemp("built") / "sphere"
        return Build(build_asset(capture, out, SETTINGS, progress.append), out, progress)


def stop_when(stage: str, progress: list[Progress], after: int = 1):
    """should_stop that says yes from the `after`-th report of a stage on."""
    return lambda: sum(p.stage == stage for p in progress) >= after


def asset_tensors(asset: Asset) -> dict[str, torch.Tensor]:
    parts = {"gaussians": asset.gaussians, "binding": asset.binding, "environment": asset.environment, "certainty": asset.certainty}
    tensors = {f"{part}.{f.name}": getattr(record, f.name) for part, record in parts.items() for f in fields(record)}
    detail = {} if asset.mesh.detail is None else {"detail": asset.mesh.detail.codes}
    return tensors | {f"mesh.{name}": values for name, values in asset.mesh.columns.items()} | detail


@pytest.mark.slow
def test_a_build_makes_an_asset_that_loads_with_the_same_numbers(build: Build):
    loaded = asset_tensors(load_asset(build.path))
    assert "detail" in loaded, "photographs are finer than so few faces"
    for name, value in asset_tensors(build.asset).items():
        assert torch.equal(loaded[name], value), name
    assert (build.path / "thumb.jpg").read_bytes()[:2] == b"\xff\xd8"
    assert len(load_asset(build.path).cameras) == FEW_VIEWS


@pytest.mark.slow
def test_the_photographs_of_the_capture_are_kept_with_the_asset(build: Build):
    photographs = load_photographs(build.path)
    assert photographs is not None
    check_photographs(photographs, len(build.asset.cameras), "the asset")
    for number, (view, camera) in enumerate(zip(sphere_views(FEW_VIEWS, square=True), build.asset.cameras, strict=True)):
        kept = Image.open(io.BytesIO(read_photograph(build.path / PHOTOGRAPHS, number)))
        assert kept.size == (camera.width, camera.height)
        # What of the photograph the asset's camera sees: the window around the object.
        across, down = FX / float(camera.intrinsics[0, 0]), FX / float(camera.intrinsics[1, 1])
        left, top = WIDTH / 2 - across * float(camera.intrinsics[0, 2]), HEIGHT / 2 - down * float(camera.intrinsics[1, 2])
        window = tuple(round(edge) for edge in (left, top, left + across * camera.width, top + down * camera.height))
        reduced = np.asarray(Image.fromarray(view.rgba).crop(window).resize(kept.size, Image.Resampling.BOX), float)
        difference = np.abs(np.asarray(kept.convert("RGBA"), float) - reduced)
        assert max(kept.size) == TINY.image_side and difference[..., 3].mean() < 4, view.name
        assert difference[..., :3][reduced[..., 3] == 255].mean() < 8, view.name


def test_a_capture_without_masks_keeps_whole_photographs():
    views = Views((), (torch.zeros(8, 8, 3, dtype=torch.uint8),), (torch.zeros(8, 8, dtype=torch.uint8),), None, None, False, "nerfstudio")
    for has_masks, bands in ((True, ("R", "G", "B", "A")), (False, ("R", "G", "B"))):
        packed = kept_photographs(replace(views, has_masks=has_masks))
        picture = zipfile.ZipFile(io.BytesIO(packed)).read("0000.webp")
        assert Image.open(io.BytesIO(picture)).getbands() == bands


@pytest.mark.slow
def test_the_mesh_is_the_sphere_and_its_vertices_carry_materials(build: Build):
    mesh = build.asset.mesh
    distance = (mesh.vertices - torch.tensor(SPHERE_CENTER, dtype=torch.float32)).norm(dim=-1) / SPHERE_RADIUS
    # So short a fit leaves holes, behind which the fusion finds inner sheets; the outside is the sphere.
    assert 0.95 < float(distance.quantile(0.9)) < 1.1
    for name in ("albedo", "roughness", "metallic"):
        value = getattr(mesh, name)
        assert float(value.min()) >= 0 and float(value.max()) <= 1, name
    assert float(mesh.albedo.std()) > 0.02  # not the grey that a fresh mesh has
    assert len(build.asset.binding.face) == len(build.asset.gaussians.centers)
    assert float(build.asset.environment.radiance.min()) > 0


@pytest.mark.slow
def test_what_photographs_show_of_the_sphere_is_more_certain_than_what_they_do_not(build: Build):
    mesh, certainty = build.asset.mesh, build.asset.certainty
    assert certainty is not None
    facing = torch.zeros(len(mesh.vertices))
    for camera in build.asset.cameras:
        towards = torch.nn.functional.normalize(camera.center_world - mesh.vertices, dim=-1)
        facing = torch.maximum(facing, (mesh.normals * towards).sum(-1))
    seen, unseen = facing > 0.7, facing < 0.2
    for name, values in vars(certainty).items():
        assert float(values[seen].float().mean()) > 0, name
        assert not unseen.any() or float(values[unseen].max()) == 0, name


@pytest.mark.slow
def test_provenance_says_how_the_asset_came_about(build: Build, capture: Path):
    facts = load_asset(build.path).provenance
    assert (facts["preset"], facts["seed"], facts["device"], facts["source"], facts["dataset"]) == (
        "tiny",
        0,
        "cpu",
        "nerf-synthetic",
        capture.name,
    )
    assert set(facts["seconds"]) >= {"read", "fit", "mesh", "materials"} and all(s >= 0 for s in facts["seconds"].values())


def test_provenance_keeps_each_lens_once_with_the_number_of_its_pictures():
    views = Views((), (), (), None, None, False, "colmap")
    assert calibrations(views) == {}
    fisheye, wide = Lens("SIMPLE_FISHEYE", (20.0, 32.0, 24.0), 64, 48), Lens("SIMPLE_RADIAL", (50.0, 32.0, 24.0, -0.1), 64, 48)
    found = json.loads(json.dumps(calibrations(replace(views, lenses=(wide, None, fisheye, wide)))))
    assert found["lenses"] == [
        {"model": "SIMPLE_RADIAL", "parameters": [50.0, 32.0, 24.0, -0.1], "width": 64, "height": 48, "pictures": 2},
        {"model": "SIMPLE_FISHEYE", "parameters": [20.0, 32.0, 24.0], "width": 64, "height": 48, "pictures": 1},
    ]


def test_provenance_tells_of_views_what_was_changed_and_nothing_else(capture: Path):
    views = load_views(capture)
    assert facts_of_views(views) == {}
    count = len(views.cameras)
    changed = replace(views, gains=(2.0,) * count, tints=((1.1, 1.0, 0.9),) * count, masks_moved=0.704, cameras_moved=0.218)
    found = json.loads(json.dumps(facts_of_views(changed)))
    assert found["exposure_stops"] == [1.0] * count and found["white_balance"] == [{"red": 1.1, "blue": 0.9}] * count
    assert (found["masks_moved_pixels"], found["cameras_moved_pixels"]) == (0.7, 0.22)


@pytest.mark.slow
def test_progress_grows_from_nothing_to_all_through_every_stage(build: Build):
    fractions = [p.fraction for p in build.progress]
    assert fractions == sorted(fractions) and fractions[0] == 0.0 and fractions[-1] == pytest.approx(1.0)
    stages = list(dict.fromkeys(p.stage for p in build.progress))
    assert stages == ["read", "fit", "mesh", "surface", "materials", "pack"]
    passes = {p.iteration: p for p in build.progress if p.stage == "surface"}
    assert max(passes) == passes[14].iterations == 14
    assert passes[7].message.startswith("pass 1 of 2") and passes[7].message.endswith("trying metal and paint")
    assert passes[12].message.startswith("pass 2 of 2") and passes[14].message.startswith("relief")
    last_fit = [p for p in build.progress if p.stage == "fit"][-1]
    assert (last_fit.iteration, last_fit.iterations) == (20, 20) and last_fit.psnr > 5


@pytest.mark.slow
def test_a_build_stopped_in_every_stage_leaves_checkpoints_and_resumes_to_the_same_bits(
    build: Build, capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """One build, stopped six times: what any stop loses, the end lacks."""
    out = tmp_path / "sphere"
    told: list[Progress] = []
    in_surface = {1: "pass 1 of 2", 3: "trying metal and paint", 5: "pass 2 of 2"}
    stops = (
        ("fit", 1, "stage1"),
        ("mesh", 1, "stage1"),
        *(("surface", after, "surface") for after in in_surface),
        ("materials", 1, "stage2"),
    )
    for stage, after, checkpoint in stops:
        told.clear()
        with pytest.raises(BuildStopped):
            build_asset(capture, out, replace(SETTINGS, resume=True), told.append, stop_when(stage, told, after))
        assert not out.exists() and (Path(f"{out}.build") / f"{checkpoint}.safetensors").is_file()
        assert told[-1].stage == stage and (stage in ("fit", "mesh") or "fit" not in {p.stage for p in told})
        assert stage != "surface" or in_surface[after] in told[-1].message
    told.clear()
    resumed = asset_tensors(build_asset(capture, out, replace(SETTINGS, resume=True), told.append))
    assert not {"fit", "surface"} & {p.stage for p in told}
    for name, value in asset_tensors(build.asset).items():
        assert torch.equal(resumed[name], value), name
    loaded = load_asset(out)
    assert loaded.gaussians is not None and loaded.primary == "mesh"


@pytest.mark.slow
def test_cameras_that_the_surface_moved_are_those_of_the_asset_and_stay_where_they_are_given(
    capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    small = replace(WITHOUT_HOLLOWS, surface=replace(TINY.surface, cameras_after=(1,)))
    monkeypatch.setitem(PRESETS, "tiny", small)
    monkeypatch.setattr(register_cameras, "LEAST_AGREED", -1.0)
    monkeypatch.setattr(register_cameras, "OVER_NOISE", -1.0)
    told: list[Progress] = []
    with pytest.raises(BuildStopped):
        build_asset(capture, tmp_path / "moved", SETTINGS, told.append, stop_when("surface", told, 5))
    moved = build_asset(capture, tmp_path / "moved", replace(SETTINGS, resume=True))
    at_once = build_asset(capture, tmp_path / "at_once", SETTINGS)
    given = build_asset(capture, tmp_path / "given", replace(SETTINGS, cameras="given"))
    assert moved.provenance["cameras_moved_pixels"] > 0 and "cameras_moved_pixels" not in given.provenance
    for one, other, before, view in zip(moved.cameras, at_once.cameras, given.cameras, load_views(capture).cameras, strict=True):
        assert torch.equal(one.camera_from_world, other.camera_from_world) and torch.equal(before.camera_from_world, view.camera_from_world)
        assert not torch.equal(one.camera_from_world, before.camera_from_world)
        assert float((one.camera_from_world - before.camera_from_world).abs().max()) < 0.1
    assert torch.equal(moved.mesh.vertices, at_once.mesh.vertices)


@pytest.mark.slow
@pytest.mark.parametrize("binding", ["particles", "mesh"])
def test_materials_can_be_fitted_on_surfels_as_in_the_paper(build: Build, capture: Path, tmp_path: Path, binding: str):
    out = tmp_path / "sphere"
    settings = BuildSettings(preset="surfels", binding=binding, device="cpu")
    progress: list[Progress] = []
    with pytest.raises(BuildStopped):
        build_asset(capture, out, settings, progress.append, stop_when("materials", progress))
    asset = build_asset(capture, out, replace(settings, resume=True), progress.append)
    assert (
        asset.primary is None
        and "surface" not in {p.stage for p in progress}
        and ("bind" in {p.stage for p in progress}) == (binding == "mesh")
    )
    limit = TINY.fit.densify.budget if binding == "mesh" else TINY.mesh.face_limit
    assert len(asset.mesh.faces) <= limit and float(asset.mesh.albedo.std()) > 0.02
    assert len(asset.binding.face) == len(asset.gaussians.centers) and asset.provenance["materials_on"] == "surfels"


@pytest.mark.slow
def test_bound_to_the_mesh_a_build_goes_on_from_the_fit_of_particles_and_resumes_to_the_same_bits(
    build: Build, capture: Path, tmp_path: Path
):
    out = tmp_path / "sphere"
    shutil.copytree(f"{build.path}.build", f"{out}.build")
    on_mesh = replace(SETTINGS, binding="mesh", resume=True)
    progress: list[Progress] = []
    with pytest.raises(BuildStopped):  # asked after the mesh, then before each step of the fine-tuning
        build_asset(capture, out, on_mesh, progress.append, iter([False, False, False, True]).__next__)
    assert not {"fit", "surface"} & {p.stage for p in progress} and (Path(f"{out}.build") / "mesh_surfels.safetensors").is_file()
    progress.clear()
    asset = build_asset(capture, out, on_mesh, progress.append)
    fractions = [p.fraction for p in progress]
    # Material and light do not depend on where surfels lie: those of the particles' build are taken.
    assert fractions == sorted(fractions) and "bind" in {p.stage for p in progress} and "materials" not in {p.stage for p in progress}
    mesh, gaussians, binding = asset.mesh, asset.gaussians, asset.binding
    assert all(torch.equal(value, getattr(build.asset.mesh, name)) for name, value in mesh.columns.items())
    assert len(binding.face.unique()) == len(binding.face) == len(gaussians.centers) <= TINY.surface.mesh.face_limit
    assert len(mesh.faces) in {4 * len(binding.face), 16 * len(binding.face)}  # divided, with a surfel on each face from before
    assert torch.allclose(points_from_binding(binding, mesh.vertices, mesh.faces), gaussians.centers, atol=1e-6)
    assert asset.provenance["binding"] == "mesh" and build.asset.provenance["binding"] == "particles"
    # Without a stop, from the same stage 1, to another place.
    shutil.copytree(f"{build.path}.build", tmp_path / "b.build")
    through = asset_tensors(build_asset(capture, tmp_path / "b", on_mesh))
    for name, value in asset_tensors(asset).items():
        assert torch.equal(through[name], value), name
    # The particles' checkpoints are as they were.
    particles = asset_tensors(build_asset(capture, out, replace(SETTINGS, resume=True)))
    for name, value in asset_tensors(build.asset).items():
        assert torch.equal(particles[name], value), name


@pytest.mark.slow
def test_stopping_before_anything_is_fitted_can_be_resumed(capture: Path, tmp_path: Path):
    with pytest.raises(BuildStopped):
        build_asset(capture, tmp_path / "a", SETTINGS, should_stop=lambda: True)
    with pytest.raises(BuildStopped):
        build_asset(capture, tmp_path / "a", replace(SETTINGS, resume=True), should_stop=points_are_found(tmp_path / "a"))
    assert (tmp_path / "a.build" / "stage1.safetensors").is_file()


def points_are_found(out: Path):
    """should_stop that says yes as soon as the fit could begin."""
    return (out.parent / f"{out.name}.build" / "hollows.safetensors").is_file


@pytest.fixture(scope="module")
def stopped(capture: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """OUT of a build that stopped before its first step."""
    out = tmp_path_factory.mktemp("stopped") / "a"
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(PRESETS, "tiny", TINY)
        with pytest.raises(BuildStopped):
            build_asset(capture, out, SETTINGS, should_stop=points_are_found(out))
    return out


def copy_of(stopped: Path, folder: Path) -> Path:
    shutil.copytree(f"{stopped}.build", folder / "a.build")
    return folder / "a"


@pytest.mark.slow
@pytest.mark.parametrize("change", [{"preset": "other"}, {"seed": 9}])
def test_the_checkpoint_of_another_build_is_refused(capture: Path, stopped: Path, tmp_path: Path, change: dict):
    out = copy_of(stopped, tmp_path)
    with pytest.raises(ValueError, match=r"is of another build .* delete its folder or choose another OUT"):
        build_asset(capture, out, replace(SETTINGS, resume=True, **change))
    assert not out.exists()


def test_a_file_where_checkpoints_belong_is_refused_before_anything_is_read(tmp_path: Path):
    (tmp_path / "a.build").write_text("mine")
    with pytest.raises(ValueError, match=r"a\.build: is a file; expected a folder for the checkpoints .* choose another OUT"):
        build_asset(tmp_path / "no_capture", tmp_path / "a", SETTINGS)
    assert (tmp_path / "a.build").read_text() == "mine"


@pytest.mark.slow
def test_the_checkpoint_of_another_capture_is_refused(stopped: Path, tmp_path: Path):
    fewer = write_nerf_synthetic(tmp_path / "fewer", sphere_views(FEW_VIEWS - 4, square=True))
    with pytest.raises(ValueError, match="is of another build"):
        build_asset(fewer, copy_of(stopped, tmp_path), replace(SETTINGS, resume=True))


@pytest.mark.slow
def test_a_damaged_checkpoint_is_refused_on_resume_and_ignored_without(capture: Path, stopped: Path, tmp_path: Path):
    out = copy_of(stopped, tmp_path)
    path = Path(f"{out}.build") / "stage1.safetensors"
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(ValueError, match=r"checkpoint stage1\.safetensors is damaged"):
        build_asset(capture, out, replace(SETTINGS, resume=True))
    with pytest.raises(BuildStopped):  # a fresh build starts
        build_asset(capture, out, SETTINGS, should_stop=lambda: True)


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        (BuildSettings(preset="best"), "preset 'best' is unknown; expected one of draft, fast, full"),
        (BuildSettings(masks="none"), "masks 'none' is unknown; expected auto or given"),  # type: ignore[arg-type]
        (BuildSettings(cameras="none"), "cameras 'none' is unknown; expected auto or given"),  # type: ignore[arg-type]
        (BuildSettings(binding="ropes"), "binding 'ropes' is unknown; expected one of particles, mesh"),
        (BuildSettings(device="tpu"), "device 'tpu' is unknown"),
    ],
)
def test_unknown_settings_are_refused_before_anything_is_read(tmp_path: Path, settings: BuildSettings, sentence: str):
    with pytest.raises(ValueError, match=sentence):
        build_asset(tmp_path / "no such capture", tmp_path / "out", settings)
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_is_no_capture_is_refused(tmp_path: Path):
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match="not a capture"):
        build_asset(tmp_path / "empty", tmp_path / "out", SETTINGS)


def test_surfels_that_no_camera_sees_are_dropped():
    outer, inner = surfel_sphere(1200, opacity=0.99, overlap=2.0), surfel_sphere(50, radius=0.4, opacity=0.99)
    # One camera sees the front of the outer sphere; what is inside and behind hides.
    kept = drop_unseen(joined(outer, inner), (front_camera(64),), radius=1.0)
    distance = kept.centers.norm(dim=-1)
    assert float(distance.min()) > 0.9
    assert float(kept.centers[:, 1].median()) < 0 and 400 < len(kept.centers) < 900
    assert len(kept.sh) == len(kept.albedo) == len(kept.centers)


@pytest.mark.parametrize("previews", [True, False])
def test_pictures_are_made_for_those_who_show_them(previews: bool, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(report_progress, "PREVIEW_SECONDS", -1.0)
    told: list[Progress] = []
    BuildReporter(told.append, {"fit": 1.0}, previews).report("fit", 0.5, "half", preview=lambda: b"jpeg")
    assert [one.preview_jpeg for one in told] == [b"jpeg" if previews else None]


def test_a_preview_is_a_jpeg_of_the_picture_on_grey():
    radiance = torch.full((16, 24, 3), 0.5, requires_grad=True)
    coverage = torch.zeros(16, 24)
    coverage[:, 12:] = 1.0
    image = simplejpeg.decode_jpeg(encode_preview(radiance, coverage))
    assert image.shape == (16, 24, 3)
    assert abs(int(image[8, 2, 0]) - 51) < 4 and abs(int(image[8, 20, 0]) - 188) < 4


def test_the_thumbnail_of_a_tiny_object_is_that_of_a_large_one():
    pictures = []
    for scale in (1.0, 1e-3):
        camera = front_camera(64, distance=4.0)
        pose = camera.camera_from_world.clone()
        pose[:3, 3] *= scale
        surfels = surfel_sphere(800, radius=scale, radiance=(0.6, 0.3, 0.1))
        parameters = parameters_from_gaussians(surfels) | {"sh": surfels.sh}
        jpeg = stage_two_preview(parameters, (replace(camera, camera_from_world=pose),), radius=scale)
        pictures.append(simplejpeg.decode_jpeg(jpeg).astype(int))
    assert np.abs(pictures[0][32, 32] - pictures[0][1, 1]).max() > 50  # the object stands out
    assert np.abs(pictures[1] - pictures[0]).max() <= 4
