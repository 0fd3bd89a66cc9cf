"""An exported GLB, and a USDZ, look in three.js as the object looks here: same place, same materials, under the same light."""

import io
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
import torch
import trimesh
from jaxtyping import Float
from numpy import ndarray
from PIL import Image
from playwright.sync_api import Browser

from benchmarks.convert._three_picture import SeenByThree, ThreePage
from drgs.convert.bake_edits import bake_edits
from drgs.convert.export_asset import export_asset
from drgs.deform.pose_scene import pose_scene
from drgs.render.records import RenderSettings
from drgs.render.render_frame import render_frame
from drgs.scene.asset import Asset
from drgs.scene.camera import camera_from_opengl
from drgs.scene.edits import AS_CAPTURED, parse_edits
from drgs.scene.environment import Environment
from drgs.scene.mesh import TriangleMesh, vertex_normals
from drgs_server.client import Client
from drgs_worker.jobs.start_view import FOV_Y_DEGREES, start_view
from tests.web.browser import ROOT, RunningServer

ENVIRONMENTS = ROOT / "examples" / "environments"
SIDE = 256
DIFFERENCE = 2.0
"""Mean over pixels and channels, sRGB 0..255: 1.8 without noise of our own rays. three.js filters its environment as if all of it were seen along the
normal, and textures are 8-bit."""
SAMPLES = 512
"""A pixel of our picture."""

WAVES_DIFFERENCE = 6.0
"""The same of a ball with waves, 4.8; 10.4 without a texture of normals."""


@pytest.fixture(scope="module")
def studio(browser: Browser) -> Iterator[ThreePage]:
    """three.js under the studio's light."""
    with closing(ThreePage(browser, (ENVIRONMENTS / "studio.exr").read_bytes())) as page:
        yield page


CAMERA = start_view((-0.5, -0.5, -0.5), (0.5, 0.5, 0.5)).tolist()


@pytest.fixture(scope="module")
def ours(server: RunningServer, ball_asset: str) -> Float[ndarray, "height width 4"]:
    """The service's picture of the ball under the studio's light, 0..255, sRGB, straight alpha."""
    with Client(server.address, token=server.token) as client:
        session = client.open_session(ball_asset)
        session.edit({"op": "environment", "file": "studio.exr"})
        picture = session.frame(SIDE, SIDE, SAMPLES, CAMERA, FOV_Y_DEGREES, background="transparent")
    return np.asarray(Image.open(io.BytesIO(picture)).convert("RGBA"), float)


@pytest.mark.parametrize("format", ["glb", "usdz"])
def test_an_exported_file_looks_the_same_in_three(
    format: Literal["glb", "usdz"],
    server: RunningServer,
    studio: ThreePage,
    ball_asset: str,
    ours: Float[ndarray, "height width 4"],
    tmp_path: Path,
) -> None:
    path = tmp_path / f"ball.{format}"
    with Client(server.address, token=server.token) as client:
        client.export(ball_asset, format, path)
    theirs = studio.fine_picture(path.read_bytes(), f".{format}", SeenByThree(CAMERA, FOV_Y_DEGREES, SIDE, SIDE, stands(path)))
    inside = (ours[..., 3] > 254) & (theirs[..., 3] > 254)
    assert inside.sum() > 0.97 * max((ours[..., 3] > 127).sum(), (theirs[..., 3] > 127).sum()) - 4 * SIDE, "the same silhouette"
    difference = np.abs(ours - theirs)[inside][:, :3].mean()
    print(f"{format}: mean difference {difference:.2f} of 255")
    assert difference < DIFFERENCE, f"mean difference {difference:.1f} of 255"


@pytest.mark.slow
def test_waves_that_faces_were_too_few_for_are_seen_in_three(studio: ThreePage, tmp_path: Path) -> None:
    """By the texture of normals and the tangents with it: without them, or with one of their axes turned over, the bound is passed."""
    asset = wavy_ball(5)
    path = tmp_path / "ball.glb"
    assert "1000 of the mesh's 20480 faces" in export_asset(asset, path, "mesh", faces=1000)
    view = start_view((-0.5, -0.5, -0.5), (0.5, 0.5, 0.5))
    focal = SIDE / 2 / np.tan(np.radians(FOV_Y_DEGREES / 2))
    intrinsics = torch.tensor([[focal, 0, SIDE / 2], [0, focal, SIDE / 2], [0, 0, 1]])
    scene = pose_scene(asset, parse_edits([{"op": "environment", "file": "studio.exr"}]), ENVIRONMENTS)
    frame = render_frame(scene, camera_from_opengl(torch.from_numpy(view), intrinsics, SIDE, SIDE), RenderSettings(samples_per_pixel=128))
    seen = SeenByThree(view.tolist(), FOV_Y_DEGREES, SIDE, SIDE)
    a, b = 255 * frame.rgba_srgb.numpy(), studio.picture(path.read_bytes(), ".glb", seen).astype(float)
    inside = (a[..., 3] > 254) & (b[..., 3] > 254)
    difference = np.abs(a - b)[inside][:, :3].mean()
    print(f"waves: mean difference {difference:.2f} of 255")
    assert difference < WAVES_DIFFERENCE


@pytest.mark.slow
def test_three_shows_each_variant_as_an_asset_that_wears_it(studio: ThreePage, tmp_path: Path) -> None:
    asset, path = wavy_ball(4), tmp_path / "ball.glb"
    gold = parse_edits(
        [{"op": "material", "select": {"all": True}, "set": {"albedo": [1.0, 0.77, 0.34], "metallic": 1.0, "roughness": 0.3}}]
    )
    export_asset(asset, path, "mesh", faces=1000, variants={"Gold": gold})
    export_asset(bake_edits(asset, gold, tmp_path, 2), tmp_path / "gold.glb", "mesh", faces=1000)
    view = start_view((-0.5, -0.5, -0.5), (0.5, 0.5, 0.5)).tolist()

    def seen(file: Path, variant: str | None) -> np.ndarray:
        told = SeenByThree(view, FOV_Y_DEGREES, SIDE, SIDE, variant=variant)
        return studio.picture(file.read_bytes(), ".glb", told).astype(float)

    opened, captured, worn = seen(path, None), seen(path, AS_CAPTURED), seen(path, "Gold")
    np.testing.assert_array_equal(opened, captured)
    np.testing.assert_array_equal(worn, seen(tmp_path / "gold.glb", None))
    inside = opened[..., 3] > 254
    assert np.abs(worn - opened)[inside][:, :3].mean() > 20


def wavy_ball(subdivisions: int) -> Asset:
    ball = trimesh.creation.icosphere(subdivisions, 0.5)
    x, y, z = 28 * ball.vertices.T
    points = torch.tensor(ball.vertices * (1 + 0.04 * np.sin(x) * np.sin(y) * np.sin(z))[:, None], dtype=torch.float32)
    faces, count = torch.tensor(np.asarray(ball.faces), dtype=torch.int32), len(points)
    mesh = TriangleMesh(
        points, faces, vertex_normals(points, faces), torch.full((count, 3), 0.6), torch.full((count,), 0.35), torch.zeros(count)
    )
    return Asset(None, mesh, None, Environment(torch.ones(16, 32, 3)))


def stands(path: Path) -> tuple[float, float, float]:
    """How far the file moves the object from where the asset has it [m], y up."""
    if path.suffix != ".usdz":
        return (0.0, 0.0, 0.0)
    from pxr import Usd, UsdGeom

    stage = Usd.Stage.Open(str(path))
    return tuple(UsdGeom.XformCommonAPI(stage.GetDefaultPrim()).GetXformVectors(Usd.TimeCode.Default())[0])
