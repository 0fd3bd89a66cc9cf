"""How large a body may be: uploads get their own, larger limit, and calls without the token a smaller one. What is larger gets 413 and a sentence,
and what is packed 415: read as it comes it would be something else."""

from starlette.datastructures import Headers
from starlette.middleware.body_limit import RequestBodyLimitMiddleware
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from drgs_server.api.door.rate_limit import OPEN_API_PATHS
from drgs_server.api.problems import problem_response
from drgs_server.settings import Limits

OPEN_BODY_BYTES = 4096
"""Of a call without the token: a login."""
UPLOAD_PATHS = ("/api/jobs", "/api/assets", "/api/environments")
OWN_PATH = "/api/uploads"
PART_PATHS = f"{OWN_PATH}/"
"""Below it parts of an upload are sent, the last of which may be all of it."""


def _is_problem(start: Message) -> bool:
    return Headers(raw=start["headers"]).get("content-type") == "application/problem+json"


class BodyLimit:
    """Final. Outside of everything that reads a body, and of whatever turns errors into answers."""

    def __init__(self, app: ASGIApp, limits: Limits) -> None:
        self._most = limits.body_bytes
        self._others = dict.fromkeys(UPLOAD_PATHS, limits.upload_bytes) | dict.fromkeys(OPEN_API_PATHS, OPEN_BODY_BYTES)
        self._limited = {most: RequestBodyLimitMiddleware(app, most) for most in {self._most, *self._others.values()}}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        packed = Headers(scope=scope).get("content-encoding", "identity").strip().lower() if scope["type"] == "http" else "identity"
        if packed not in ("", "identity"):
            sentence = "Bodies are read as they come; send this one without a Content-Encoding."
            await problem_response(415, sentence)(scope, receive, send)
            return
        path = scope.get("path", "")
        most, refused = self._others.get(UPLOAD_PATHS[0] if path.startswith(PART_PATHS) else path, self._most), False

        async def send_or_explain(message: Message) -> None:
            """Starlette's own answer is the words of the status; uploads in parts have bounds of their own, and say so."""
            nonlocal refused
            if (
                message["type"] == "http.response.start"
                and message["status"] == 413
                and not (path.startswith(OWN_PATH) and _is_problem(message))
            ):
                refused = True
                sentence = f"The body is larger than the {most} bytes that this call takes; send less, or in parts."
                await problem_response(413, sentence)(scope, receive, send)
            elif not refused:
                await send(message)

        await self._limited[most](scope, receive, send_or_explain)
