"""`./run demo`: start the service, build the sample capture as a job, open the finished object in the browser.

    python examples/demo.py [--no-browser] [--keep] [--preset fast] [--data data] [--port 8000] [--rebuild]

It uses the service as any program would, through drgs_server.client. The build is a durable job with a fixed key: stopped and started again,
the demo goes on where it was; once built, the object opens at once. With --no-browser it ends when the object is built and a frame of
it has been served, and leaves the service running only with --keep.
"""

import argparse
import io
import os
import signal
import socket
import subprocess
import sys
import time
import uuid
import webbrowser
from pathlib import Path

import httpx
from PIL import Image
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn

from drgs_server.api.rest_records import JobInfo
from drgs_server.client import Client, ServerError
from drgs_worker.jobs.requests import PresetName

ROOT = Path(__file__).resolve().parent.parent
START_SECONDS = 120
"""A cold machine imports for a while."""
STOP_SECONDS = 60
"""A worker that is told to stop saves its checkpoint first."""


def main() -> int:
    parser = argparse.ArgumentParser(prog="./run demo", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--no-browser", action="store_true", help="build, check one frame, print the address, end")
    parser.add_argument("--keep", action="store_true", help="with --no-browser: leave the service running")
    parser.add_argument("--rebuild", action="store_true", help="build again even if the object is there")
    parser.add_argument("--preset", choices=["draft", "fast", "full"], default="fast")
    parser.add_argument("--data", type=Path, default=ROOT / "data")
    parser.add_argument("--port", type=int, default=8000, help="another one is taken when it is in use")
    given = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda _number, _frame: sys.exit(143))  # so that the service is stopped then, too
    given.data.mkdir(parents=True, exist_ok=True)
    log = given.data / "serve.log"
    service = start_service(given.data, free_port(given.port), log)
    keep = False
    try:
        address = wait_for_address(service, log)
        with Client(address) as client:
            asset_id = build_sample(client, given.preset, given.rebuild)
            facts = check_frame(client, asset_id)
        print(f"The sample object is built and served ({facts}).\nOpen {address}", flush=True)
        keep = given.no_browser and given.keep
        if not given.no_browser:
            webbrowser.open(address)
            print("Ctrl-C ends the service.", flush=True)
            service.wait()
    except KeyboardInterrupt:
        print("\nStopping; what was built so far is kept, and the next ./run demo goes on from there.", flush=True)
        return 130
    except (ServerError, RuntimeError) as error:
        print(f"demo: {error}", file=sys.stderr)
        return 1
    except httpx.HTTPError as error:
        print(f"demo: the service no longer answers ({error}); its words are in {os.path.relpath(log)}", file=sys.stderr)
        return 1
    finally:
        if keep:
            print(f"The service goes on as process {service.pid}; end it with: kill {service.pid}", flush=True)
        else:
            stop_service(service)
    return 0


def free_port(wanted: int) -> int:
    """`wanted`, or one that the system picks where something listens there already."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("127.0.0.1", wanted))
        except OSError:
            return 0
    return wanted


def start_service(data: Path, port: int, log: Path) -> subprocess.Popen:
    """`drgs serve` in a process of its own, so that Ctrl-C here reaches it only when we say so."""
    command = [sys.executable, "-m", "drgs", "serve", "--data", str(data), "--port", str(port)]
    with log.open("w") as output:
        return subprocess.Popen(
            command, cwd=ROOT, stdout=output, stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL, start_new_session=True
        )


def stop_service(service: subprocess.Popen) -> None:
    if service.poll() is None:
        service.send_signal(signal.SIGTERM)
        try:
            service.wait(STOP_SECONDS)
        except subprocess.TimeoutExpired:
            service.kill()


def wait_for_address(service: subprocess.Popen, log: Path) -> str:
    """The address with the token, as the service prints it once it listens.

    Raises:
        RuntimeError: the service ended, or says nothing.
    """
    deadline = time.monotonic() + START_SECONDS
    while time.monotonic() < deadline:
        for line in log.read_text().splitlines():
            if "http://" in line and "#token=" in line:
                return line[line.index("http://") :].strip()
        if service.poll() is not None:
            raise RuntimeError(f"the service ended with code {service.returncode}: {log.read_text().strip()[-2000:] or 'it said nothing'}")
        time.sleep(0.1)
    raise RuntimeError(f"the service did not answer within {START_SECONDS} s; its words are in {os.path.relpath(log)}")


def build_sample(client: Client, preset: PresetName, rebuild: bool) -> str:
    """The asset of the sample capture: found, finished or built; a progress bar while that takes.

    Raises:
        RuntimeError: the build failed.
    """
    key = f"demo-{preset}-{uuid.uuid4().hex}" if rebuild else f"demo-{preset}"
    job = client.submit_build("sample", preset=preset, name="Sample", idempotency_key=key)
    if job.state == "done" and not asset_exists(client, job):
        job = client.submit_build("sample", preset=preset, name="Sample")
    elif job.state in ("failed", "cancelled"):
        job = client.retry(job.id)
    columns = (
        TextColumn("{task.description:28s}"),
        BarColumn(),
        TaskProgressColumn(),
        TimeElapsedColumn(),
        TextColumn("{task.fields[note]}"),
    )
    with Progress(*columns, console=Console(stderr=True), refresh_per_second=2) as bar:
        task = bar.add_task("Waiting for the worker", total=1.0, note="")
        for now in client.watch(job):
            bar.update(task, completed=now.fraction, description=now.stage or now.state, note=note_of(now))
            job = now
    if job.state != "done" or job.asset_id is None:
        raise RuntimeError(f"the build is {job.state}: {job.error or job.message or 'no reason was given'}")
    return job.asset_id


def note_of(job: JobInfo) -> str:
    """Quality and time left, as far as they are known."""
    quality = "" if job.psnr is None else f"{job.psnr:.1f} dB  "
    return quality + ("" if job.eta_seconds is None else f"about {job.eta_seconds / 60:.0f} min left")


def asset_exists(client: Client, job: JobInfo) -> bool:
    return job.asset_id is not None and any(asset.id == job.asset_id for asset in client.assets(limit=200).assets)


def check_frame(client: Client, asset_id: str) -> str:
    """Ask for one frame over HTTP and look at it.

    Raises:
        RuntimeError: the frame shows nothing.
    """
    asset = client.asset(asset_id)
    started = time.perf_counter()
    picture = client.open_session(asset_id).frame(width=256, height=256, spp=32, background="transparent")
    seconds = time.perf_counter() - started
    pixels = Image.open(io.BytesIO(picture)).convert("RGBA")
    covered = sum(pixels.getchannel("A").histogram()[128:]) / (pixels.width * pixels.height)
    if not 0.01 < covered < 1 or max(pixels.convert("L").tobytes()) < 32:
        raise RuntimeError(f"a frame of the sample shows nothing: {covered:.1%} of its pixels are covered")
    shape = f"{asset.surfel_count} Gaussians, {asset.face_count} triangles"
    return f"{shape}; a first 256x256 frame took {seconds:.1f} s, the object covers {covered:.0%} of it"


if __name__ == "__main__":
    sys.exit(main())
