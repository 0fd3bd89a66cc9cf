"""What a user of the viewer waits for, measured in Chromium with software GL on a server of this machine.

    python -m benchmarks viewer [--asset ASSET | --mesh FILE] [--repeats 7] [--turn-seconds 3] [--json]

edit_to_pixel_ms: from a slider's event to the first changed picture on the screen, which the browser draws itself; edit_to_traced_ms: to the
first traced picture of that edit. local_fps: pictures a second that the browser draws while the camera turns, 800x600, once it has found how
sharp they may be. traced_fps: pictures a second from the server while the camera turns, 400x400, and in a page of 1280x800, of which panels take a part.
Where a whole picture takes too long the server sends smaller ones while it turns (live/pace.py). reconnect_s: from the server answering again to
the page showing that it is there; picture_back_s: to its next picture, for which it first imports the renderer and loads the asset.
bundle_gz_kb: all built files, gzipped. Medians of the repeats.

What this machine allows at that time, to hold the rates against: bare_local_fps, of a page of the same size that draws nothing but a ball
(bare_page.js), turned by the same hand; bare_traced_fps, of the same renderer by itself, in this process, without server and browser.
"""

import argparse
import gzip
import itertools
import json
import shutil
import statistics
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from playwright.sync_api import Browser, Page, sync_playwright

from benchmarks.render.frame import moving
from drgs.convert.import_mesh import import_mesh
from drgs.scene.asset import load_asset
from drgs_server.render.drgs_renderer import SAMPLES_PER_PASS
from tests.web.browser import CHROMIUM_ARGUMENTS, ROOT, RunningServer, chromium_path, write_ball

WAIT_MS = 60_000
PICTURES_A_SECOND = 6
"""About, of the renderer by itself: so many are made for each second that the camera turns."""
FINDING_PACE = 0.7
"""Seconds in which a picture that turns finds the sharpness that the machine keeps up with."""

TIME_EDIT = """async (value) => {
  const stage = document.querySelector('.stage');
  const slider = document.querySelector('#slider-roughness');
  const seen = { pixel: null, traced: null };
  const revision = Number(stage.dataset.revision);
  const frames = stage.dataset.localFrames;
  const done = new Promise((resolve) => {
    const observer = new MutationObserver(() => {
      const now = performance.now();
      const traced = Number(stage.dataset.revision) > revision;
      if (seen.pixel === null && (stage.dataset.localFrames !== frames || traced)) seen.pixel = now - start;
      if (traced) {
        seen.traced = now - start;
        observer.disconnect();
        resolve(seen);
      }
    });
    observer.observe(stage, { attributes: true });
  });
  const start = performance.now();
  slider.value = value;
  slider.dispatchEvent(new Event('input', { bubbles: true }));
  slider.dispatchEvent(new Event('change', { bubbles: true }));
  return done;
}"""
SETTLED = "document.querySelector('.stage').dataset.fresh === 'true' && document.querySelector('.stage').dataset.moving === 'false'"
STATIC = ROOT / "server" / "drgs_server" / "static"
"""The page as it is built."""


def main(arguments: list[str]) -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks viewer", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    shown = parser.add_mutually_exclusive_group()
    shown.add_argument("--asset", type=Path, help="a built asset, a folder or zipped")
    shown.add_argument("--mesh", type=Path, help="GLB, PLY, OBJ or a zipped asset; a ball of 1280 faces without it")
    parser.add_argument("--repeats", type=int, default=7, help="edits that are timed")
    parser.add_argument("--turn-seconds", type=float, default=3.0, help="how long the camera is turned for each rate")
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory(prefix="drgs-viewer-") as folder:
        mesh = given.mesh if given.asset is None else zipped(given.asset, Path(folder))
        print(json.dumps(measure(mesh, given.repeats, given.turn_seconds), indent=None if given.json else 1))


def zipped(asset: Path, folder: Path) -> Path:
    """The asset as one file, which a page can be given.

    Raises:
        ValueError: it is no asset.
    """
    load_asset(asset)  # complain before a browser is started
    return asset if asset.is_file() else Path(shutil.make_archive(str(folder / asset.name), "zip", asset))


def measure(mesh: Path | None, repeats: int, turn_seconds: float) -> dict[str, float]:
    """Start a server and a browser, and take all figures; raises as `started` does."""
    with started(mesh) as viewer:
        result = measure_bare_local(viewer, turn_seconds) | measure_edits_and_local(viewer, repeats, turn_seconds)
        result |= measure_bare_traced(viewer, turn_seconds) | measure_traced(viewer, turn_seconds)
        result |= {"traced_fps_1280x800": measure_traced(viewer, turn_seconds, 1280, 800)["traced_fps"]}
    return result | {"bundle_gz_kb": round(bundle_bytes() / 1000, 1)}


@dataclass(frozen=True)
class StartedViewer:
    browser: Browser
    server: RunningServer
    mesh: Path


@contextmanager
def started(mesh: Path | None) -> Iterator[StartedViewer]:
    """A server and a browser, and what is looked at: a ball where None.

    Raises:
        ValueError: the viewer is not built, or no Chromium is there.
    """
    if not (STATIC / "index.html").is_file():
        raise ValueError("the viewer is not built; run: python web/build.py")
    with tempfile.TemporaryDirectory(prefix="drgs-viewer-") as folder:
        if mesh is None:
            write_ball(mesh := Path(folder) / "ball.ply")
        server = RunningServer(Path(folder) / "data")
        try:
            server.start()
            with sync_playwright() as playwright:
                browser = playwright.chromium.launch(executable_path=chromium_path(), args=list(CHROMIUM_ARGUMENTS))
                yield StartedViewer(browser, server, mesh)
                browser.close()
        except RuntimeError as error:
            raise ValueError(str(error)) from error
        finally:
            server.stop()


def bundle_bytes() -> int:
    """Of all that a browser may fetch of the page, each file gzipped."""
    return sum(len(gzip.compress(path.read_bytes(), 6)) for path in (STATIC).rglob("*") if path.is_file())


def _open(browser: Browser, server: RunningServer, width: int, height: int, local: bool) -> Page:
    page = browser.new_page(viewport={"width": width, "height": height})
    page.add_init_script(
        f"localStorage.setItem('drgs.localPicture', '{str(local).lower()}'); localStorage.setItem('drgs.libraryOpen', 'true')"
    )
    page.goto(f"{server.address}/#token={server.token}")
    return page


def _wait(page: Page, condition: str) -> None:
    # Not Playwright's wait_for_function: the server's content policy forbids the eval that it needs.
    deadline = time.monotonic() + WAIT_MS / 1000
    while not page.evaluate(condition):
        if time.monotonic() > deadline:
            raise RuntimeError(f"waited {WAIT_MS / 1000:g} s in the viewer for: {condition}")
        page.wait_for_timeout(20)


def _settle(page: Page) -> None:
    _wait(page, SETTLED)


def _turn(page: Page, counter: str, seconds: float) -> float:
    """Changes a second of a count of pictures while the camera is dragged."""
    box = page.locator(".stage").bounding_box()
    assert box is not None
    x, y = box["width"] / 2, box["height"] / 2
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + 20, y, steps=5)
    count = f"Number(document.querySelector('.stage').dataset.{counter} ?? 0)"
    steps = itertools.count(1)

    def turn(for_seconds: float) -> float:
        """Changes a second."""
        first, start = page.evaluate(count), time.perf_counter()
        while time.perf_counter() - start < for_seconds:
            step = next(steps)
            page.mouse.move(x + 60 * (step % 20 if step % 40 < 20 else 20 - step % 20) / 20, y)
            page.wait_for_timeout(5)
        return (page.evaluate(count) - first) / (time.perf_counter() - start)

    turn(FINDING_PACE)
    rate = turn(seconds)
    page.mouse.up()
    return rate


def measure_edits_and_local(viewer: StartedViewer, repeats: int, turn_seconds: float) -> dict[str, float]:
    """What the page does by itself, and after the server was away; the mesh is in the library afterwards."""
    server = viewer.server
    page = _open(viewer.browser, server, 800, 600, local=True)
    page.get_by_label("Capture or mesh").set_input_files(viewer.mesh)
    page.locator("#slider-roughness").wait_for(timeout=WAIT_MS)
    page.get_by_role("button", name="Library").click()
    _settle(page)
    times = []
    for repeat in range(repeats + 1):
        times.append(page.evaluate(TIME_EDIT, 0.2 + 0.05 * repeat))
        _settle(page)
    times = times[1:]  # the first one compiles shaders and kernels
    fps = _turn(page, "localFrames", turn_seconds)
    server.stop()
    page.get_by_text("Reconnecting…").wait_for(timeout=WAIT_MS)
    shown = page.evaluate("Number(document.querySelector('.stage').dataset.tracedFrames)")
    server.start()
    answering = time.perf_counter()
    page.get_by_text("Reconnecting…").wait_for(state="hidden", timeout=WAIT_MS)
    reconnect = time.perf_counter() - answering
    _wait(page, f"Number(document.querySelector('.stage').dataset.tracedFrames) > {shown}")
    picture_back = time.perf_counter() - answering
    page.close()
    return {
        "edit_to_pixel_ms": round(statistics.median(entry["pixel"] for entry in times), 1),
        "edit_to_traced_ms": round(statistics.median(entry["traced"] for entry in times), 1),
        "local_fps": round(fps, 1),
        "reconnect_s": round(reconnect, 2),
        "picture_back_s": round(picture_back, 2),
    }


def measure_bare_local(viewer: StartedViewer, turn_seconds: float) -> dict[str, float]:
    """What any page could do at the viewer's size."""
    page = viewer.browser.new_page(viewport={"width": 800, "height": 600})
    page.evaluate(Path(__file__).with_name("bare_page.js").read_text())
    fps = _turn(page, "localFrames", turn_seconds)
    page.close()
    return {"bare_local_fps": round(fps, 1)}


def measure_bare_traced(viewer: StartedViewer, turn_seconds: float) -> dict[str, float]:
    """What the renderer could send if it did nothing else."""
    asset = load_asset(viewer.mesh) if viewer.mesh.suffix == ".zip" else import_mesh(viewer.mesh)
    frames = max(3, round(turn_seconds * PICTURES_A_SECOND))
    return {"bare_traced_fps": round(moving(asset, 400, SAMPLES_PER_PASS, frames, None)["fps_moving"], 1)}


def measure_traced(viewer: StartedViewer, turn_seconds: float, width: int = 400, height: int = 400) -> dict[str, float]:
    """What the server sends of the newest object in the library to a page of this size, while the camera turns."""
    page = _open(viewer.browser, viewer.server, width, height, local=False)
    page.locator(".asset").first.click()
    page.locator(".hud").wait_for(timeout=WAIT_MS)
    # A page as narrow as a phone's has folded its panels away.
    _wait(page, "Number(document.querySelector('.stage').dataset.samples ?? 0) > 8")
    fps = _turn(page, "tracedFrames", turn_seconds)
    page.close()
    return {"traced_fps": round(fps, 1)}


if __name__ == "__main__":
    import sys

    main(sys.argv[1:])
