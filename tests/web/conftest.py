"""A real server with an empty data directory, and a real browser on it."""

import base64
import io
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from playwright.sync_api import Browser, ConsoleMessage, Page, expect, sync_playwright

from drgs_server.client import Client
from tests.web.browser import CHROMIUM_ARGUMENTS, ROOT, RunningServer, chromium_path, write_ball

PATIENCE_SECONDS = 120
"""How long a test waits for what must come. No test is faster for less of it; on a busy machine drawing and loading take their time."""
expect.set_options(timeout=1000 * PATIENCE_SECONDS)


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
    """The first true answer of `condition`; fails, naming `what`, after that many seconds."""
    deadline = time.monotonic() + seconds
    while not (answer := condition()):
        if time.monotonic() > deadline:
            pytest.fail(f"waited {seconds:g} s for {what() if callable(what) else what}")
        time.sleep(0.05)
    return answer


def patient_page(browser: Browser, **options: Any) -> Page:
    """A page of its own context."""
    page = browser.new_page(**options)
    page.set_default_timeout(1000 * PATIENCE_SECONDS)
    return page


@pytest.fixture(scope="session")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningServer]:
    subprocess.run([sys.executable, ROOT / "web" / "build.py"], check=True)
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


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    """A Chromium for each module: while Playwright runs, so does its event loop, and tests behind these could run none of their own."""
    with sync_playwright() as playwright:
        running = playwright.chromium.launch(executable_path=chromium_path(), args=list(CHROMIUM_ARGUMENTS))
        yield running
        running.close()


@pytest.fixture(scope="module")
def viewer(server: RunningServer, browser: Browser) -> Iterator[Viewer]:
    """One page for all tests of a module: each leaves the edit log empty."""
    # Half a device pixel per CSS pixel: these tests are about the way there and back, not about the renderer's speed.
    page = patient_page(browser, viewport={"width": 760, "height": 420}, device_scale_factor=0.5, color_scheme="dark")
    shown = Viewer(page, server)

    def heard(message: ConsoleMessage) -> None:
        # The one about reading a canvas often is these tests' own doing.
        if message.type in ("error", "warning") and "willReadFrequently" not in message.text:
            shown.complaints.append(message.text)

    page.on("console", heard)
    page.on("pageerror", lambda error: shown.complaints.append(str(error)))
    page.goto(f"{server.address}/#token={server.token}")
    yield shown
    page.close()


@pytest.fixture(scope="module")
def ball(viewer: Viewer, ball_asset: str) -> Viewer:
    """The page with the ball open, its left panel away."""
    viewer.page.goto(f"{viewer.server.address}/#asset={ball_asset}")
    viewer.page.reload()
    expect(viewer.page.get_by_role("heading", name="ball", exact=True)).to_be_visible()
    viewer.page.get_by_role("button", name="Library").click()
    viewer.settle()
    # The object may have come before or after the panel went: frame it in what is free now.
    viewer.page.keyboard.press("Shift+F")
    viewer.settle()
    return viewer
