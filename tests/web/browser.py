"""What browser tests and the viewer's benchmark start: `drgs serve` as a process, Chromium on software GL, and a ball to look at."""

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
from dataclasses import dataclass
from pathlib import Path
from queue import Empty, Queue

import trimesh

from tests.patience import PATIENCE_SECONDS

ROOT = Path(__file__).resolve().parents[2]
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
        """
        Raises:
            RuntimeError: it did not say its address in time; what it said instead.
        """
        command = [sys.executable, "-c", "from drgs.cli import main; main()", "serve", "--no-worker"]
        command += ["--data", str(self.data), "--port", str(self.port)]
        process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
        lines: Queue[str] = Queue()
        assert process.stdout is not None
        output = process.stdout
        threading.Thread(target=lambda: [lines.put(line) for line in output], daemon=True).start()
        self.process = process
        said = ""
        deadline = time.monotonic() + PATIENCE_SECONDS
        while time.monotonic() < deadline and process.poll() is None:
            try:
                said += lines.get(timeout=0.2)
            except Empty:
                continue
            if address := re.search(r"http://[^/]*:(\d+)/#token=(\S+)", said):
                self.port, self.token = int(address[1]), address[2]
                return
        self.stop()
        raise RuntimeError(f"drgs serve did not say its address within {PATIENCE_SECONDS:g} s; it said: {said or 'nothing'}")

    def stop(self) -> None:
        if self.process and self.process.poll() is None:
            self.process.send_signal(signal.SIGTERM)
            try:
                self.process.wait(PATIENCE_SECONDS)
            except subprocess.TimeoutExpired:
                self.process.kill()

    @property
    def address(self) -> str:
        return f"http://127.0.0.1:{self.port}"

    def ask(self, path: str, body: dict | None = None) -> dict:
        """GET with the token, as a script would; POST where there is a body."""
        headers = {"Authorization": f"Bearer {self.token}", "Content-Type": "application/json"}
        request = urllib.request.Request(self.address + path, None if body is None else json.dumps(body).encode(), headers)
        with urllib.request.urlopen(request, timeout=PATIENCE_SECONDS) as answer:
            return json.load(answer)


def chromium_path() -> str:
    """$DRGS_CHROMIUM, else Debian's chromium, else what the path has.

    Raises:
        RuntimeError: there is none.
    """
    candidates = (os.environ.get("DRGS_CHROMIUM"), "/usr/bin/chromium", shutil.which("chromium"), shutil.which("google-chrome"))
    for candidate in candidates:
        if candidate and Path(candidate).exists():
            return candidate
    raise RuntimeError("the viewer's tests need Chromium: install the package `chromium`, or name a binary in DRGS_CHROMIUM")


def write_ball(path: Path) -> None:
    """A ball with red, green and blue thirds around z, rough and not metallic, as a PLY with material properties."""
    ball = trimesh.creation.icosphere(3, 0.5)
    names = ("x", "y", "z", "albedo_r", "albedo_g", "albedo_b", "roughness", "metallic")
    lines = ["ply", "format ascii 1.0", f"element vertex {len(ball.vertices)}", *(f"property float {name}" for name in names)]
    lines += [f"element face {len(ball.faces)}", "property list uchar int vertex_indices", "end_header"]
    for x, y, z in ball.vertices:
        albedo = (0.8, 0.1, 0.1) if y < -0.1 else (0.1, 0.8, 0.1) if x > 0 else (0.1, 0.1, 0.8)
        lines.append(" ".join(f"{value:.6f}" for value in (x, y, z, *albedo, 0.6, 0.0)))
    lines += [f"3 {a} {b} {c}" for a, b, c in ball.faces]
    path.write_text("\n".join(lines) + "\n")
