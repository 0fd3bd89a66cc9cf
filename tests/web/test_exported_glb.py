"""An exported GLB, and a USDZ, look in three.js as the object looks here: same place, same materials, under the same light."""

import base64
import io
import json
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image
from playwright.sync_api import Browser, Route

from drgs.convert.export_asset import export_asset
from drgs.deform.pose_scene import pose_scene
from drgs.render.records import RenderSettings
from drgs.render.render_frame import render_frame
from drgs.scene.asset import Asset
from drgs.scene.camera import camera_from_opengl
from drgs.scene.edits import parse_edits
from drgs.scene.environment import Environment
from drgs.scene.mesh import TriangleMesh, vertex_normals
from drgs_server.client import Client
from drgs_worker.jobs.start_view import FOV_Y_DEGREES, start_view
from tests.web.browser import ROOT, RunningServer
from tests.web.conftest import patient_page, wait_until

THREE = ROOT / "web" / "node_modules" / "three"
SIDE = 256
DIFFERENCE = 10.0
"""Mean over pixels and channels, sRGB 0..255. three.js filters its environment instead of sampling it, and textures are 8-bit."""

WAVES_DIFFERENCE = 7.0
"""The same of a ball with waves, 5.8; with twice the rays 4.9, and 11.3 without a texture of normals."""

PAGE = """<!doctype html><canvas width="SIDE" height="SIDE"></canvas>
<script type="importmap">{"imports": {"three": "/three/build/three.module.js", "three/addons/": "/three/examples/jsm/"}}</script>
<script type="module">
import * as THREE from 'three';
import { GLTFLoader } from 'three/addons/loaders/GLTFLoader.js';
import { USDLoader } from 'three/addons/loaders/USDLoader.js';
import { EXRLoader } from 'three/addons/loaders/EXRLoader.js';
const renderer = new THREE.WebGLRenderer({ canvas: document.querySelector('canvas'), alpha: true, preserveDrawingBuffer: true });
const scene = new THREE.Scene();
const sky = await new EXRLoader().setDataType(THREE.FloatType).loadAsync('/light.exr');
sky.mapping = THREE.EquirectangularReflectionMapping;
scene.environment = new THREE.PMREMGenerator(renderer).fromEquirectangular(sky).texture;
const { world_from_camera, fov_y_degrees, file, stands } = await (await fetch('/camera.json')).json();
const object = file.endsWith('.glb') ? (await new GLTFLoader().loadAsync(file)).scene : await new USDLoader().loadAsync(file);
// Pictures of a package come when they come.
for (let loaded = false; !loaded; await new Promise((later) => setTimeout(later, 50))) {
  loaded = true;
  object.traverse(({ material }) => (loaded &&= !material?.map || Boolean(material.map.image) && Boolean(material.metalnessMap.image)));
}
const moved = new THREE.Group();
moved.position.fromArray(stands).negate();
moved.add(object);
scene.add(moved);
const camera = new THREE.PerspectiveCamera(fov_y_degrees, 1, 0.01, 100);
camera.matrixAutoUpdate = false;
// Our world has z up, glTF's y.
camera.matrix.set(...world_from_camera.flat()).premultiply(new THREE.Matrix4().makeRotationX(-Math.PI / 2));
camera.matrixWorldNeedsUpdate = true;
renderer.render(scene, camera);
window.picture = renderer.domElement.toDataURL('image/png');
</script>"""


@pytest.mark.parametrize("format", ["glb", "usdz"])
def test_an_exported_file_looks_the_same_in_three(
    format: Literal["glb", "usdz"], server: RunningServer, browser: Browser, ball_asset: str, tmp_path: Path
) -> None:
    camera = start_view((-0.5, -0.5, -0.5), (0.5, 0.5, 0.5)).tolist()
    path = tmp_path / f"ball.{format}"
    with Client(server.address, token=server.token) as client:
        client.export(ball_asset, format, path)
        session = client.open_session(ball_asset)
        session.edit({"op": "environment", "file": "studio.exr"})
        picture = session.frame(SIDE, SIDE, 256, camera, FOV_Y_DEGREES, background="transparent")
    light = (ROOT / "examples" / "environments" / "studio.exr").read_bytes()
    ours = Image.open(io.BytesIO(picture))
    seen = {"world_from_camera": camera, "fov_y_degrees": FOV_Y_DEGREES, "stands": stands(path), "file": f"/object.{format}"}
    theirs = three_picture(browser, path.read_bytes(), light, seen)
    a, b = (np.asarray(picture.convert("RGBA"), float) for picture in (ours, theirs))
    inside = (a[..., 3] > 254) & (b[..., 3] > 254)
    assert inside.sum() > 0.97 * max((a[..., 3] > 127).sum(), (b[..., 3] > 127).sum()) - 4 * SIDE, "the same silhouette"
    difference = np.abs(a - b)[inside][:, :3].mean()
    print(f"{format}: mean difference {difference:.2f} of 255")
    assert difference < DIFFERENCE, f"mean difference {difference:.1f} of 255"


@pytest.mark.slow
def test_waves_that_faces_were_too_few_for_are_seen_in_three(browser: Browser, tmp_path: Path) -> None:
    """By the texture of normals and the tangents with it: without them, or with one of their axes turned over, the bound is passed."""
    asset = wavy_ball()
    path = tmp_path / "ball.glb"
    assert "1000 of the mesh's 81920 faces" in export_asset(asset, path, "mesh", faces=1000)
    view = start_view((-0.5, -0.5, -0.5), (0.5, 0.5, 0.5))
    focal = SIDE / 2 / np.tan(np.radians(FOV_Y_DEGREES / 2))
    intrinsics = torch.tensor([[focal, 0, SIDE / 2], [0, focal, SIDE / 2], [0, 0, 1]])
    environments = ROOT / "examples" / "environments"
    scene = pose_scene(asset, parse_edits([{"op": "environment", "file": "studio.exr"}]), environments)
    frame = render_frame(scene, camera_from_opengl(torch.from_numpy(view), intrinsics, SIDE, SIDE), RenderSettings(samples_per_pixel=128))
    seen = {"world_from_camera": view.tolist(), "fov_y_degrees": FOV_Y_DEGREES, "stands": [0, 0, 0], "file": "/object.glb"}
    theirs = three_picture(browser, path.read_bytes(), (environments / "studio.exr").read_bytes(), seen)
    a, b = 255 * frame.rgba_srgb.numpy(), np.asarray(theirs.convert("RGBA"), float)
    inside = (a[..., 3] > 254) & (b[..., 3] > 254)
    difference = np.abs(a - b)[inside][:, :3].mean()
    print(f"waves: mean difference {difference:.2f} of 255")
    assert difference < WAVES_DIFFERENCE


def wavy_ball() -> Asset:
    ball = trimesh.creation.icosphere(6, 0.5)
    x, y, z = 28 * ball.vertices.T
    points = torch.tensor(ball.vertices * (1 + 0.04 * np.sin(x) * np.sin(y) * np.sin(z))[:, None], dtype=torch.float32)
    faces, count = torch.tensor(np.asarray(ball.faces), dtype=torch.int32), len(points)
    mesh = TriangleMesh(
        points, faces, vertex_normals(points, faces), torch.full((count, 3), 0.6), torch.full((count,), 0.35), torch.zeros(count)
    )
    return Asset(None, mesh, None, Environment(torch.ones(16, 32, 3)))


def stands(path: Path) -> list[float]:
    """How far the file moves the object from where the asset has it [m], y up."""
    if path.suffix != ".usdz":
        return [0, 0, 0]
    from pxr import Usd, UsdGeom

    stage = Usd.Stage.Open(str(path))
    return list(UsdGeom.XformCommonAPI(stage.GetDefaultPrim()).GetXformVectors(Usd.TimeCode.Default())[0])


def three_picture(browser: Browser, file: bytes, light: bytes, camera: dict) -> Image.Image:
    """What three.js alone draws of these files, on a page that has nothing of ours."""
    answers: dict[str, tuple[str, bytes]] = {
        "/": ("text/html", PAGE.replace("SIDE", str(SIDE)).encode()),
        camera["file"]: ("application/octet-stream", file),
        "/light.exr": ("image/x-exr", light),
        "/camera.json": ("application/json", json.dumps(camera).encode()),
    }

    def answer(route: Route) -> None:
        path = "/" + route.request.url.split("/", 3)[3]
        if path.startswith("/three/"):
            route.fulfill(content_type="text/javascript", body=(THREE / path.removeprefix("/three/")).read_bytes())
        elif path in answers:
            kind, body = answers[path]
            route.fulfill(content_type=kind, body=body)
        else:
            route.abort()

    page = patient_page(browser)
    page.route("**/*", answer)
    page.goto("http://three.test/")
    data = wait_until(lambda: page.evaluate("window.picture"), "three.js to draw")
    page.close()
    return Image.open(io.BytesIO(base64.b64decode(data.partition(",")[2])))
