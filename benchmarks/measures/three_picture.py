"""What three.js draws of an exported file, in Chromium with software GL, on a page that has nothing of ours.

In: the bytes of a GLB or USDZ and of an EXR, and a camera. Out: RGBA as on the screen: three.js' standard material under the EXR as it filters it
(PMREMGenerator), no lamps, no tone mapping, sRGB.
"""

import base64
import io
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import UInt8
from numpy import ndarray
from PIL import Image
from playwright.sync_api import Browser, Route

ROOT = Path(__file__).resolve().parents[2]
THREE = ROOT / "web" / "node_modules" / "three"
PAGE = ROOT / "benchmarks" / "three_page.html"
WAIT_MS = 120_000

Map = Literal["aoMap", "normalMap"]
"""A texture, as three.js calls it, that a picture may do without."""


@dataclass(frozen=True)
class SeenByThree:
    """What the page is told."""

    world_from_camera: list[list[float]]
    """OpenGL camera-to-world, rows [metres, z up]."""
    fov_y_degrees: float
    width: int
    height: int
    stands: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """How far the file moves the object from where the asset has it [m], y up."""
    without: tuple[Map, ...] = ()
    variant: str | None = None
    """Name of the material variant that is shown; None: what the file opens with."""


def three_version() -> str:
    return json.loads((THREE / "package.json").read_text())["version"]


def three_picture(browser: Browser, file: bytes, suffix: str, light: bytes, seen: SeenByThree) -> UInt8[ndarray, "height width 4"]:
    """
    Args:
        suffix: .glb or .usdz.
        light: an EXR, lat-long.

    Raises:
        ValueError: web/node_modules has no three.js.
    """
    if not THREE.is_dir():
        raise ValueError(f"{THREE} is not there; run: python web/build.py")
    told = vars(seen) | {"file": f"/object{suffix}", "light": "/light.exr"}
    answers: dict[str, tuple[str, bytes]] = {
        "/": ("text/html", PAGE.read_bytes()),
        f"/object{suffix}": ("application/octet-stream", file),
        "/light.exr": ("image/x-exr", light),
        "/seen.json": ("application/json", json.dumps(told).encode()),
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

    page = browser.new_page()
    try:
        page.route("**/*", answer)
        page.goto("http://three.test/", timeout=WAIT_MS)
        page.wait_for_function("window.picture", timeout=WAIT_MS)
        data = page.evaluate("window.picture")
    finally:
        page.close()
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(data.partition(",")[2]))).convert("RGBA"))
