"""What the routes work with: made once by `create_app`, found at `request.app.state.context`."""

from dataclasses import dataclass

from fastapi import Request
from sqlalchemy import Engine
from starlette.requests import HTTPConnection

from drgs_server.api.door.incoming import IncomingUploads
from drgs_server.api.door.security import Gatekeeper
from drgs_server.api.environments import EnvironmentStore
from drgs_server.api.metrics import Metrics
from drgs_server.live.admission import Admission, Caller
from drgs_server.live.sessions import SessionRegistry
from drgs_server.render.thread import RenderThread
from drgs_server.settings import ServerSettings
from drgs_worker.jobs.queue import JobQueue
from drgs_worker.store.data_directory import DataDirectory
from drgs_worker.store.scratch import Scratch


@dataclass(frozen=True, eq=False)
class ServerContext:
    """The parts of a running server."""

    settings: ServerSettings
    directory: DataDirectory
    scratch: Scratch
    engine: Engine
    queue: JobQueue
    environments: EnvironmentStore
    incoming: IncomingUploads
    render_thread: RenderThread
    sessions: SessionRegistry
    gatekeeper: Gatekeeper
    metrics: Metrics
    admission: Admission


def caller_of(connection: HTTPConnection, session: str = "") -> Caller:
    """Whom a request or a stream is for: its address, and the session where it has one."""
    return ((connection.client.host if connection.client else "?"), *((session,) if session else ()))


async def context_of(request: Request) -> ServerContext:
    """Dependency of routes. Async, though it waits for nothing: FastAPI would look it up in another thread, and each change of threads costs a wait
    for Python's lock while a frame is rendered."""
    return request.app.state.context
