"""Blender's extension reads assets as drgs does, here without Blender; and with it, imports them, and its picture is ours.

What needs Blender runs where DRGS_BLENDER names one: Blender's program, or a Python that has the package bpy (tests/blender/inside_blender.py).
It cannot be the Python of the tests, since Blender up to 5.0 wants a NumPy below 2, and drgs one from 2 on.
"""

import importlib
import json
import os
import subprocess
import sys
import types
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
import torch

from blender.build import build_extension
from drgs import __version__
from drgs.convert.gltf_reflectance import gltf_base_color
from drgs.deform.pose_scene import pose_scene
from drgs.maths.frames import rotation_from_quat_wxyz
from drgs.maths.sampling import sphere_lattice
from drgs.maths.spherical_harmonics import K00, SH_OFFSET, sh_basis
from drgs.render.film.tonemap import tonemap
from drgs.render.records import RenderSettings
from drgs.render.render_frame import render_frame
from drgs.scene.asset import SCHEMA_VERSION, Asset, load_asset, save_asset
from drgs.scene.camera import camera_from_opengl, opengl_from_camera
from drgs_worker.jobs.start_view import turntable_view
from tests.convert.test_export_asset import ball_asset
from tests.patience import PATIENCE_SECONDS

BLENDER = os.environ.get("DRGS_BLENDER")
needs_blender = pytest.mark.skipif(not BLENDER, reason="DRGS_BLENDER names no Blender, and no Python with bpy")
SIDE = 64


@pytest.fixture(scope="module")
def asset() -> Asset:
    """A ball two units above the ground of half a metre a unit, seen off its picture's middle by a camera with a name, under smooth light."""
    ball = ball_asset()
    intrinsics = torch.tensor([[80.0, 0, 30], [0, 80.0, 35], [0, 0, 1]])
    view = torch.from_numpy(turntable_view((-1, -1, 1), (1, 1, 3), 30, 20))
    rows = torch.linspace(1.5, 0.5, 8)[:, None, None] * torch.tensor([1.0, 0.9, 0.7]) + torch.linspace(0, 0.5, 16)[:, None]
    environment = replace(ball.environment, radiance=rows.contiguous())
    return replace(ball, environment=environment, cameras=(camera_from_opengl(view, intrinsics, SIDE, SIDE, "front"),))


@pytest.fixture(scope="module")
def folder(asset: Asset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("blender") / "ball"
    save_asset(asset, path)
    return path


@pytest.fixture(scope="module")
def extension(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build_extension(tmp_path_factory.mktemp("extension"))


@pytest.fixture(scope="module")
def reader(extension: Path, tmp_path_factory: pytest.TempPathFactory) -> types.ModuleType:
    """The extension's read_asset, as its zip holds it: imported without the package's own `__init__`, which is Blender's business."""
    unpacked = tmp_path_factory.mktemp("unpacked")
    with zipfile.ZipFile(extension) as archive:
        archive.extractall(unpacked)
    package = types.ModuleType("unpacked_extension")
    package.__path__ = [str(unpacked)]
    sys.modules[package.__name__] = package
    return importlib.import_module("unpacked_extension.read_asset")


def test_the_zip_is_an_extension_of_this_version_and_needs_no_drgs(extension: Path, tmp_path: Path):
    assert extension.name == f"drgs-blender-{__version__}.zip"
    with zipfile.ZipFile(extension) as archive:
        texts = {name: archive.read(name).decode() for name in archive.namelist() if name.endswith((".py", ".toml"))}
        assert {"LICENSE", "base_colors.npy"} <= set(archive.namelist())
    assert f'version = "{__version__}"' in texts["blender_manifest.toml"]
    assert [name for name, text in texts.items() if "import drgs" in text or "from drgs" in text or "torch" in text.split('"""')[-1]] == []
    assert build_extension(tmp_path).read_bytes() == extension.read_bytes()


@pytest.mark.parametrize("kind", ["folder", "asset.json", "zip"])
def test_an_asset_is_read_as_drgs_reads_it(reader: types.ModuleType, asset: Asset, folder: Path, tmp_path: Path, kind: str):
    path = {"folder": folder, "asset.json": folder / "asset.json", "zip": tmp_path / "ball.zip"}[kind]
    if kind == "zip":
        save_asset(asset, path)
    read, ours = reader.read_asset(path), load_asset(folder)
    assert ours.gaussians is not None
    assert (read.name, read.meters_per_unit, read.light_turns) == ("ball", 0.5, False)
    for found, wanted in ((read.vertices, ours.mesh.vertices), (read.normals, ours.mesh.normals), (read.faces, ours.mesh.faces)):
        assert np.array_equal(found, wanted.numpy())
    assert np.allclose(read.splats.opacities, torch.sigmoid(ours.gaussians.opacity_logits).numpy(), atol=1e-6)
    assert np.allclose(read.splats.scales, torch.exp(ours.gaussians.log_scales).numpy(), rtol=1e-6)
    assert np.allclose(np.linalg.norm(read.splats.quats_wxyz, axis=1), 1, atol=1e-6)
    (camera,) = read.cameras
    assert (camera.name, camera.width, camera.height) == ("front", SIDE, SIDE)
    assert np.allclose(camera.world_from_camera, opengl_from_camera(ours.cameras[0]).numpy())


def test_base_colors_are_those_that_a_glb_gets(reader: types.ModuleType):
    random = torch.Generator().manual_seed(0)
    albedo, roughness, metallic = (torch.rand(2000, *size, generator=random) for size in ((3,), (), ()))
    found = reader.base_color_from_albedo(albedo.numpy(), roughness.numpy(), metallic.numpy())
    assert np.abs(found - gltf_base_color(albedo, roughness, metallic).numpy()).max() < 0.004
    # Beyond 0..1 a material is the nearest there is.
    edge = reader.base_color_from_albedo(np.array([[2.0, -1, 1]]), np.array([1.0]), np.array([1.0]))
    assert np.allclose(edge[0, 0], edge[0, 2]) and edge[0, 1] < 1e-6


def test_splats_send_out_the_mean_of_what_views_of_their_front_see(reader: types.ModuleType, asset: Asset, folder: Path):
    assert asset.gaussians is not None
    found = reader.read_asset(folder).splats.radiance
    normals = rotation_from_quat_wxyz(asset.gaussians.quats_wxyz)[..., 2].double()
    towards = sphere_lattice(3000)
    sizes = (-normals @ towards.T).clamp(min=0)
    sh = asset.gaussians.sh.double()
    seen = torch.einsum("nd,dk,nkc->nc", sizes, sh_basis(towards), sh) / sizes.sum(-1, keepdim=True) + SH_OFFSET
    assert np.abs(found - seen.numpy()).max() < 0.01
    # What is sent backwards, where no camera was, is not in it.
    assert (torch.from_numpy(found) - (K00 * sh[:, 0] + SH_OFFSET)).abs().max() > 0.05


def test_what_is_no_asset_is_refused_with_a_sentence(reader: types.ModuleType, asset: Asset, tmp_path: Path):
    assert reader.NEWEST_SCHEMA == SCHEMA_VERSION
    with pytest.raises(ValueError, match=r"has no asset\.json; expected an asset"):
        reader.read_asset(tmp_path)
    save_asset(asset, tmp_path / "ball")
    (tmp_path / "ball" / "mesh.glb").write_bytes(b"glTF")
    with pytest.raises(ValueError, match=r"mesh\.glb has 4 bytes, \d+ were written; the asset is damaged"):
        reader.read_asset(tmp_path / "ball")


def inside_blender(extension: Path, folder: Path, work: Path, *picture: str) -> dict:
    """What inside_blender.py tells, with settings of its own in `work`."""
    script = str(Path(__file__).with_name("inside_blender.py"))
    assert BLENDER is not None
    program = (
        [BLENDER, script] if "python" in Path(BLENDER).name else [BLENDER, "--background", "--factory-startup", "--python", script, "--"]
    )
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"} | {"BLENDER_USER_RESOURCES": str(work)}
    command = [*program, str(extension), str(folder), str(work / "report.json"), *picture]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=PATIENCE_SECONDS)
    assert (work / "report.json").is_file(), done.stdout + done.stderr
    return json.loads((work / "report.json").read_text())


@needs_blender
@pytest.mark.slow
def test_blender_imports_what_the_asset_holds_and_draws_our_picture(extension: Path, asset: Asset, folder: Path, tmp_path: Path):
    told = inside_blender(extension, folder, tmp_path, str(tmp_path / "picture.exr"), "256", "front", "mesh")
    assert told["answer"] == ["FINISHED"] and told["menu"] == ["bl_ext.user_default.drgs_import"]
    mesh, (camera,) = asset.mesh, asset.cameras
    assert told["faces"] == len(mesh.faces) and np.allclose(told["vertices"], mesh.vertices.flatten().numpy())
    assert np.allclose(told["corner_normal"], mesh.normals[told["corner_vertex"]].numpy(), atol=1e-3)
    assert {"base_color", "roughness", "metallic"} <= set(told["attributes"])
    assert np.allclose(told["scale"], 0.5) and told["splats"] == [[30, True]] and told["size"] == [SIDE, SIDE]
    world_from_camera = np.diag([0.5, 0.5, 0.5, 1]) @ opengl_from_camera(camera).numpy()
    assert np.allclose(told["cameras"]["front"], world_from_camera, atol=1e-5)
    # Rows of Blender's pictures go up.
    pixels = np.array(told["environment_pixels"]).reshape(*told["environment"][0][::-1], 4)[::-1, :, :3]
    assert told["environment"][1] and np.allclose(pixels, asset.environment.radiance.numpy(), rtol=1e-3)

    frame = render_frame(pose_scene(asset, []), camera, RenderSettings(samples_per_pixel=256, bounces=4, primary="mesh"))
    ours = 255 * tonemap(frame.radiance_linear, frame.gbuffer.coverage).numpy()
    with OpenEXR.File(str(tmp_path / "picture.exr")) as file:
        linear = torch.from_numpy(file.channels()["RGBA"].pixels.copy())
    theirs = 255 * tonemap(linear[..., :3], linear[..., 3]).numpy()
    inside = (ours[..., 3] > 254) & (theirs[..., 3] > 254)
    assert inside.sum() > 0.9 * (ours[..., 3] > 254).sum() > 500
    # Measured 0.8 of 255 by Blender 5.0.1, the noise of 256 rays in it.
    assert np.abs(ours - theirs)[inside, :3].mean() < 1.5


@needs_blender
@pytest.mark.slow
def test_blender_says_why_an_asset_is_refused(extension: Path, asset: Asset, tmp_path: Path):
    save_asset(asset, tmp_path / "ball")
    (tmp_path / "ball" / "environment.exr").unlink()
    told = inside_blender(extension, tmp_path / "ball" / "asset.json", tmp_path)
    assert told["answer"] == ["CANCELLED"] and "environment.exr is missing; the asset is damaged" in told["refused"]
