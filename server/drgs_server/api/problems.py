"""Errors as RFC 9457 problem details: every error answer has a sentence that its reader can act on."""

import logging
import math
from collections.abc import Callable
from http import HTTPStatus

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse, Response
from sqlalchemy.exc import DatabaseError, OperationalError
from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from drgs_server.api.door.while_connected import CallerLeft
from drgs_server.api.rest_records import Problem
from drgs_worker.store import disk_trouble
from drgs_worker.store.artifact_store import ArtifactError, ArtifactMissing, StoreAway

CLIENT_CLOSED_REQUEST = 499
"""No status of the standard, but what servers write into their logs."""
RETRY_SECONDS = 2.0
"""After which a caller may try again where nothing better is known."""
MOST_PLACE = 100
"""Characters of the path to a wrong field, which may be made of names that the caller chose."""
UNEXPECTED = "The server made an error; its log says more."


class ProblemError(Exception):
    """Ends a request with this status and sentence.

    Args:
        retry_after: seconds after which the same request may succeed; every 429 and 503 says some.
        headers: what else the answer says.
    """

    def __init__(self, status: int, detail: str, retry_after: float | None = None, headers: dict[str, str] | None = None) -> None:
        # The library's own sentences come without a full stop, as texts of exceptions do.
        self.detail = detail if detail.endswith((".", "?", "!")) else detail + "."
        self.status = status
        self.retry_after = RETRY_SECONDS if retry_after is None and status in (429, 503) else retry_after
        self.headers = headers or {}
        super().__init__(self.detail)


def artifact_problem(error: ArtifactError) -> ProblemError:
    """503 while the store is away, 404 for what it does not have, 502 for what came back damaged."""
    return ProblemError(503 if isinstance(error, StoreAway) else 404 if isinstance(error, ArtifactMissing) else 502, str(error))


def problem_response(status: int, detail: str, headers: dict[str, str] | None = None) -> JSONResponse:
    """The answer as application/problem+json."""
    body = Problem(title=HTTPStatus(status).phrase, status=status, detail=detail)
    return JSONResponse(body.model_dump(), status, headers, media_type="application/problem+json")


def add_problem_handlers(app: FastAPI, told: Callable[[str], str]) -> None:
    """Turn every error that a route foresees into a problem.

    Args:
        told: makes of a sentence what callers may read (DataDirectory.told).
    """

    @app.exception_handler(ProblemError)
    async def _problem(_: Request, error: ProblemError) -> JSONResponse:
        wait = {} if error.retry_after is None else {"retry-after": str(math.ceil(error.retry_after))}
        return problem_response(error.status, told(error.detail), error.headers | wait)

    @app.exception_handler(CallerLeft)
    async def _left(_: Request, __: CallerLeft) -> Response:
        return Response(status_code=CLIENT_CLOSED_REQUEST)  # for the metrics; nobody reads it

    @app.exception_handler(RequestValidationError)
    async def _validation(_: Request, error: RequestValidationError) -> JSONResponse:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"])
        return problem_response(422, told(f"{place[:MOST_PLACE]}: {first['msg']}."))

    @app.exception_handler(HTTPException)
    async def _http(request: Request, error: HTTPException) -> JSONResponse:
        detail = error.detail
        if error.status_code == 404 and detail == HTTPStatus.NOT_FOUND.phrase:
            detail = f"There is nothing at {request.url.path}; the calls are listed at /api/docs."
        elif error.status_code == 405:
            detail = f"{request.method} is not possible at {request.url.path}; the calls are listed at /api/docs."
        elif error.status_code == 413:
            detail = "The body is larger than this call takes; send less, or in parts."
        return problem_response(error.status_code, told(detail), dict(error.headers or {}))

    @app.exception_handler(OperationalError)
    async def _database(request: Request, error: OperationalError) -> JSONResponse:
        logging.getLogger(__name__).error("%s %s failed", request.method, request.url.path, exc_info=error)
        sentence = "The database does not answer, or its disk is full; nothing was changed. Try again in a moment."
        return problem_response(503, sentence, {"retry-after": "2"})

    @app.exception_handler(DatabaseError)
    async def _damaged_database(request: Request, error: DatabaseError) -> JSONResponse:
        logging.getLogger(__name__).error("%s %s failed", request.method, request.url.path, exc_info=error)
        if not any(words in str(error) for words in ("malformed", "not a database")):
            return problem_response(500, UNEXPECTED)
        sentence = (
            "The database is damaged; nothing was changed. Start the server again: it says which file it is, and offers its last good copy."
        )
        return problem_response(503, sentence, {"retry-after": "60"})

    @app.exception_handler(OSError)
    async def _system(request: Request, error: OSError) -> JSONResponse:
        sentence = disk_trouble.sentence_of(error)
        if sentence is None:
            logging.getLogger(__name__).error("%s %s failed", request.method, request.url.path, exc_info=error)
            return problem_response(500, UNEXPECTED)
        logging.getLogger(__name__).error("%s %s failed: %s", request.method, request.url.path, error)
        return problem_response(503, sentence, {"retry-after": "30"})

    @app.exception_handler(ArtifactError)
    async def _artifacts(request: Request, error: ArtifactError) -> JSONResponse:
        logging.getLogger(__name__).error("%s %s failed: %s", request.method, request.url.path, error)
        problem = artifact_problem(error)
        return problem_response(problem.status, told(problem.detail), {"retry-after": "2"} if problem.status == 503 else None)


class UnexpectedErrors:
    """Final. Answers 500 with a sentence where a route raises what nobody foresaw, and keeps the connection.

    Starlette's own handler raises again behind its answer, whereupon uvicorn closes the connection without having said so, and the next call
    of a client that keeps its connections fails.
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        started = False

        async def send_and_see(message: Message) -> None:
            nonlocal started
            started = started or message["type"] == "http.response.start"
            await send(message)

        try:
            await self._app(scope, receive, send_and_see)
        except Exception as error:
            if started or scope["type"] != "http":
                raise
            logging.getLogger(__name__).error("%s %s failed", scope["method"], scope["path"], exc_info=error)
            await problem_response(500, UNEXPECTED)(scope, receive, send)
