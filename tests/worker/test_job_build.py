"""The real builder driven stage by stage, each in a run of its own as after a crash, and the re-decoupling of what it made."""

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from drgs.reconstruct.capture.find_hollows import HollowSettings
from drgs.reconstruct.capture.open_vessels import VesselSettings
from drgs.reconstruct.capture.radiance_grid import RadianceGridSettings
from drgs.reconstruct.capture.visual_hull import VisualHullSettings
from drgs.reconstruct.fit.densify import DensifySettings
from drgs.reconstruct.fit.surface.fit_mesh_materials import MeshMaterialSettings
from drgs.reconstruct.fit.surface.fit_surface import SurfaceSettings
from drgs.reconstruct.fit.surface.moving_surface import MoveSettings
from drgs.reconstruct.fit.surface.surface_passes import PASS_MESH, PassSettings
from drgs.reconstruct.fit.surfels.fit_gaussians import FitSettings
from drgs.reconstruct.fit.surfels.fit_mesh_surfels import MeshFitSettings
from drgs.reconstruct.geometry.divide_faces import DivisionSettings
from drgs.reconstruct.geometry.extract_mesh import MeshSettings
from drgs.reconstruct.presets import PRESETS, Preset
from drgs.reconstruct.progress import STAGE_SHARES, Progress
from drgs.render.records import SampleCounts
from drgs.scene.asset import load_asset
from drgs_worker.jobs.builders import build_with_drgs
from drgs_worker.jobs.capture_report import CaptureReport
from drgs_worker.jobs.steps.build import BuildRun, RedecoupleRun
from drgs_worker.jobs.steps.job_run import JobContext
from drgs_worker.store.data_directory import DataDirectory, open_data_directory
from drgs_worker.store.database import AssetRow, open_database
from tests.reconstruct.tiny_capture import FEW_VIEWS, sphere_views, write_nerf_synthetic

TINY = Preset(
    points=600,
    image_side=48,
    fit=FitSettings(iterations=7, densify=DensifySettings(every=5, budget=700)),
    mesh=MeshSettings(resolution=48, face_limit=2000),
    surface=PassSettings(
        2,
        SurfaceSettings(rounds=1, steps_a_round=2, moves=MoveSettings(solves=1, share_rays=4)),
        replace(PASS_MESH, resolution=32, face_limit=500),
        division=DivisionSettings(most_faces=2000),
        relief_steps=2,
    ),
    materials=MeshMaterialSettings(iterations=4, points_a_step=64, samples=SampleCounts(4, 2, 2)),
    hollows=HollowSettings(RadianceGridSettings(levels=((12, 4),), rays_a_step=64)),
    mesh_surfels=MeshFitSettings(iterations=3),
    hull=VisualHullSettings(coarse_cells=32, cell_pixels=1.0),
)
BOUND = replace(TINY, hollows=HollowSettings(RadianceGridSettings(levels=())), vessels=VesselSettings(walls=()))
"""Hollows are looked for before anything is bound to a mesh: the other build says whether what is found of them is kept."""
MORE = replace(TINY, materials=MeshMaterialSettings(iterations=8, points_a_step=64, samples=SampleCounts(4, 2, 2)))


@pytest.fixture
def directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[DataDirectory]:
    monkeypatch.setitem(PRESETS, "tiny", TINY)
    monkeypatch.setitem(PRESETS, "bound", BOUND)
    monkeypatch.setitem(PRESETS, "more", MORE)
    write_nerf_synthetic(tmp_path, sphere_views(FEW_VIEWS, square=True))
    yield open_data_directory(tmp_path / "data")


def context(directory: DataDirectory, job_id: str, said: list[str], **parameters: object) -> JobContext:
    engine = open_database(directory)
    directory.job(job_id).mkdir(exist_ok=True)
    given = {"preset": "tiny", "seed": 0} | parameters
    capture = directory.root.parent

    def tell(told: Progress | CaptureReport) -> None:
        if isinstance(told, Progress):  # the doctor's report says of itself what it is about
            said.append(told.stage)

    return JobContext(job_id, "sphere", given, capture, directory, engine, build_with_drgs, "cpu", tell, lambda: False)


def contents(folder: Path) -> dict[str, bytes]:
    """Files of an asset, without how long its stages took."""
    files = {path.name: path.read_bytes() for path in folder.iterdir()}
    manifest = json.loads(files.pop("asset.json"))
    del manifest["provenance"]["seconds"]
    return files | {"asset.json": json.dumps(manifest).encode()}


@pytest.mark.slow
@pytest.mark.parametrize(("binding", "preset"), [("particles", "tiny"), ("mesh", "bound")])
def test_a_build_that_begins_anew_after_every_stage_makes_the_same_asset_and_can_be_re_decoupled(
    directory: DataDirectory, binding: str, preset: str
) -> None:
    whole: list[str] = []
    run = BuildRun(context(directory, "a" * 32, whole, binding=binding, preset=preset))
    for step in run.steps:
        run.run(step)
    parts: list[str] = []
    for step in run.steps:
        before = len(parts)
        BuildRun(context(directory, "b" * 32, parts, binding=binding, preset=preset)).run(step)
        if step == "materials":
            assert "fit" not in parts[before:]  # nothing but the capture is worked on again
    assert contents(directory.asset("a" * 32)) == contents(directory.asset("b" * 32))
    assert list(dict.fromkeys(whole)) == list(STAGE_SHARES[binding])

    said: list[str] = []
    asked = {"asset": "a" * 32, "preset": "more", "built_preset": preset, "built_seed": 0, "binding": binding}
    again = RedecoupleRun(context(directory, "c" * 32, said, **asked))
    for step in again.steps:
        again.run(step)
    assert "fit" not in said and "bind" not in said and "materials" in said
    first, second = (load_asset(directory.asset(letter * 32)) for letter in "ac")
    assert first.mesh.faces.equal(second.mesh.faces) and not first.mesh.albedo.equal(second.mesh.albedo)
    moved = (first.mesh.vertices - second.mesh.vertices).norm(dim=1)
    corners = first.mesh.vertices[first.mesh.faces.long()]
    edge = float((corners - corners.roll(1, 1)).norm(dim=-1).mean())
    assert float(moved.mean()) < 0.1 * edge and float(moved.max()) < edge
    assert (first.provenance["materials"], second.provenance["materials"]) == (preset, "more")
    assert first.provenance["binding"] == second.provenance["binding"] == binding
    from sqlalchemy.orm import Session

    with Session(open_database(directory)) as session:
        assert session.query(AssetRow).count() == 3
