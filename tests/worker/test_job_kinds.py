"""Renders, simulations and exports, each run in this process on a small real asset."""

from collections.abc import Callable
from pathlib import Path

import av
import numpy as np
import pytest
from PIL import Image

from drgs.convert.import_mesh import import_mesh
from drgs.deform.clip import open_clip
from drgs.exchange.exr import encode_environment
from drgs.reconstruct.progress import POSED, Progress
from drgs.scene.asset import Asset, save_asset
from drgs_worker.jobs.progress import JobStopped
from drgs_worker.jobs.start_view import turntable_view
from drgs_worker.jobs.steps.build import KEPT_CHECKPOINTS, RedecoupleRun
from drgs_worker.jobs.steps.export import ExportRun
from drgs_worker.jobs.steps.job_run import AbstractJobRun, JobContext
from drgs_worker.jobs.steps.render import RenderRun
from drgs_worker.jobs.steps.simulate import SimulateRun
from drgs_worker.store.data_directory import open_data_directory
from tests.scene.grey_cube import grey_cube, material

ASSET, JOB = "a" * 32, "b" * 32
SMALL = {"kind": "render", "asset": ASSET, "width": 32, "height": 24, "spp": 4, "denoise": False}


@pytest.fixture(scope="module")
def cube() -> Asset:
    return grey_cube()


@pytest.fixture
def job(tmp_path: Path, cube: Asset) -> Callable[..., JobContext]:
    directory = open_data_directory(tmp_path / "data")
    save_asset(cube, directory.asset(ASSET))
    dark = np.full((8, 16, 3), 0.05, np.float32)
    (directory.environments / "dark.exr").write_bytes(encode_environment(dark))
    directory.job(JOB).mkdir()

    def make(parameters: dict, progress: Callable[[Progress], None] = lambda made: None, should_stop=lambda: False) -> JobContext:
        return JobContext(JOB, "test", parameters, None, directory, None, None, "cpu", progress, should_stop)  # type: ignore[arg-type]

    return make


def run(made: AbstractJobRun) -> None:
    for step in made.steps:
        made.run(step)


def mean(path: Path) -> float:
    return float(np.asarray(Image.open(path))[..., :3].mean())


def test_a_render_makes_every_picture_once_and_a_video_of_each_row(job: Callable[..., JobContext]) -> None:
    request = SMALL | {
        "turntable": {"frames": 3},
        "environments": ["own", "dark.exr"],
        "variants": [{"name": "grey", "edits": []}, {"name": "black", "edits": [material(albedo=[0, 0, 0])]}],
        "video_fps": 12,
    }
    reports: list[Progress] = []
    context = job(request, reports.append)
    run(RenderRun(context))
    names = {path.name for path in context.files.iterdir()}
    rows = [f"{variant}-{light}" for variant in ("grey", "black") for light in ("own", "dark")]
    assert names == {f"{row}-{k:04d}.png" for row in rows for k in range(3)} | {f"{row}.mp4" for row in rows}
    brightness = {row: mean(context.files / f"{row}-0001.png") for row in rows}
    assert brightness["grey-own"] > brightness["grey-dark"] and brightness["grey-own"] > brightness["black-own"]
    with av.open(str(context.files / "grey-own.mp4")) as video:
        assert [frame.width for frame in video.decode(video=0)] == [32] * 3
    assert [made.iteration for made in reports] == list(range(1, 13)) and reports[-1].fraction == 1.0
    assert reports[0].preview_jpeg is not None and reports[0].preview_jpeg.startswith(b"\xff\xd8")
    before = {path: path.read_bytes() for path in context.files.glob("*.png")}
    lost = context.files / "black-own-0002.png"
    lost.unlink()
    again: list[Progress] = []
    run(RenderRun(job(request, again.append)))
    assert [made.message for made in again if made.preview_jpeg is not None] == [lost.name]  # the others were kept
    assert {path: path.read_bytes() for path in context.files.glob("*.png")} == before


def test_a_render_is_exposed_toned_and_backed_as_asked(job: Callable[..., JobContext]) -> None:
    toned = {"exposure_stops": 1.0, "tone_curve": "neutral", "background": "blurred"}
    for name, settings in (("plain", {}), ("toned", toned)):
        context = job(SMALL | settings | {"variants": [{"name": name, "edits": []}]})
        run(RenderRun(context))
    plain, bright = (np.asarray(Image.open(path)) for path in sorted(context.files.glob("*.png")))
    assert bright[..., :3].mean() > plain[..., :3].mean() + 5 and bright[..., 3].min() == 255


def test_a_render_stops_between_slices_and_leaves_no_half_picture(job: Callable[..., JobContext]) -> None:
    asked = 0

    def should_stop() -> bool:
        nonlocal asked
        asked += 1
        return asked > 2

    context = job(SMALL | {"spp": 64}, should_stop=should_stop)
    with pytest.raises(JobStopped):
        run(RenderRun(context))
    assert list(context.files.iterdir()) == []


@pytest.mark.parametrize(("azimuth", "direction"), [(0.0, [0, -1, 0]), (90.0, [1, 0, 0])])
def test_a_turntable_looks_at_the_middle_from_all_around(azimuth: float, direction: list[float]) -> None:
    view = turntable_view([-1, -1, 0], [1, 1, 2], azimuth, 0.0)
    offset = view[:3, 3] - np.array([0, 0, 1])
    np.testing.assert_allclose(offset / np.linalg.norm(offset), direction, atol=1e-12)
    np.testing.assert_allclose(view[:3, 2], direction, atol=1e-12)  # looks down -z
    np.testing.assert_allclose(view[:3, 1], [0, 0, 1], atol=1e-12)
    assert np.linalg.det(view) == pytest.approx(1)


def test_a_simulation_becomes_a_clip_that_pictures_show(job: Callable[..., JobContext]) -> None:
    scene = {"particles": 200, "duration": 0.2, "fps": 10, "floor": None, "gravity": 5.0}
    context = job({"kind": "simulate", "asset": ASSET, "scene": scene})
    run(SimulateRun(context))
    clip = open_clip(context.directory.clip(JOB))
    assert (clip.frame_count, clip.vertices) == (3, 26)
    stopped = job({"kind": "simulate", "asset": ASSET, "scene": scene | {"seed": 1}}, should_stop=lambda: True)
    run(SimulateRun(stopped))  # done already: nothing is computed, so nothing stops
    two_cameras = [
        {"name": name, "world_from_camera": turntable_view([-0.5] * 3, [0.5] * 3, 0, 0).tolist()} for name in ("first", "second")
    ]
    run(RenderRun(job(SMALL | {"clip": f"clips/{JOB}", "cameras": two_cameras, "video_fps": 5})))
    first, second = (np.asarray(Image.open(context.files / f"asset-light-{name}.png")) for name in ("first", "second"))
    assert np.abs(first.astype(int) - second).max() > 20  # the second shows it 0.2 s later, fallen


def test_a_simulation_that_was_stopped_goes_on_with_the_next_frame(job: Callable[..., JobContext]) -> None:
    request = {"kind": "simulate", "asset": ASSET, "scene": {"particles": 200, "duration": 0.2, "fps": 10, "floor": None}}
    told: list[Progress] = []
    context = job(request, told.append, lambda: len(told) >= 2)
    with pytest.raises(JobStopped):
        run(SimulateRun(context))
    assert (context.directory.growing_clip(JOB) / "state.safetensors").is_file() and not context.directory.clip(JOB).exists()
    again: list[Progress] = []
    run(SimulateRun(job(request, again.append)))
    assert [made.iteration for made in again] == [2, 3]
    assert told[0].eta_seconds is None and told[1].eta_seconds > 0, "one frame of three is left"
    assert [made.eta_seconds for made in again] == [None, 0]
    assert open_clip(context.directory.clip(JOB)).frame_count == 3 and not context.directory.growing_clip(JOB).exists()


def test_a_film_passes_its_views_and_is_as_bright_as_asked(job: Callable[..., JobContext]) -> None:
    low, high = {"eye": [0, -3, 0], "target": [0, 0, 0]}, {"eye": [0, -2, 2], "target": [0, 0, 0], "seconds": 0.5}
    context = job(SMALL | {"path": {"keyframes": [low, high]}, "video_fps": 4, "background": "transparent"})
    run(RenderRun(context))
    assert sorted(path.name for path in context.files.iterdir()) == [
        "asset-light-0000.png",
        "asset-light-0001.png",
        "asset-light-0002.png",
        "asset-light.mp4",
    ]
    pictures = [np.asarray(Image.open(path)) for path in sorted(context.files.glob("*.png"))]
    assert not np.array_equal(pictures[0], pictures[1]), "the camera moves"
    with av.open(str(context.files / "asset-light.mp4")) as film:
        assert film.streams.video[0].frames == 3 and film.streams.video[0].average_rate == 4
    there = {"name": "there", "world_from_camera": [[1, 0, 0, 0], [0, 0, -1, -3], [0, 1, 0, 0], [0, 0, 0, 1]]}
    run(RenderRun(job(SMALL | {"cameras": [there], "background": "transparent"})))
    np.testing.assert_array_equal(np.asarray(Image.open(context.files / "asset-light-there.png")), pictures[0])
    run(RenderRun(job(SMALL | {"cameras": [there | {"name": "dark"}], "background": "transparent", "exposure_stops": -1})))
    inside = pictures[0][..., 3] == 255
    darker = np.asarray(Image.open(context.files / "asset-light-dark.png"))[inside].mean() / pictures[0][inside].mean()
    assert darker < 0.85


@pytest.mark.slow
def test_an_export_writes_each_format(job: Callable[..., JobContext]) -> None:
    pytest.importorskip("pxr", reason="the optional package usd-core is not installed")
    context = job({"kind": "export", "asset": ASSET, "formats": ["glb", "usdz", "usd"]})
    run(ExportRun(context))
    starts = {path.name: path.read_bytes()[:4] for path in context.files.iterdir()}
    assert starts == {"asset-glb.glb": b"glTF", "asset-usdz.usdz": b"PK\3\4", "asset-usd.usdz": b"PK\3\4"}
    with pytest.raises(ValueError, match="Gaussians"):
        run(ExportRun(job({"kind": "export", "asset": ASSET, "formats": ["ply"]})))
    assert len(list(context.files.iterdir())) == 3


@pytest.mark.slow
def test_an_export_has_the_faces_and_the_variants_that_were_asked_for(job: Callable[..., JobContext]) -> None:
    """Of textured meshes, and of those that can hold variants; light has neither."""
    black = {"name": "Black", "edits": [material(albedo=[0, 0, 0])]}
    context = job({"kind": "export", "asset": ASSET, "formats": ["mesh", "env"], "faces": 20, "variants": [black]})
    run(ExportRun(context))
    assert (context.files / "asset-env.exr").stat().st_size > 0
    assert 12 <= len(import_mesh(context.files / "asset-mesh.glb").mesh.faces) <= 20
    text = (context.files / "asset-mesh.glb").read_bytes()
    assert b'"variants":[{"name":"As captured"},{"name":"Black"}]' in text.replace(b": ", b":").replace(b", ", b",")


def test_an_asset_without_its_build_cannot_be_re_decoupled(job: Callable[..., JobContext]) -> None:
    with pytest.raises(ValueError, match="geometry was not kept"):
        run(RedecoupleRun(job({"kind": "redecouple", "asset": ASSET, "preset": "full"})))


def test_a_re_decoupling_takes_the_poses_that_the_build_found(job: Callable[..., JobContext]) -> None:
    context = job({"kind": "redecouple", "asset": ASSET, "preset": "full"})
    source = context.directory.job(ASSET) / "asset.build"
    (source / POSED / "images").mkdir(parents=True)
    (source / POSED / "transforms.json").write_text("{}")
    kept = (*KEPT_CHECKPOINTS["particles"], "hollows.safetensors")  # of FOUND_BEFORE what there is
    for name in kept:
        (source / name).write_text(name)
    for _ in range(2):  # a step may be repeated
        RedecoupleRun(context).run("copy")
    work = context.folder / "asset.build"
    assert {path.name for path in work.iterdir()} == {*kept, POSED}
    assert (work / POSED / "transforms.json").read_text() == "{}"
