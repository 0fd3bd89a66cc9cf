"""An exported GLB looks in three.js as the object looks here: same place, same materials, under the same light."""

import base64
import io
import json
from pathlib import Path

import numpy as np
from PIL import Image
from playwright.sync_api import Browser, Route

from drgs_server.client import Client
from drgs_worker.jobs.start_view import FOV_Y_DEGREES, start_view
from tests.web.browser import ROOT, RunningServer
from tests.web.conftest import patient_page, wait_until

THREE = ROOT / "web" / "node_modules" / "three"
SIDE = 256
DIFFERENCE = 10.0
"""Mean over pixels and channels, sRGB 0..255. three.js filters its environment instead of sampling it, and textures are 8-bit."""

PAGE = """<!doctype html><canvas width="SIDE" height="SIDE"></canvas>
<script type="importmap">{"imports": {"three": "/three/build/three.module.js", "three/addons/": "/three/examples/jsm/"}}</script>
<script type="module">
import * as THREE from 'three';
import { GLTFLoader } from 'three/addons/loaders/GLTFLoader.js';
import { EXRLoader } from 'three/addons/loaders/EXRLoader.js';
const renderer = new THREE.WebGLRenderer({ canvas: document.querySelector('canvas'), alpha: true, preserveDrawingBuffer: true });
const scene = new THREE.Scene();
const sky = await new EXRLoader().setDataType(THREE.FloatType).loadAsync('/light.exr');
sky.mapping = THREE.EquirectangularReflectionMapping;
scene.environment = new THREE.PMREMGenerator(renderer).fromEquirectangular(sky).texture;
scene.add((await new GLTFLoader().loadAsync('/object.glb')).scene);
const { world_from_camera, fov_y_degrees } = await (await fetch('/camera.json')).json();
const camera = new THREE.PerspectiveCamera(fov_y_degrees, 1, 0.01, 100);
camera.matrixAutoUpdate = false;
// Our world has z up, glTF's y.
camera.matrix.set(...world_from_camera.flat()).premultiply(new THREE.Matrix4().makeRotationX(-Math.PI / 2));
camera.matrixWorldNeedsUpdate = true;
renderer.render(scene, camera);
window.picture = renderer.domElement.toDataURL('image/png');
</script>"""


def test_an_exported_glb_looks_the_same_in_three(server: RunningServer, browser: Browser, ball_asset: str, tmp_path: Path) -> None:
    camera = start_view((-0.5, -0.5, -0.5), (0.5, 0.5, 0.5)).tolist()
    with Client(server.address, token=server.token) as client:
        client.export(ball_asset, "glb", tmp_path / "ball.glb")
        session = client.open_session(ball_asset)
        session.edit({"op": "environment", "file": "studio.exr"})
        picture = session.frame(SIDE, SIDE, 256, camera, FOV_Y_DEGREES, background="transparent")
    light = (ROOT / "examples" / "environments" / "studio.exr").read_bytes()
    ours = Image.open(io.BytesIO(picture))
    theirs = three_picture(
        browser, (tmp_path / "ball.glb").read_bytes(), light, {"world_from_camera": camera, "fov_y_degrees": FOV_Y_DEGREES}
    )
    a, b = (np.asarray(picture.convert("RGBA"), float) for picture in (ours, theirs))
    inside = (a[..., 3] > 254) & (b[..., 3] > 254)
    assert inside.sum() > 0.97 * max((a[..., 3] > 127).sum(), (b[..., 3] > 127).sum()) - 4 * SIDE, "the same silhouette"
    difference = np.abs(a - b)[inside][:, :3].mean()
    print(f"mean difference {difference:.2f} of 255")
    assert difference < DIFFERENCE, f"mean difference {difference:.1f} of 255"


def three_picture(browser: Browser, glb: bytes, light: bytes, camera: dict) -> Image.Image:
    """What three.js alone draws of these files, on a page that has nothing of ours."""
    answers: dict[str, tuple[str, bytes]] = {
        "/": ("text/html", PAGE.replace("SIDE", str(SIDE)).encode()),
        "/object.glb": ("model/gltf-binary", glb),
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
