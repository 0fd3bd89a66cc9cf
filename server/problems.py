"""Errors as RFC 9457 problem details: every error answer has a sentence that its reader can act on."""

import logging
from http import HTTPStatus

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from sqlalchemy.exc import OperationalError
from starlette.exceptions import HTTPException

from server.rest_records import Problem
from worker.artifact_store import ArtifactError, ArtifactMissing, StoreAway


class ProblemError(Exception):
    """Ends a request with this status and sentence."""

    def __init__(self, status: int, detail: str) -> None:
        # The library's own sentences come without a full stop, as texts of exceptions do.
        self.detail = detail if detail.endswith((".", "?", "!")) else detail + "."
        self.status = status
        super().__init__(self.detail)


def artifact_problem(error: ArtifactError) -> ProblemError:
    """503 while the store is away, 404 for what it does not have, 502 for what came back damaged."""
    return ProblemError(503 if isinstance(error, StoreAway) else 404 if isinstance(error, ArtifactMissing) else 502, str(error))


def problem_response(status: int, detail: str, headers: dict[str, str] | None = None) -> JSONResponse:
    """The answer as application/problem+json."""
    body = Problem(title=HTTPStatus(status).phrase, status=status, detail=detail)
    return JSONResponse(body.model_dump(), status, headers, media_type="application/problem+json")


def add_problem_handlers(app: FastAPI) -> None:
    """Turn every error of the app into a problem."""

    @app.exception_handler(ProblemError)
    async def _problem(_: Request, error: ProblemError) -> JSONResponse:
        return problem_response(error.status, error.detail)

    @app.exception_handler(RequestValidationError)
    async def _validation(_: Request, error: RequestValidationError) -> JSONResponse:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"])
        return problem_response(422, f"{place}: {first['msg']}.")

    @app.exception_handler(HTTPException)
    async def _http(request: Request, error: HTTPException) -> JSONResponse:
        detail = error.detail
        if error.status_code == 404 and detail == HTTPStatus.NOT_FOUND.phrase:
            detail = f"There is nothing at {request.url.path}; the calls are listed at /api/docs."
        elif error.status_code == 405:
            detail = f"{request.method} is not possible at {request.url.path}; the calls are listed at /api/docs."
        return problem_response(error.status_code, detail, dict(error.headers or {}))

    @app.exception_handler(OperationalError)
    async def _database(request: Request, error: OperationalError) -> JSONResponse:
        logging.getLogger(__name__).error("%s %s failed", request.method, request.url.path, exc_info=error)
        sentence = "The database does not answer, or its disk is full; nothing was changed. Try again in a moment."
        return problem_response(503, sentence, {"retry-after": "2"})

    @app.exception_handler(ArtifactError)
    async def _artifacts(request: Request, error: ArtifactError) -> JSONResponse:
        logging.getLogger(__name__).error("%s %s failed: %s", request.method, request.url.path, error)
        problem = artifact_problem(error)
        return problem_response(problem.status, problem.detail, {"retry-after": "2"} if problem.status == 503 else None)

    @app.exception_handler(Exception)
    async def _unexpected(request: Request, error: Exception) -> JSONResponse:
        logging.getLogger(__name__).error("%s %s failed", request.method, request.url.path, exc_info=error)
        return problem_response(500, "The server made an error; its log says more.")
