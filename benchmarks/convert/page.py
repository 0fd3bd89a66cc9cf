"""What an exported page weighs, how quickly it draws, and how far its picture is from ours.

    python -m benchmarks page ASSET [--turn-seconds 6] [--size 800x600] [--out FOLDER] [--json]

bytes, faces, export_s: of the file. fps: pictures a second while the object turns by itself in Chromium with software GL; sharpness: pixels that
it draws then for each of the screen's, one way (1: all of them); detail: the mesh that it draws then, 0 the fine one, 1 the coarse. orbit_fps: likewise while a hand drags the view round; relit: mean change of the picture [of 255] when
the light is turned by a third with its slider; requests: what the page asked for beside itself, opened from a file without a network. difference: mean over pixels and channels [of 255] where the object covers
pixels wholly, between the page and `drgs render` (256 rays a pixel, four bounces) under the recovered light, from the page's first camera.
"""

import argparse
import io
import json
import tempfile
import time
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from playwright.sync_api import Page, sync_playwright

from drgs.convert.page.encode_page import encode_page
from drgs.deform.pose_scene import pose_scene
from drgs.maths.constants import STILL_BOUNCES
from drgs.render.records import RenderSettings
from drgs.render.render_frame import render_frame
from drgs.scene.asset import Asset, load_asset
from drgs.scene.camera import Camera, camera_from_opengl
from tests.web.browser import CHROMIUM_ARGUMENTS, chromium_path

SETTLING_MS = 1500
"""Until a page that is not touched has drawn its last picture, and one that turns has found its sharpness."""
SAMPLES_PER_PIXEL = 256


def main(arguments: list[str]) -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks page", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("asset", type=Path, help="asset folder, or the same zipped")
    parser.add_argument("--turn-seconds", type=float, default=6.0, help="how long the object turns for the rate")
    parser.add_argument("--size", default="800x600", help="of the picture [pixels]")
    parser.add_argument("--out", type=Path, help="keep the page and both pictures in this folder")
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args(arguments)
    width, height = map(int, given.size.split("x"))
    with tempfile.TemporaryDirectory(prefix="drgs-page-") as folder:
        out = given.out or Path(folder)
        out.mkdir(parents=True, exist_ok=True)
        print(json.dumps(measure(load_asset(given.asset), out, width, height, given.turn_seconds), indent=None if given.json else 1))


def measure(asset: Asset, out: Path, width: int, height: int, turn_seconds: float) -> dict[str, float]:
    """All figures; the page and the pictures lie in `out` afterwards.

    Raises:
        ValueError: the page cannot be made.
        RuntimeError: no Chromium is there.
    """
    start = time.perf_counter()
    made = encode_page(asset)
    (out / "page.html").write_bytes(made.html)
    seconds = time.perf_counter() - start
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium_path(), args=list(CHROMIUM_ARGUMENTS))
        context = browser.new_context(offline=True, viewport={"width": width, "height": height})
        page, asked = context.new_page(), []
        page.on("request", lambda request: asked.append(request.url))
        page.goto((out / "page.html").as_uri())
        page.get_by_role("switch", name="Show the light").uncheck()
        page.get_by_role("button", name="Light and material").click()
        page.wait_for_timeout(SETTLING_MS)
        page.screenshot(path=out / "page.png")
        camera = camera_of(page, width, height)
        relit = light_change(page)
        rate = turning_rate(page, turn_seconds) | {"orbit_fps": orbiting_rate(page, width, height, turn_seconds)}
        browser.close()
    return {
        "bytes": len(made.html),
        "faces": made.faces,
        "export_s": round(seconds, 1),
        **rate,
        "relit": round(relit, 1),
        "requests": len([url for url in asked if not url.startswith(("file:", "data:", "blob:"))]),
        "difference": round(difference(asset, camera, out), 2),
    }


def camera_of(page: Page, width: int, height: int) -> Camera:
    """Where the page's picture is taken from."""
    found = json.loads(page.locator(".stage").get_attribute("data-camera") or "")
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[:3] = torch.tensor([found["right"], found["up"], found["back"], found["eye"]], dtype=torch.float64).T
    focal, (x, y) = found["focal"], found["center"]
    return camera_from_opengl(matrix, torch.tensor([[focal, 0, x], [0, focal, y], [0, 0, 1.0]]), width, height)


def turning_rate(page: Page, seconds: float) -> dict[str, float]:
    stage = page.locator(".stage")
    page.get_by_role("button", name="Turn by itself").click()
    page.wait_for_timeout(SETTLING_MS)
    first, start = int(stage.get_attribute("data-pictures") or 0), time.perf_counter()
    page.wait_for_timeout(1000 * seconds)
    count, elapsed = int(stage.get_attribute("data-pictures") or 0) - first, time.perf_counter() - start
    return {
        "fps": round(count / elapsed, 1),
        "sharpness": float(stage.get_attribute("data-sharpness") or 0),
        "detail": int(stage.get_attribute("data-detail") or 0),
    }


def orbiting_rate(page: Page, width: int, height: int, seconds: float) -> float:
    """Pictures a second while the view is dragged to and fro; the object stands still by itself then."""
    stage = page.locator(".stage")
    page.get_by_role("button", name="Turn by itself").click()
    page.mouse.move(width / 3, height / 2)
    page.mouse.down()
    first, start, step = int(stage.get_attribute("data-pictures") or 0), time.perf_counter(), 0
    while (elapsed := time.perf_counter() - start) < seconds:
        step += 1
        page.mouse.move(width / 3 + (step % 100 if step % 200 < 100 else 100 - step % 100), height / 2)
    count = int(stage.get_attribute("data-pictures") or 0) - first
    page.mouse.up()
    return round(count / elapsed, 1)


def light_change(page: Page) -> float:
    """Mean difference [of 255] between the picture and that under the light turned by a third; the light is as before afterwards."""
    panel, slider = page.get_by_role("button", name="Light and material"), page.locator("#slider-turn")
    pictures = []
    for degrees in ("0", "120", "0"):
        panel.click()
        slider.fill(degrees)
        panel.click()
        page.wait_for_timeout(SETTLING_MS)
        pictures.append(np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB"), float))
    return float(np.abs(pictures[1] - pictures[0]).mean())


def difference(asset: Asset, camera: Camera, out: Path) -> float:
    """Mean difference [of 255] of out/page.png from a rendered picture, which becomes out/render.png."""
    scene = pose_scene(asset, [])
    settings = RenderSettings(samples_per_pixel=SAMPLES_PER_PIXEL, bounces=STILL_BOUNCES, primary=scene.primary)
    ours = render_frame(scene, camera, settings).rgba_srgb.clamp(0, 1).mul(255).round().to(torch.uint8).numpy()
    Image.fromarray(ours).save(out / "render.png")
    theirs = np.asarray(Image.open(out / "page.png").convert("RGB"), float)
    return float(np.abs(theirs - ours[..., :3])[ours[..., 3] == 255].mean())


if __name__ == "__main__":
    import sys

    main(sys.argv[1:])
