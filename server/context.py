"""What the routes work with: made once by `create_app`, found at `request.app.state.context`."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from fastapi import Request
from sqlalchemy import Engine

from server.environments import EnvironmentStore
from server.metrics import Metrics
from server.render_thread import RenderThread
from server.security import Gatekeeper
from server.sessions import SessionRegistry
from server.settings import ServerSettings
from server.viewer import Viewer
from worker.data_directory import DataDirectory
from worker.queue import JobQueue

if TYPE_CHECKING:
    from server.stream import Connection


@dataclass(frozen=True, eq=False)
class ServerContext:
    """The parts of a running server."""

    settings: ServerSettings
    directory: DataDirectory
    engine: Engine
    queue: JobQueue
    environments: EnvironmentStore
    render_thread: RenderThread
    sessions: SessionRegistry
    gatekeeper: Gatekeeper
    metrics: Metrics
    connections: dict[Viewer, Connection] = field(default_factory=dict)
    """Open streams by their viewer."""


async def context_of(request: Request) -> ServerContext:
    """Dependency of routes. Async, though it waits for nothing: FastAPI would look it up in another thread, and each change of threads costs a wait
    for Python's lock while a frame is rendered."""
    return request.app.state.context
