"""Who may ask: Host, Origin, token, and headers that tell browsers to be careful. One ASGI layer around everything, WebSockets too.

The model is Jupyter's (service reference, section 13): loopback, a token, a Host check against DNS rebinding, an Origin check because
browsers let any page open a WebSocket to 127.0.0.1 and send cookies to every port of it.
"""

import hashlib
import hmac
import re
from http.cookies import CookieError, SimpleCookie

from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from drgs_server.api.door.connections import CONNECTION, GuardedConnection
from drgs_server.api.door.rate_limit import OPEN_API_PATHS, CallBuckets, peer_of, too_many_failures
from drgs_server.api.problems import problem_response
from drgs_server.live.messages import CLOSE_POLICY, CLOSE_TRY_AGAIN

COOKIE_NAME = "drgs_session"
SAID_ONCE = ("host", "origin", "authorization")
"""Headers by which it is decided who may ask: of two, another program on the way might believe the other."""

# blob: three.js reads a GLB's textures from blobs. unsafe-inline for styles only: component libraries set style attributes.
# wasm-unsafe-eval lets WebAssembly of our own files be compiled (the pictures in a SOG), and no script that is not a file of ours.
CONTENT_SECURITY_POLICY = (
    "default-src 'self'; script-src 'self' 'wasm-unsafe-eval'; img-src 'self' blob: data:; connect-src 'self' blob:; style-src 'self' 'unsafe-inline'; "
    "object-src 'none'; base-uri 'none'; form-action 'self'; frame-ancestors 'none'"
)
_HOST = re.compile(r"(?P<name>[^:\[\]\s]+|\[[0-9A-Fa-f:.]+\])(?::(?P<port>[0-9]{1,5}))?")
_HEADERS = {
    "content-security-policy": CONTENT_SECURITY_POLICY,
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cross-origin-resource-policy": "same-origin",
    "cross-origin-opener-policy": "same-origin",
}


class Gatekeeper:
    """Final. Knows the token; answers whether a caller does."""

    def __init__(self, token: str, host_names: tuple[str, ...]) -> None:
        self._token = token.encode()
        # The cookie is derived, so that who reads a cookie jar does not learn the token that scripts use.
        self.cookie_value = hmac.new(self._token, b"drgs cookie", hashlib.sha256).hexdigest()
        self._host_names = host_names

    def knows_token(self, token: str) -> bool:
        return hmac.compare_digest(token.encode(), self._token)

    def has_bearer(self, headers: Headers) -> bool:
        scheme, _, token = headers.get("authorization", "").partition(" ")
        return scheme.lower() == "bearer" and self.knows_token(token.strip())

    def has_cookie(self, headers: Headers) -> bool:
        try:
            cookies = SimpleCookie(headers.get("cookie", ""))
        except CookieError:
            return False
        found = cookies[COOKIE_NAME].value if COOKIE_NAME in cookies else ""
        return hmac.compare_digest(found.encode(), self.cookie_value.encode())

    def has_token(self, scope: Scope) -> bool:
        """Whether the caller has shown that it knows the token, by whichever way."""
        headers = Headers(scope=scope)
        return self.has_bearer(headers) or self.has_cookie(headers)

    def is_our_host(self, host: str) -> bool:
        """Whether this is a name of ours, with a port or without."""
        found = _HOST.fullmatch(host)
        return found is not None and found["name"].lower() in self._host_names and int(found["port"] or 0) <= 65535

    def refusal(self, scope: Scope) -> tuple[int, str] | None:
        """Status and sentence, or None to let the request in."""
        headers = Headers(scope=scope)
        websocket = scope["type"] == "websocket"
        twice = next((name for name in SAID_ONCE if len(headers.getlist(name)) > 1), None)
        if twice is not None:
            return 400, f"The header {twice.title()} was sent more than once; send it once."
        if "\0" in scope["path"] or b"%00" in scope.get("query_string", b""):
            return 400, "An address holds no NUL; nothing has one in its name."
        host, origin = headers.get("host", ""), headers.get("origin")
        if not self.is_our_host(host):
            return 400, "This Host name is not served here; use the address that `drgs serve` printed."
        needs_token = websocket or scope["path"] == "/metrics" or (scope["path"].startswith("/api") and scope["path"] not in OPEN_API_PATHS)
        changes = websocket or scope.get("method") not in ("GET", "HEAD")
        bearer = self.has_bearer(headers)
        if origin is not None and changes and origin not in (f"http://{host}", f"https://{host}"):
            return 403, "A page of another origin may not do this."
        if not needs_token or bearer:
            return None
        if not self.has_cookie(headers):
            return 401, "The token is missing or wrong; `drgs serve` printed an address that holds it."
        if changes and origin is None:
            return 403, "A call with a cookie that changes something must say its Origin; programs send `Authorization: Bearer TOKEN`."
        return None


class GateMiddleware:
    """Refuses before anything else runs, and adds the careful headers to every answer."""

    def __init__(self, app: ASGIApp, gatekeeper: Gatekeeper, failures: CallBuckets, most_streams: int) -> None:
        """
        Args:
            failures: of calls without the token, or with a wrong one.
            most_streams: open at the same time.
        """
        self._app = app
        self._gatekeeper = gatekeeper
        self._failures = failures
        self._most_streams = most_streams
        self._streams = 0

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return

        async def send_carefully(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in _HEADERS.items():
                    headers.setdefault(name, value)
                if scope["path"].startswith("/api"):
                    headers.setdefault("cache-control", "no-store")
            await send(message)

        refusal = self._gatekeeper.refusal(scope)
        few_failures = refusal is None or refusal[0] != 401 or self._failures.take(peer_of(scope))
        if scope["type"] == "websocket":
            await self._stream(scope, receive, send, refusal)
        elif not few_failures:
            await too_many_failures(self._failures)(scope, receive, send_carefully)
        elif refusal is not None:
            headers = {"www-authenticate": "Bearer"} if refusal[0] == 401 else None
            await problem_response(*refusal, headers)(scope, receive, send_carefully)
        elif not self._is_admitted(scope):
            headers = {"retry-after": "2", "connection": "close"}
            sentence = "As many connections as this server keeps are open; close some, or try again in a moment."
            await problem_response(503, sentence, headers)(scope, receive, send_carefully)
        else:
            await self._app(scope, receive, send_carefully)

    def _is_admitted(self, scope: Scope) -> bool:
        """Whether the connection may stay: one of a caller with the token is kept before others."""
        connection: GuardedConnection | None = scope.get(CONNECTION)
        return connection is None or not self._gatekeeper.has_token(scope) or connection.admit()

    async def _stream(self, scope: Scope, receive: Receive, send: Send, refusal: tuple[int, str] | None) -> None:
        if refusal is None and self._streams < self._most_streams:
            self._streams += 1
            try:
                await self._app(scope, receive, send)
            finally:
                self._streams -= 1
            return
        # Closing before accepting: the browser gets a plain 403 and no socket.
        await receive()
        code, reason = (CLOSE_POLICY, refusal[1]) if refusal else (CLOSE_TRY_AGAIN, "As many streams as this server keeps are open.")
        await send({"type": "websocket.close", "code": code, "reason": reason})
