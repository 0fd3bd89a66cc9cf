"""A real server with an empty data directory, and a real browser on it. The browser is $DRGS_CHROMIUM, else Debian's chromium."""

import base64
import io
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
import urllib.request
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from queue import Empty, Queue
from typing import Any

import numpy as np
import pytest
import trimesh
from PIL import Image
from playwright.sync_api import Browser, ConsoleMessage, Page, expect, sync_playwright

ROOT = Path(__file__).resolve().parents[2]
START_SECONDS = 60
CHROMIUM_ARGUMENTS = (
    "--no-sandbox",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-background-networking",
)


@dataclass
class RunningServer:
    """`drgs serve` as a process of its own, so that it can die and come back on the same port."""

    data: Path
    port: int = 0
    token: str = ""
    process: subprocess.Popen | None = None

    def start(self) -> None:
        command = [sys.executable, "-c", "from drgs.cli import main; main()", "serve", "--no-worker"]
        command += ["--data", str(self.data), "--port", str(self.port)]
        process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
        lines: Queue[str] = Queue()
        assert process.stdout is not None
        output = process.stdout
        threading.Thread(target=lambda: [lines.put(line) for line in output], daemon=True).start()
        self.process = process
        said = ""
        deadline = time.monotonic() + START_SECONDS
        while time.monotonic() < deadline and process.poll() is None:
            try:
                said += lines.get(timeout=0.2)
            except Empty:
                continue
            if address := re.search(r"http://[^/]*:(\d+)/#token=(\S+)", said):
                self.port, self.token = int(address[1]), address[2]
                return
        self.stop()
        pytest.fail(f"drgs serve did not say its address within {START_SECONDS} s; it said: {said or 'nothing'}")

    def stop(self) -> None:
        if self.process and self.process.poll() is None:
            self.process.send_signal(signal.SIGTERM)
            self.process.wait(20)

    @property
    def address(self) -> str:
        return f"http://127.0.0.1:{self.port}"

    def ask(self, path: str) -> dict:
        """GET with the token, as a script would."""
        request = urllib.request.Request(self.address + path, headers={"Authorization": f"Bearer {self.token}"})
        with urllib.request.urlopen(request, timeout=20) as answer:
            return json.load(answer)


@dataclass
class Viewer:
    """The page, and what a test asks of it."""

    page: Page
    server: RunningServer
    complaints: list[str] = field(default_factory=list)
    """Console errors and uncaught exceptions."""

    def edits(self) -> list[dict]:
        """The open session's edits as the server has them."""
        asset = self.page.evaluate("new URLSearchParams(location.hash.slice(1)).get('asset')")
        session = self.page.evaluate(f"localStorage.getItem('drgs.session.{asset}')")
        return self.server.ask(f"/api/sessions/{session}")["edits"]

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
        """Wait for a traced picture of the newest edits and the newest camera."""
        wait_until(
            lambda: self.stage().get("moving") == "false" and self.stage().get("fresh") == "true",
            lambda: f"a fresh traced picture; the page says: {self.page.locator('.hud, .notices').all_inner_texts()}",
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


def wait_until(condition: Callable[[], Any], what: str | Callable[[], str], seconds: float = 30) -> Any:
    """The first true answer of `condition`; fails, naming `what`, after that many seconds."""
    deadline = time.monotonic() + seconds
    while not (answer := condition()):
        if time.monotonic() > deadline:
            pytest.fail(f"waited {seconds:g} s for {what() if callable(what) else what}")
        time.sleep(0.05)
    return answer


def chromium_path() -> str:
    """The browser to test with."""
    candidates = (os.environ.get("DRGS_CHROMIUM"), "/usr/bin/chromium", shutil.which("chromium"), shutil.which("google-chrome"))
    for candidate in candidates:
        if candidate and Path(candidate).exists():
            return candidate
    pytest.fail("the viewer's tests need Chromium: install the package `chromium`, or name a binary in DRGS_CHROMIUM")


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
    ball = trimesh.creation.icosphere(3, 0.5)
    path = tmp_path_factory.mktemp("mesh") / "ball.ply"
    names = ("x", "y", "z", "albedo_r", "albedo_g", "albedo_b", "roughness", "metallic")
    lines = ["ply", "format ascii 1.0", f"element vertex {len(ball.vertices)}", *(f"property float {name}" for name in names)]
    lines += [f"element face {len(ball.faces)}", "property list uchar int vertex_indices", "end_header"]
    for x, y, z in ball.vertices:
        albedo = (0.8, 0.1, 0.1) if y < -0.1 else (0.1, 0.8, 0.1) if x > 0 else (0.1, 0.1, 0.8)
        lines.append(" ".join(f"{value:.6f}" for value in (x, y, z, *albedo, 0.6, 0.0)))
    lines += [f"3 {a} {b} {c}" for a, b, c in ball.faces]
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.fixture(scope="session")
def browser() -> Iterator[Browser]:
    with sync_playwright() as playwright:
        running = playwright.chromium.launch(executable_path=chromium_path(), args=list(CHROMIUM_ARGUMENTS))
        yield running
        running.close()


@pytest.fixture(scope="module")
def viewer(server: RunningServer, browser: Browser) -> Iterator[Viewer]:
    """One page for all tests of a module: each leaves the edit log empty."""
    # Half a device pixel per CSS pixel: these tests are about the way there and back, not about the renderer's speed.
    page = browser.new_page(viewport={"width": 760, "height": 420}, device_scale_factor=0.5, color_scheme="dark")
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
def ball(viewer: Viewer, ball_file: Path) -> Viewer:
    """The page with the ball open, its left panel away."""
    viewer.page.get_by_label("Capture or mesh").set_input_files(ball_file)
    expect(viewer.page.get_by_role("heading", name="ball", exact=True)).to_be_visible(timeout=120_000)
    viewer.page.get_by_role("button", name="Library").click()
    viewer.settle()
    return viewer
