"""The application: middleware, routes, pages. `create_app` makes one; `run.py` serves it."""

import asyncio
import logging
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from copy import deepcopy
from functools import cache
from html import escape

import psutil
from fastapi import FastAPI, Request, Response
from fastapi.responses import HTMLResponse, PlainTextResponse
from sqlalchemy.exc import SQLAlchemyError
from starlette.middleware.body_limit import RequestBodyLimitMiddleware
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp, Receive, Scope, Send

from drgs import __version__
from server import routes_assets, routes_jobs, routes_sessions, routes_views, stream
from server.context import ServerContext
from server.docs_page import docs_page
from server.environments import EnvironmentStore
from server.metrics import Metrics, MetricsMiddleware
from server.openapi_document import complete_document
from server.problems import ProblemError, add_problem_handlers
from server.rate_limit import RateLimit
from server.render_session import AbstractRenderer
from server.render_thread import RenderThread
from server.rest_records import Health, TokenRequest
from server.security import COOKIE_NAME, Gatekeeper, GateMiddleware
from server.sessions import SessionRegistry
from server.settings import ServerSettings
from server.shared_renderer import SharedRenderer
from server.viewer import Viewer
from worker.artifact_store import ArtifactError
from worker.data_directory import open_data_directory, read_token
from worker.database import open_database
from worker.queue import JobQueue

LIVENESS_SECONDS = 5.0
"""Between two looks for jobs of dead workers."""
REMOVAL_SECONDS = 600.0
"""Between two looks for assets whose deletion can no longer be undone."""
UPLOAD_PATHS = ("/api/jobs", "/api/assets", "/api/environments")


def create_app(settings: ServerSettings, renderer: AbstractRenderer | None = None) -> FastAPI:
    """
    Args:
        renderer: drgs' own where None.

    Raises:
        ValueError: the data directory cannot be used.
    """
    directory = open_data_directory(settings.data, settings.database_url, settings.queue_url, settings.artifact_url)
    engine = open_database(directory)
    environments = EnvironmentStore(directory)
    environments.add_bundled(settings.bundled_environments)
    if renderer is None:
        from server.drgs_renderer import DrgsRenderer

        renderer = DrgsRenderer(settings.device)
    if directory.store is not None:
        renderer = SharedRenderer(renderer, directory)
    connections: dict[Viewer, stream.Connection] = {}

    def tell(viewer: Viewer, sentence: str) -> None:
        if (connection := connections.get(viewer)) is not None:
            connection.tell_error(sentence)

    thread = RenderThread(tell)
    metrics = Metrics()
    context = ServerContext(
        settings=settings,
        directory=directory,
        engine=engine,
        queue=JobQueue(directory, engine),
        environments=environments,
        render_thread=thread,
        sessions=SessionRegistry(directory, engine, renderer, thread, environments, settings.limits, metrics),
        gatekeeper=Gatekeeper(settings.token.get_secret_value() if settings.token else read_token(directory), settings.host_names),
        connections=connections,
        metrics=metrics,
    )

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        thread.start()
        if await asyncio.to_thread(context.sessions.any):
            asyncio.get_running_loop().run_in_executor(None, renderer.prepare)
        chores = [asyncio.create_task(_requeue_dead_workers_jobs(context.queue)), asyncio.create_task(_remove_deleted_assets(context))]
        yield
        for chore in chores:
            chore.cancel()
            with suppress(asyncio.CancelledError):
                await chore
        await asyncio.to_thread(thread.stop)
        context.sessions.close()
        context.queue.close()
        engine.dispose()

    app = FastAPI(title="DR-GS", version=__version__, lifespan=lifespan, docs_url=None, redoc_url=None, openapi_url="/api/openapi.json")
    app.state.context = context
    derive = app.openapi
    app.openapi = cache(lambda: complete_document(deepcopy(derive())))  # type: ignore[method-assign]
    add_problem_handlers(app)
    for routes in (routes_jobs, routes_assets, routes_views, routes_sessions, stream):
        app.include_router(routes.router)
    _add_small_routes(app, context)
    _add_pages(app, settings)
    # Outermost last: the gate comes before anything reads a body.
    app.add_middleware(_BodyLimit, limits=settings.limits)
    app.add_middleware(RateLimit, requests_a_second=settings.limits.requests_a_second)
    app.add_middleware(GateMiddleware, gatekeeper=context.gatekeeper)
    app.add_middleware(MetricsMiddleware, metrics=context.metrics)
    return app


class _BodyLimit:
    """Uploads get their own, larger limit."""

    def __init__(self, app: ASGIApp, limits) -> None:
        self._small = RequestBodyLimitMiddleware(app, limits.body_bytes)
        self._large = RequestBodyLimitMiddleware(app, limits.upload_bytes)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        await (self._large if scope.get("path") in UPLOAD_PATHS else self._small)(scope, receive, send)


async def _requeue_dead_workers_jobs(queue: JobQueue) -> None:
    while True:
        await asyncio.sleep(LIVENESS_SECONDS)
        try:
            moved = await asyncio.to_thread(queue.requeue_dead)
        except SQLAlchemyError as error:  # looked for again in a moment
            logging.getLogger(__name__).warning("the database does not answer: %s", error)
            continue
        if moved:
            logging.getLogger(__name__).warning("handed over %d jobs of dead workers", len(moved))


async def _remove_deleted_assets(context: ServerContext) -> None:
    while True:
        try:
            await asyncio.to_thread(routes_assets.remove_deleted_assets, context)
        except (SQLAlchemyError, ArtifactError) as error:
            logging.getLogger(__name__).warning("deleted assets were not removed: %s", error)
        await asyncio.sleep(REMOVAL_SECONDS)


def _add_small_routes(app: FastAPI, context: ServerContext) -> None:
    @app.get("/healthz", tags=["service"])
    async def healthz() -> Health:
        return Health()

    @app.get("/metrics", tags=["service"], response_class=PlainTextResponse)
    def read_metrics() -> PlainTextResponse:
        """In Prometheus' text format; needs the token, as `Authorization: Bearer`."""
        gauges = {
            "drgs_viewers": context.sessions.viewer_count(),
            "drgs_sessions_live": context.sessions.live_count(),
            "drgs_assets_loaded": context.sessions.loaded_count(),
            "drgs_jobs": context.queue.active_count(),
            "drgs_workers_alive": len(context.queue.alive_workers()),
            "drgs_resident_bytes": psutil.Process().memory_info().rss,
        }
        return PlainTextResponse(context.metrics.text(gauges), media_type="text/plain; version=0.0.4")

    @app.post("/api/login", status_code=204, tags=["service"])
    async def login(body: TokenRequest, request: Request) -> Response:
        """Exchange the token for a cookie that page scripts cannot read."""
        if not context.gatekeeper.knows_token(body.token):
            raise ProblemError(401, "The token is wrong; `drgs serve` printed an address that holds it.")
        response = Response(status_code=204)
        secure = request.url.scheme == "https"
        response.set_cookie(COOKIE_NAME, context.gatekeeper.cookie_value, httponly=True, samesite="strict", secure=secure, path="/")
        return response

    @app.get("/api/docs", include_in_schema=False)
    async def docs() -> HTMLResponse:
        return HTMLResponse(docs_page(app.openapi()))


def _add_pages(app: FastAPI, settings: ServerSettings) -> None:
    if (settings.static_folder / "index.html").is_file():
        app.mount("/", StaticFiles(directory=settings.static_folder, html=True), name="viewer")
        return

    @app.get("/", include_in_schema=False)
    async def no_viewer() -> HTMLResponse:
        command = "./run setup"
        return HTMLResponse(
            "<!doctype html><title>DR-GS</title><h1>DR-GS is running</h1><p>The viewer was not built. Build it with "
            f"<code>{escape(command)}</code> and start the server again. The API answers below <code>/api</code>.</p>"
        )
