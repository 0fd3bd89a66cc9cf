"""`drgs serve`: the API in this process, the worker in a child that is started again when it dies."""

import logging
import os
import resource
import signal
import socket
import subprocess
import sys
import threading
import time
import webbrowser
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import uvicorn
from starlette.types import ASGIApp
from uvicorn.middleware.proxy_headers import ProxyHeadersMiddleware

from drgs.openmp import sleep_at_once
from drgs_server.api.door.connections import guarded_connections
from drgs_server.api.door.rate_limit import KeepPeer
from drgs_server.api.door.text_streams import TextStream
from drgs_server.app import create_app
from drgs_server.first_start import KernelCompiler
from drgs_worker.logs import set_up_logging
from drgs_worker.store.backups import restore_backups
from drgs_worker.store.data_directory import open_data_directory, read_token
from drgs_worker.store.settings import Limits, ServiceSettings, read_settings

LONGEST_RESTART_SECONDS = 60.0
UNREAD_SECONDS = 60.0
"""A connection whose peer takes nothing for so long is dropped by the system, with all that waits in it (Linux): no close frame would end it."""
SWITCH_SECONDS = 0.001
FILES_BESIDE_CONNECTIONS = 512
"""Databases, libraries, what is read and written."""
QUICK_DEATH_SECONDS = 10.0
"""A worker that lived shorter than this is started again later and later."""

log = logging.getLogger(__name__)


def serve(
    data: Path | None = None,
    host: str | None = None,
    port: int | None = None,
    with_worker: bool | None = None,
    open_browser: bool = False,
    ready: Callable[[str], None] | None = None,
    capture_roots: tuple[Path, ...] | None = None,
    device: str | None = None,
    restore_backup: bool = False,
) -> int:
    """Serve until SIGTERM or Ctrl-C. Returns the exit code. What is None is as the settings say (worker/drgs_worker/store/settings.py).

    Args:
        port: 0 picks a free one.
        ready: called once with the address to open, token included, when requests are answered.
        capture_roots: folders below which a job may name a capture.
        restore_backup: begin with the last good copy of each database that is damaged or gone.

    Raises:
        ValueError: a setting is wrong, the data directory cannot be used, the host is not this machine's own, or the port is taken.
    """
    settings = read_settings(data=data, host=host, port=port, worker=with_worker, capture_roots=capture_roots or None, device=device)
    settings = settings.model_copy(update={"data": settings.data.expanduser().resolve()})
    host, port = settings.host, settings.port
    set_up_logging(settings.log_format)
    sleep_at_once()
    # Python's lock is passed on sooner than after its usual 5 ms: an answer needs it several times while the render thread wants it, too.
    sys.setswitchinterval(SWITCH_SECONDS)
    _raise_file_limit(settings.limits)
    directory = open_data_directory(settings.data, settings.database_url, settings.queue_url, settings.artifact_url)
    for restored in restore_backups(directory) if restore_backup else ():
        log.warning("%s was damaged or gone; its last good copy is in its place", restored)
    app = create_app(settings)
    config = uvicorn_config(app, settings)
    token = settings.token.get_secret_value() if settings.token else read_token(directory)
    server = _Server(config, lambda bound: _announce(bound, host, token, open_browser, ready))
    worker, compiler = WorkerProcess(directory.root, settings.device) if settings.worker else None, KernelCompiler(settings.device)
    if worker:
        worker.start()
    compiler.start()
    try:
        with _quiet_signals():
            server.run()
    except SystemExit as error:
        raise ValueError(f"port {port} of {host} cannot be used; is a server running there already? Pick another with --port") from error
    finally:
        compiler.stop()
        if worker:
            worker.stop()
    return 0


def uvicorn_config(app: ASGIApp, settings: ServiceSettings) -> uvicorn.Config:
    """How uvicorn listens and whom it believes, as the settings say."""
    # Never uvicorn's default, which believes whoever calls from this machine.
    trusting = ProxyHeadersMiddleware(app, list(settings.trusted_proxies)) if settings.trusted_proxies else app  # type: ignore[arg-type]
    return uvicorn.Config(
        KeepPeer(trusting),  # type: ignore[arg-type]
        host=settings.host,
        port=settings.port,
        log_config=None,
        log_level="warning",
        http=guarded_connections(settings.limits),
        ws=TextStream,
        ws_max_size=1 << 20,
        ws_max_queue=32,
        ws_per_message_deflate=False,  # on, it costs a third of the frame rate at 1080p and gains nothing on JPEG
        server_header=False,
        proxy_headers=False,
        timeout_graceful_shutdown=5,
    )


def _raise_file_limit(limits: Limits) -> None:
    """Connections and streams are files to the system, whose usual limit is lower than what the settings allow."""
    wanted = 2 * limits.connections + limits.stranger_connections + FILES_BESIDE_CONNECTIONS
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft == resource.RLIM_INFINITY or soft >= wanted:
        return
    most = wanted if hard == resource.RLIM_INFINITY else min(wanted, hard)
    resource.setrlimit(resource.RLIMIT_NOFILE, (most, hard))
    if most < wanted:
        log.warning("the system allows %d open files, fewer than the connections of the settings need (%d)", most, wanted)


@contextmanager
def _quiet_signals() -> Iterator[None]:
    """uvicorn shuts down on SIGTERM and SIGINT and then raises them again, which would end this process before its worker."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.signal(number, lambda _number, _frame: None) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _announce(port: int, host: str, token: str, open_browser: bool, ready: Callable[[str], None] | None) -> None:
    # A server that listens on all addresses, as in a container, is opened by a name that its Host check knows.
    name = "localhost" if host in ("0.0.0.0", "::") else f"[{host}]" if ":" in host else host
    address = f"http://{name}:{port}/#token={token}"
    if ready is None:
        print(f"DR-GS is at {address}", flush=True)
    else:
        ready(address)
    if open_browser:
        webbrowser.open(address)


class _Server(uvicorn.Server):
    """Says on which port it listens, once it does."""

    def __init__(self, config: uvicorn.Config, started: Callable[[int], None]) -> None:
        super().__init__(config)
        self._told = started

    async def startup(self, sockets=None) -> None:
        await super().startup(sockets)
        if self.started and hasattr(socket, "TCP_USER_TIMEOUT"):
            for listening in self.servers[0].sockets:  # those that are accepted inherit it
                listening.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, int(1000 * UNREAD_SECONDS))
        if self.started:
            self._told(self.servers[0].sockets[0].getsockname()[1])


class WorkerProcess:
    """Final. Keeps one worker running; a thread starts it again when it dies, more slowly if it dies at once."""

    def __init__(self, data: Path, device: str) -> None:
        self._data = data
        self._device = device
        self._stopping = threading.Event()
        self._lock = threading.Lock()
        self._process: subprocess.Popen | None = None
        self._thread = threading.Thread(target=self._keep, name="worker-keeper", daemon=True)

    @property
    def pid(self) -> int | None:
        process = self._process
        return process.pid if process and process.poll() is None else None

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        """Ask the worker to write its checkpoint and end; after 40 s it is killed."""
        with self._lock:
            self._stopping.set()
            process = self._process
        if process and process.poll() is None:
            process.send_signal(signal.SIGTERM)
            try:
                process.wait(40)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        self._thread.join(5)

    def _keep(self) -> None:
        pause = 0.5
        while not self._stopping.is_set():
            started = time.monotonic()
            with self._lock:
                if self._stopping.is_set():
                    return
                # -P: what lies in the present folder (a user's queue.py) is nothing to import.
                command = [sys.executable, "-P", "-m", "drgs_worker", "--data", str(self._data), "--device", self._device]
                command += ["--parent-pid", str(os.getpid())]
                # A session of its own: Ctrl-C in the terminal reaches the server alone, which then ends the worker in order.
                self._process = subprocess.Popen(command, start_new_session=True)
            code = self._process.wait()
            if self._stopping.is_set():
                return
            pause = 0.5 if time.monotonic() - started > QUICK_DEATH_SECONDS else min(2 * pause, LONGEST_RESTART_SECONDS)
            log.warning("the worker ended with code %s; it is started again in %.1f s", code, pause)
            self._stopping.wait(pause)
