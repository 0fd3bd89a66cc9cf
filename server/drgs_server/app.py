"""The application: middleware, routes, pages. `create_app` makes one; `run.py` serves it."""

import asyncio
import logging
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from copy import deepcopy
from functools import cache
from html import escape
from pathlib import Path

import psutil
from fastapi import FastAPI, Request, Response
from fastapi.responses import HTMLResponse, PlainTextResponse
from sqlalchemy.exc import SQLAlchemyError
from starlette.staticfiles import StaticFiles

from drgs import __version__
from drgs_server.api.context import ServerContext
from drgs_server.api.docs_page import docs_page
from drgs_server.api.door.body_limit import BodyLimit
from drgs_server.api.door.incoming import IncomingUploads
from drgs_server.api.door.rate_limit import CallBuckets, RateLimit
from drgs_server.api.door.security import COOKIE_NAME, Gatekeeper, GateMiddleware
from drgs_server.api.environments import EnvironmentStore
from drgs_server.api.metrics import CONTENT_TYPE, Metrics, MetricsMiddleware
from drgs_server.api.openapi_document import complete_document
from drgs_server.api.problems import ProblemError, UnexpectedErrors, add_problem_handlers
from drgs_server.api.rest_records import Health, TokenRequest
from drgs_server.api.routes import assets, captures, jobs, sessions, uploads, variants, views, weights
from drgs_server.live import stream
from drgs_server.live.admission import Admission
from drgs_server.live.return_memory import memory_returner
from drgs_server.live.sessions import SessionRegistry
from drgs_server.render.interface import AbstractRenderer
from drgs_server.render.shared_renderer import SharedRenderer
from drgs_server.render.thread import RenderThread
from drgs_server.settings import ServerSettings
from drgs_worker.jobs.queue import JobQueue
from drgs_worker.store.artifact_store import ArtifactError
from drgs_worker.store.backups import back_up_databases
from drgs_worker.store.data_directory import open_data_directory, read_token
from drgs_worker.store.database import open_database
from drgs_worker.store.remove_unused import remove_unused_captures, remove_unused_poses, remove_unused_weights
from drgs_worker.store.scratch import claim_scratch

LIVENESS_SECONDS = 5.0
"""Between two looks for jobs of dead workers."""
REMOVAL_SECONDS = 600.0
"""Between two looks for assets whose deletion can no longer be undone, and for what nobody refers to."""
BACKUP_SECONDS = 3600.0
"""Between two copies of the databases."""
RETURN_SECONDS = 2.0
"""Between two times that freed memory is given back."""
_ROUTES = (uploads, captures, jobs, assets, views, sessions, variants, weights, stream)
VIEWER = Path(__file__).parent / "static"


def create_app(settings: ServerSettings, renderer: AbstractRenderer | None = None) -> FastAPI:
    """
    Args:
        renderer: drgs' own where None.

    Raises:
        ValueError: the data directory cannot be used.
    """
    directory = open_data_directory(settings.data, settings.database_url, settings.queue_url, settings.artifact_url)
    scratch = claim_scratch(directory)  # before anything is written: it sweeps what is half written
    engine = open_database(directory)
    environments = EnvironmentStore(directory)
    environments.add_bundled(settings.bundled_environments)
    if renderer is None:
        from drgs_server.render.drgs_renderer import DrgsRenderer

        renderer = DrgsRenderer(settings.device)
    if directory.store is not None:
        renderer = SharedRenderer(renderer, directory)
    thread = RenderThread()
    metrics, admission = Metrics(), Admission(settings.limits)
    context = ServerContext(
        settings=settings,
        directory=directory,
        scratch=scratch,
        engine=engine,
        queue=JobQueue(directory, engine),
        environments=environments,
        incoming=IncomingUploads(directory.incoming, settings.limits),
        render_thread=thread,
        sessions=SessionRegistry(directory, engine, renderer, thread, environments, settings.limits, metrics, admission),
        gatekeeper=Gatekeeper(settings.token.get_secret_value() if settings.token else read_token(directory), settings.host_names),
        metrics=metrics,
        admission=admission,
    )

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        thread.start()
        await context.sessions.prepare_if_any()
        work = (_requeue_dead_workers_jobs, _remove_unused, _forget_assets_deleted_elsewhere, _back_up_databases)
        chores = [asyncio.create_task(chore(context)) for chore in work] + [asyncio.create_task(_return_memory())]
        yield
        for chore in chores:
            chore.cancel()
            with suppress(asyncio.CancelledError):
                await chore
        await asyncio.to_thread(thread.stop)
        context.sessions.close()
        context.queue.close()
        engine.dispose()
        context.scratch.close()

    app = FastAPI(title="DR-GS", version=__version__, lifespan=lifespan, docs_url=None, redoc_url=None, openapi_url="/api/openapi.json")
    app.state.context = context
    derive = app.openapi
    app.openapi = cache(lambda: complete_document(deepcopy(derive())))  # type: ignore[method-assign]
    add_problem_handlers(app, directory.told)
    for routes in _ROUTES:
        app.include_router(routes.router)
    _add_small_routes(app, context)
    _add_pages(app, settings)
    app.add_middleware(UnexpectedErrors)
    # Outermost last: the gate comes before anything reads a body.
    app.add_middleware(BodyLimit, limits=settings.limits)
    failures = CallBuckets(settings.limits.failures_a_second)
    app.add_middleware(RateLimit, requests_a_second=settings.limits.requests_a_second, failures=failures)
    app.add_middleware(GateMiddleware, gatekeeper=context.gatekeeper, failures=failures, most_streams=settings.limits.connections)
    app.add_middleware(MetricsMiddleware, metrics=context.metrics)
    return app


async def _requeue_dead_workers_jobs(context: ServerContext) -> None:
    while True:
        await asyncio.sleep(LIVENESS_SECONDS)
        try:
            moved = await asyncio.to_thread(context.queue.requeue_dead)
        except SQLAlchemyError as error:  # looked for again in a moment
            logging.getLogger(__name__).warning("the database does not answer: %s", error)
            continue
        if moved:
            logging.getLogger(__name__).warning("handed over %d jobs of dead workers", len(moved))


async def _remove_unused(context: ServerContext) -> None:
    while True:
        try:
            await asyncio.to_thread(assets.remove_deleted_assets, context)
            await asyncio.to_thread(remove_unused_weights, context.directory, context.engine)
            await asyncio.to_thread(remove_unused_poses, context.directory, context.engine)
            keep_seconds = context.settings.limits.keep_upload_seconds
            await asyncio.to_thread(context.incoming.remove_before, time.time() - keep_seconds)
            await asyncio.to_thread(remove_unused_captures, context.directory, context.engine, keep_seconds)
        except (SQLAlchemyError, ArtifactError, OSError) as error:
            logging.getLogger(__name__).warning("what is deleted or unused was not removed: %s", error)
        await asyncio.sleep(REMOVAL_SECONDS)


async def _forget_assets_deleted_elsewhere(context: ServerContext) -> None:
    while True:
        await asyncio.sleep(LIVENESS_SECONDS)
        try:
            await context.sessions.forget_deleted()
        except SQLAlchemyError as error:
            logging.getLogger(__name__).warning("the database does not answer: %s", error)


async def _return_memory() -> None:
    give_back = memory_returner()
    while True:
        await asyncio.sleep(RETURN_SECONDS)
        await asyncio.to_thread(give_back)


async def _back_up_databases(context: ServerContext) -> None:
    while True:
        try:
            await asyncio.to_thread(back_up_databases, context.directory, context.scratch.folder)
        except (ValueError, OSError) as error:  # the copy of before is kept
            logging.getLogger(__name__).error("%s", error)
        await asyncio.sleep(BACKUP_SECONDS)


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
            "drgs_heavy_waiting": context.admission.waiting(),
            "drgs_resident_bytes": psutil.Process().memory_info().rss,
        }
        return PlainTextResponse(context.metrics.text(gauges), media_type=CONTENT_TYPE)

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
    viewer = settings.static_folder or VIEWER
    if (viewer / "index.html").is_file():
        app.mount("/", StaticFiles(directory=viewer, html=True), name="viewer")
        return

    @app.get("/", include_in_schema=False)
    async def no_viewer() -> HTMLResponse:
        command = "./run setup"
        return HTMLResponse(
            "<!doctype html><title>DR-GS</title><h1>DR-GS is running</h1><p>The viewer was not built. Build it with "
            f"<code>{escape(command)}</code> and start the server again. The API answers below <code>/api</code>.</p>"
        )
