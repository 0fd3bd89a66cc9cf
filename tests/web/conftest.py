"""A real server with an empty data directory, and a real browser on it."""

import base64
import importlib.util
import io
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from playwright.sync_api import Browser, ConsoleMessage, Locator, Page, expect, sync_playwright

from drgs_server.client import Client
from tests.patience import PATIENCE_SECONDS
from tests.web.browser import CHROMIUM_ARGUMENTS, ROOT, RunningServer, chromium_path, write_ball

expect.set_options(timeout=1000 * PATIENCE_SECONDS)

PLAIN_COMPOSITING = ("--disable-gpu-compositing", "--disable-gpu-rasterization")
"""Panels and pictures are put together without software GL, which takes as much of a core for it as for what it draws on canvases."""
PLAIN_EDGES = () if os.environ.get("DRGS_SCREENSHOTS") else ("--webgl-antialiasing-mode=none",)
"""Canvases are drawn once a pixel instead of four times, but in pictures that are kept to be looked at."""
FEW_SAMPLES = 16
"""A pixel, which the page remembers of earlier visits: so the server, whose cores are the browser's, does not refine what a test has seen enough of."""


@dataclass
class Viewer:
    """The page, and what a test asks of it."""

    page: Page
    server: RunningServer
    complaints: list[str] = field(default_factory=list)
    """Console errors and uncaught exceptions."""
    refusals: list[str] = field(default_factory=list)
    """What the server said on streams that something is wrong; the page shows it for a few seconds only."""

    def __post_init__(self) -> None:
        self.page.on("websocket", lambda socket: socket.on("framereceived", self._hear))

    def _hear(self, frame: str | bytes) -> None:
        if isinstance(frame, str) and frame.startswith('{"type":"error"'):
            self.refusals.append(frame)

    def edits(self) -> list[dict]:
        """The open session's edits as the server has them."""
        return self.session()["edits"]

    def session(self) -> dict:
        """What the server says of the open session."""
        return self.server.ask(self.session_path())

    def append_edit(self, edit: dict) -> None:
        """To the open session, as somebody else would."""
        self.server.ask(f"{self.session_path()}/edits", {"edit": edit})

    def session_path(self) -> str:
        asset = self.page.evaluate("new URLSearchParams(location.hash.slice(1)).get('asset')")
        return "/api/sessions/" + self.page.evaluate(f"localStorage.getItem('drgs.session.{asset}')")

    def hint(self, words: str) -> Locator:
        """What a panel says in small letters. The picture's own notes, its state and messages may use the same words at any moment."""
        return self.page.locator(".inspector .hint", has_text=words)

    def undo(self) -> None:
        self._press_when_heard("Undo", "Control+z")

    def redo(self) -> None:
        self._press_when_heard("Redo", "Control+Shift+Z")

    def _press_when_heard(self, button: str, keys: str) -> None:
        """Press the keys once the page has heard from the server that they do something: the log is ahead of the page."""
        expect(self.page.get_by_role("button", name=button, exact=True)).to_be_enabled()
        self.page.keyboard.press(keys)

    def close_library(self) -> None:
        button = self.page.get_by_role("button", name="Library", exact=True)
        if button.get_attribute("aria-pressed") == "true":
            button.click()

    def open_tab(self, name: str) -> None:
        self.page.get_by_role("tab", name=name).click()

    def settled_picture(self) -> np.ndarray:
        """(height, width, 3) float sRGB 0..255 of the traced picture, once it shows the newest edits and the newest camera."""
        self.settle()
        data = self.page.evaluate("document.querySelector('canvas.traced').toDataURL('image/png')")
        return np.asarray(Image.open(io.BytesIO(base64.b64decode(data.partition(",")[2]))).convert("RGB"), float)

    def stage(self) -> dict[str, str]:
        return self.page.evaluate("({...document.querySelector('.stage').dataset})")

    def wait_for_edits(self, count: int) -> list[dict]:
        return wait_until(lambda: len(found := self.edits()) == count and [found], f"{count} edits in the server's log")[0]

    def settle(self) -> None:
        """Wait for a traced picture of the newest camera and of the newest edits that the server, not only the page, knows of."""

        def is_settled() -> bool:
            revision = self.session()["revision"]
            shown = self.stage()
            return shown.get("moving") == "false" and shown.get("fresh") == "true" and int(shown.get("revision", -1)) >= revision

        # What was pressed a moment ago is the page's state, but not yet its data attributes.
        self.page.evaluate("new Promise((resolve) => requestAnimationFrame(() => requestAnimationFrame(resolve)))")
        wait_until(
            is_settled,
            lambda: (
                f"a fresh traced picture; the page says: {self.page.locator('.hud, .notices').all_inner_texts()}, {self.refusals}, {self.stage()}"
            ),
        )

    def settled_color(self) -> tuple[float, float, float]:
        """Mean sRGB (0..255) of the middle of the traced picture, once it shows the newest edits and the newest camera."""
        self.settle()
        return tuple(self.page.evaluate(MIDDLE_COLOR))


MIDDLE_COLOR = """() => {
  const canvas = document.querySelector('canvas.traced');
  const side = Math.round(0.2 * canvas.height);
  const { data } = canvas.getContext('2d').getImageData((canvas.width - side) >> 1, (canvas.height - side) >> 1, side, side);
  const sum = [0, 0, 0];
  for (let i = 0; i < data.length; i += 4) for (let k = 0; k < 3; k++) sum[k] += data[i + k];
  return sum.map((value) => value / (side * side));
}"""


def wait_until(condition: Callable[[], Any], what: str | Callable[[], str], seconds: float = PATIENCE_SECONDS) -> Any:
    """The first true answer of `condition`; fails, naming `what`, after that many seconds.

    Who waits long asks more seldom: an answer takes the page, its driver and the test milliseconds each, which builds that are waited for want."""
    begun = time.monotonic()
    deadline = begun + seconds
    while not (answer := condition()):
        if time.monotonic() > deadline:
            pytest.fail(f"waited {seconds:g} s for {what() if callable(what) else what}")
        time.sleep(min(max(0.05, (time.monotonic() - begun) / 20), 0.5))
    return answer


def patient_page(browser: Browser, **options: Any) -> Page:
    """A page of its own context, which once chose few samples."""
    page = browser.new_page(**options)
    page.add_init_script(f"localStorage.getItem('drgs.samplesAPixel') ?? localStorage.setItem('drgs.samplesAPixel', '{FEW_SAMPLES}')")
    page.set_default_timeout(1000 * PATIENCE_SECONDS)
    return page


@pytest.fixture(scope="session")
def built() -> None:
    """The viewer is that of the sources."""
    subprocess.run([sys.executable, ROOT / "web" / "build.py"], check=True)


@pytest.fixture(scope="module")
def run_node() -> Callable[..., str]:
    """Runs a script of web/ with arguments in the Node that builds the viewer; what it printed."""
    spec = importlib.util.spec_from_file_location("build_viewer", ROOT / "web" / "build.py")
    assert spec is not None and spec.loader is not None
    build_viewer = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(build_viewer)
    _, environment = build_viewer.install()
    node = shutil.which("node", path=environment["PATH"])
    assert node is not None

    def run(script: str, *arguments: object) -> str:
        # One thread: with compilers beside it, Node now and then waits for itself for ever when it ends (nodejs/node issue 54918).
        command = [node, "--single-threaded", ROOT / "web" / script, *map(str, arguments)]
        return subprocess.run(command, env=environment, check=True, capture_output=True, text=True, timeout=PATIENCE_SECONDS).stdout

    return run


@pytest.fixture(scope="session")
def server(built: None, tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningServer]:
    running = RunningServer(tmp_path_factory.mktemp("data"))
    running.start()
    yield running
    running.stop()


@pytest.fixture(scope="session")
def ball_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A ball with red, green and blue thirds around z, rough and not metallic, as a PLY with material properties."""
    path = tmp_path_factory.mktemp("mesh") / "ball.ply"
    write_ball(path)
    return path


@pytest.fixture(scope="session")
def ball_asset(server: RunningServer, ball_file: Path) -> str:
    """Id of the ball on the server; every page that opens it has a session of its own."""
    with Client(server.address, token=server.token) as client:
        return client.upload_asset(ball_file).id


class _Browsing:
    """One Chromium for all modules that follow one another. It ends with the last of them: while Playwright runs, so does its event loop, and
    tests behind these could run none of their own."""

    def __init__(self) -> None:
        self._running: Browser | None = None
        self._open = ExitStack()

    def browser(self) -> Browser:
        if self._running is None or not self._running.is_connected():
            self.end()
            playwright = self._open.enter_context(sync_playwright())
            self._running = playwright.chromium.launch(
                executable_path=chromium_path(), args=[*CHROMIUM_ARGUMENTS, *PLAIN_COMPOSITING, *PLAIN_EDGES]
            )
            self._open.callback(self._running.close)
        return self._running

    def end(self) -> None:
        self._open.close()
        self._running = None


_browsing = _Browsing()


@pytest.hookimpl(trylast=True)
def pytest_runtest_teardown(nextitem: pytest.Item | None) -> None:
    if nextitem is None or not nextitem.nodeid.startswith("tests/web/"):
        _browsing.end()


@pytest.fixture(scope="module")
def browser() -> Browser:
    return _browsing.browser()


@contextmanager
def shown_page(server: RunningServer, browser: Browser, asset: str = "") -> Iterator[Viewer]:
    """A page of its own that opens the asset of this id, or none. Each object that a page opens costs about six seconds of a core: software GL lights it
    anew."""
    # Half a device pixel per CSS pixel: these tests are about the way there and back, not about the renderer's speed.
    # A camera that goes where it is sent at once: each picture on its way would be drawn. test_whole_path.py and test_screenshots.py have it glide.
    page = patient_page(
        browser, viewport={"width": 760, "height": 420}, device_scale_factor=0.5, color_scheme="dark", reduced_motion="reduce"
    )
    shown = Viewer(page, server)

    def heard(message: ConsoleMessage) -> None:
        # Those about reading canvases often are these tests' own doing: they look at pictures, and have pages put together without a GPU.
        if message.type in ("error", "warning") and not any(word in message.text for word in ("willReadFrequently", "ReadPixels")):
            shown.complaints.append(message.text)

    page.on("console", heard)
    page.on("pageerror", lambda error: shown.complaints.append(str(error)))
    page.goto(f"{server.address}/#token={server.token}" + (f"&asset={asset}" if asset else ""))
    yield shown
    page.close()


def frame_alone(viewer: Viewer) -> None:
    """Frame the object in what is free without the left panel, which may have been there when it came."""
    viewer.close_library()
    viewer.settle()
    viewer.page.keyboard.press("Shift+F")
    viewer.settle()


@pytest.fixture(scope="module")
def viewer(server: RunningServer, browser: Browser) -> Iterator[Viewer]:
    """One page for all tests of a module: each leaves the edit log empty."""
    with shown_page(server, browser) as viewer:
        yield viewer


@pytest.fixture(scope="module")
def ball(server: RunningServer, browser: Browser, ball_asset: str) -> Iterator[Viewer]:
    """The page with the ball open, its left panel away."""
    with shown_page(server, browser, ball_asset) as viewer:
        expect(viewer.page.get_by_role("heading", name="ball", exact=True)).to_be_visible()
        frame_alone(viewer)
        yield viewer
