"""What others make of files of the sample: Khronos' validator, three.js, SuperSplat's reader, OpenUSD's validators, and Blender where there is one.

The asset is the one that test_whole_path.py has had a worker build of the sample's photographs; where that did not run, it is built here as there.
Files of a ball are asked more closely, and with one thing wrong in them, in test_exported_files.py, test_exported_glb.py, tests/exchange/test_usd.py
and tests/blender.
"""

import io
import zipfile
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
import torch
from jaxtyping import Float
from numpy import ndarray
from playwright.sync_api import Browser
from scipy.spatial import cKDTree

from benchmarks.measures.three_picture import SeenByThree, ThreePage
from blender.build import build_extension
from drgs.convert import bake_transfer
from drgs.convert.export_asset import export_asset
from drgs.convert.transform_splats import transform_splats
from drgs.deform.pose_scene import pose_scene
from drgs.exchange.gaussian_ply import log_thickness
from drgs.exchange.gltf_splats import EXTENSION, GltfSplats
from drgs.exchange.ply import parse_ply
from drgs.maths.constants import STILL_BOUNCES
from drgs.render.film.tonemap import tonemap
from drgs.render.records import RenderSettings
from drgs.render.render_frame import render_frame
from drgs.scene.asset import Asset, load_asset
from drgs.scene.camera import Camera, camera_from_opengl
from drgs.scene.edits import parse_edits
from drgs_server.client import Client
from drgs_worker.jobs.builders import BuildRequest
from drgs_worker.jobs.start_view import FOV_Y_DEGREES, start_view
from tests.blender.test_blender_extension import inside_blender, needs_blender
from tests.exchange.write_splats import with_document
from tests.web import short_builder
from tests.web.browser import RunningServer
from tests.web.test_exported_files import ERROR, check_splats, check_spz, findings, meant, name_splats_as_ours, splats_in_three
from tests.web.test_exported_glb import ENVIRONMENTS
from tests.web.test_whole_path import small_capture

NAME = "Little sample"
SIDE = 128
SAMPLES = 128
LIGHT = "overcast.exr"
THREE_DIFFERENCE = 5.0
"""Mean over pixels and channels, sRGB 0..255: 3.7. docs/formats.md says what such a difference consists of."""
CYCLES_SAMPLES = 256
CYCLES_DIFFERENCE = 2.5
"""Likewise: 1.7 by Blender 5.0.1, noise of both included."""

Picture = Float[ndarray, "height width 4"]
"""0..255, sRGB, straight alpha."""


@pytest.fixture(scope="module")
def folder(server: RunningServer, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The sample's asset."""
    with Client(server.address, token=server.token) as client:
        built = [asset.id for asset in client.assets(search=NAME).assets if asset.name == NAME]
    if built:
        return server.data / "assets" / built[0]
    work = tmp_path_factory.mktemp("sample")
    with zipfile.ZipFile(io.BytesIO(small_capture())) as archive:
        archive.extractall(work / "capture")
    asked = BuildRequest(work / "capture", work / "asset", "draft", seed=0, device="cpu")
    for _ in short_builder.build(asked, lambda progress: None, lambda: False):
        pass
    return asked.out


@pytest.fixture(scope="module")
def sample(folder: Path) -> Asset:
    asset = load_asset(folder)
    assert asset.gaussians is not None and len(asset.mesh.faces) > 1000 and len(asset.gaussians.centers) > 1000
    return asset


@pytest.fixture(scope="module")
def exported(sample: Asset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Its GLB with mesh and splats."""
    path = tmp_path_factory.mktemp("exported") / "sample.glb"
    export_asset(sample, path, "glb")
    return path


def test_the_gltf_validator_finds_no_fault_in_the_samples_glb(exported: Path, run_node: Callable[..., str], tmp_path: Path) -> None:
    whole = exported.read_bytes()
    said = findings(run_node, tmp_path, whole=whole, under_our_names=with_document(whole, name_splats_as_ours))
    assert {message["code"] for message in said["under_our_names"]} == {"UNSUPPORTED_EXTENSION"}
    refused = {message["pointer"].rpartition("/")[2] for message in said["whole"] if message["severity"] == ERROR}
    assert len(refused) == 19 and all(name.startswith(f"{EXTENSION}:") for name in refused), "names that it does not know yet"


def test_three_draws_the_samples_glb_as_we_do(sample: Asset, exported: Path, browser: Browser) -> None:
    low, high = sample.mesh.vertices.amin(0).tolist(), sample.mesh.vertices.amax(0).tolist()
    view = start_view(low, high)
    focal = SIDE / 2 / np.tan(np.radians(FOV_Y_DEGREES / 2))
    camera = camera_from_opengl(torch.from_numpy(view), torch.tensor([[focal, 0, SIDE / 2], [0, focal, SIDE / 2], [0, 0, 1.0]]), SIDE, SIDE)
    in_metres = view.copy()
    in_metres[:3, 3] *= sample.meters_per_unit
    seen = SeenByThree(in_metres.tolist(), FOV_Y_DEGREES, SIDE, SIDE)
    with closing(ThreePage(browser, (ENVIRONMENTS / LIGHT).read_bytes())) as three:
        theirs = three.fine_picture(exported.read_bytes(), ".glb", seen)
    difference = mean_difference(our_picture(sample, camera, LIGHT), theirs)
    print(f"three.js: mean difference {difference:.2f} of 255")
    assert difference < THREE_DIFFERENCE


def our_picture(asset: Asset, camera: Camera, light: str | None = None) -> Picture:
    """By rays that are not filtered, in the asset's own light or another."""
    edits = [] if light is None else parse_edits([{"op": "environment", "file": light}])
    settings = RenderSettings(samples_per_pixel=SAMPLES, bounces=STILL_BOUNCES, primary="mesh")
    frame = render_frame(pose_scene(asset, edits, ENVIRONMENTS), camera, settings)
    return 255 * tonemap(frame.radiance_linear, frame.gbuffer.coverage).double().numpy()


def mean_difference(ours: Picture, theirs: Picture) -> float:
    """Over channels and the pixels that both cover wholly, which are nearly all that either covers at all."""
    inside = (ours[..., 3] > 254) & (theirs[..., 3] > 254)
    assert inside.sum() > 0.97 * max((ours[..., 3] > 127).sum(), (theirs[..., 3] > 127).sum()) - 4 * SIDE > 0, "another silhouette"
    return float(np.abs(ours - theirs)[inside][:, :3].mean())


def test_three_reads_the_samples_splats(sample: Asset, exported: Path, run_node: Callable[..., str], tmp_path: Path) -> None:
    """Of the file without its textures, for Node knows no pictures."""

    def take_textures_away(document: dict) -> None:
        document["materials"] = [{} for _ in document["materials"]]
        del document["textures"], document["images"]

    (tmp_path / "plain.glb").write_bytes(with_document(exported.read_bytes(), take_textures_away))
    given = meant(sample)
    thickness = np.exp(log_thickness(given["centers"], given["log_scales"]))
    scales = np.concatenate([np.exp(given["log_scales"]), thickness[:, None]], -1)
    quats = given["quats_wxyz"] / np.linalg.norm(given["quats_wxyz"], axis=1, keepdims=True)
    opacities = 1 / (1 + np.exp(-given["opacity_logits"]))
    splats = GltfSplats(given["centers"], quats[:, [1, 2, 3, 0]], scales, opacities, given["sh"], "srgb_rec709_display")
    splats_in_three(run_node, tmp_path / "plain.glb", splats)


def test_supersplats_reader_takes_every_column_of_the_samples_ply(sample: Asset, run_node: Callable[..., str], tmp_path: Path) -> None:
    export_asset(sample, tmp_path / "a.ply", "ply")
    check_splats(run_node, tmp_path / "a.ply", meant(sample), "2dgs")


def test_splat_transform_reads_the_samples_spz(sample: Asset, run_node: Callable[..., str], tmp_path: Path) -> None:
    check_spz(run_node, sample, tmp_path)


def test_splat_transform_reads_the_sample_that_it_compressed(sample: Asset, run_node: Callable[..., str], tmp_path: Path) -> None:
    """As PLY: a SOG of as many is clustered for far longer than all of this takes, so those of the suite are the ball's."""
    made = tmp_path / "a.compressed.ply"
    transform_splats(sample, made, "compressed")
    run_node("node_modules/@playcanvas/splat-transform/bin/cli.mjs", "--quiet", made, tmp_path / "back.ply")
    read = parse_ply((tmp_path / "back.ply").read_bytes()).elements["vertex"].scalars
    found, given = np.stack([read[axis] for axis in "xyz"], -1).astype(float), meant(sample)["centers"]
    nearest, _ = cKDTree(found).query(given)
    print(f"compressed: places {nearest.max() / np.ptp(given):.6f} of the extent")
    assert len(found) == len(given) and nearest.max() < 0.001 * np.ptp(given)


def test_no_validator_of_openusd_finds_a_fault_in_the_samples_files(sample: Asset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("pxr", reason="the optional package usd-core is not installed")
    from tests.exchange.test_usd import findings as usd_findings

    monkeypatch.setattr(bake_transfer, "DIRECTIONS", 16)  # how finely shadows are baked is not asked here
    for format, name in (("usdz", "ar.usdz"), ("usd", "scene.usdz")):
        export_asset(sample, tmp_path / name, format, faces=1000)  # type: ignore[arg-type]
        assert usd_findings(tmp_path / name) == [], name


@needs_blender
def test_blender_draws_the_sample_as_we_do(sample: Asset, folder: Path, tmp_path: Path) -> None:
    camera = sample.cameras[0]
    picture = (str(tmp_path / "picture.exr"), str(CYCLES_SAMPLES), camera.name, "mesh")
    told = inside_blender(build_extension(tmp_path), folder, tmp_path, *picture)
    assert told["answer"] == ["FINISHED"] and told["faces"] == len(sample.mesh.faces) and len(told["cameras"]) == len(sample.cameras)
    with OpenEXR.File(str(tmp_path / "picture.exr")) as file:
        linear = torch.from_numpy(file.channels()["RGBA"].pixels.copy())
    theirs = 255 * tonemap(linear[..., :3], linear[..., 3]).double().numpy()
    difference = mean_difference(our_picture(sample, camera), theirs)
    print(f"Cycles: mean difference {difference:.2f} of 255")
    assert difference < CYCLES_DIFFERENCE
