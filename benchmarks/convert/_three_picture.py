"""What three.js draws of exported files, in Chromium with software GL, on a page that has nothing of ours.

In: the bytes of an EXR, and of each GLB or USDZ with a camera. Out: RGBA as on the screen: three.js' standard material under the EXR as it filters it
(PMREMGenerator), no lamps, no tone mapping, sRGB.
"""

import base64
import io
import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, UInt8
from numpy import ndarray
from PIL import Image
from playwright.sync_api import Browser, Route

from drgs.maths.color import linear_from_srgb, srgb_from_linear

ROOT = Path(__file__).resolve().parents[2]
THREE = ROOT / "web" / "node_modules" / "three"
PAGE = Path(__file__).with_name("three_page.html")
WAIT_MS = 120_000
FINE = 4

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


class ThreePage:
    """Final. A page of three.js under one light, which is filtered once, for about a second of a core in software GL; end it by `close`."""

    def __init__(self, browser: Browser, light: bytes) -> None:
        """
        Args:
            light: an EXR, lat-long.

        Raises:
            ValueError: web/node_modules has no three.js.
        """
        if not THREE.is_dir():
            raise ValueError(f"{THREE} is not there; run: python web/build.py")
        self._answers: dict[str, tuple[str, bytes]] = {"/": ("text/html", PAGE.read_bytes()), "/light.exr": ("image/x-exr", light)}
        self._drawn = 0
        self._page = browser.new_page()
        self._page.route("**/*", self._answer)
        self._page.goto("http://three.test/", timeout=WAIT_MS)
        self._page.wait_for_function("Boolean(window.draw)", timeout=WAIT_MS)

    def picture(self, file: bytes, suffix: str, seen: SeenByThree) -> UInt8[ndarray, "height width 4"]:
        """
        Args:
            suffix: .glb or .usdz.
        """
        self._drawn += 1
        path = f"/object-{self._drawn}{suffix}"
        self._answers[path] = ("application/octet-stream", file)
        self._page.evaluate("(told) => void window.draw(told)", vars(seen) | {"file": path})
        self._page.wait_for_function("window.picture", timeout=WAIT_MS)
        del self._answers[path]
        data = self._page.evaluate("window.picture")
        return np.asarray(Image.open(io.BytesIO(base64.b64decode(data.partition(",")[2]))).convert("RGBA"))

    def fine_picture(self, file: bytes, suffix: str, seen: SeenByThree) -> Float[ndarray, "height width 4"]:
        """As `picture`, 0..255, of pixels that are means of FINE times as many each way, as ours are of many rays: three.js looks through the middle
        of each, and makes surfaces rougher the more their normals turn from one to the next."""
        finer = replace(seen, width=FINE * seen.width, height=FINE * seen.height)
        drawn = torch.from_numpy(self.picture(file, suffix, finer).astype(np.float32) / 255)
        linear = torch.cat([linear_from_srgb(drawn[..., :3]), drawn[..., 3:]], -1)
        mean = linear.reshape(seen.height, FINE, seen.width, FINE, 4).mean((1, 3))
        return 255 * torch.cat([srgb_from_linear(mean[..., :3]), mean[..., 3:]], -1).double().numpy()

    def close(self) -> None:
        self._page.close()

    def _answer(self, route: Route) -> None:
        path = "/" + route.request.url.split("/", 3)[3]
        if path.startswith("/three/"):
            route.fulfill(content_type="text/javascript", body=(THREE / path.removeprefix("/three/")).read_bytes())
        elif path in self._answers:
            kind, body = self._answers[path]
            route.fulfill(content_type=kind, body=body)
        else:
            route.abort()
