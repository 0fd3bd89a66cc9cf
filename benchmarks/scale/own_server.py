"""A server in a process of its own while a curve is measured."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import psutil

from benchmarks.serve.soak import serve_folder
from drgs_server.client import Client


@contextmanager
def own_server(folder: Path) -> Iterator[tuple[psutil.Process, Client]]:
    """On a new data folder inside the given one; ended also on errors."""
    folder.mkdir(parents=True)
    server, client = serve_folder(folder)
    try:
        yield psutil.Process(server.pid), client
    finally:
        client.close()
        server.terminate()
        server.wait()
