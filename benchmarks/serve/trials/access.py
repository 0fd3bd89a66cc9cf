"""Who may ask, and what for: hosts, tokens, origins, methods and paths that are not theirs to ask."""

import http.client
import json
import re
import socket
from collections.abc import Iterator
from functools import partial

from benchmarks.serve.trials.site import REFUSED, Site, Trial

WRONG_HOSTS = (
    "evil.example", "127.0.0.1.evil.example", "localhost.evil.example", "", "127.0.0.1:junk", "127.0.0.1:999999", "127.0.0.1:-1",
    "localhost:80:80", "localhost:80 evil", "user@localhost", "localhost@evil.example", "[::1", "::1]", "[::1]junk", "[::2]", "0x7f000001",
    "2130706433", "127.1", "localhost/..", "localhost#", "localhost,evil.example", "xn--localhost", "lócalhost",
)  # fmt: skip
RIGHT_HOSTS = ("localhost", "localhost:{port}", "127.0.0.1", "127.0.0.1:{port}", "[::1]", "[::1]:{port}", "LOCALHOST:{port}")
WRONG_AUTHORIZATIONS = (
    "", "Bearer", "Bearer ", "Bearer x", "Bearer {short}", "Bearer {token}x", "Bearer x{token}", "Bearer {upper}", "Basic {token}", "{token}",
    "Bearer null", "Bearer undefined", "Bearer {token} {token}", "Bearer\t", "Digest {token}", "Bearer {half}{half}", "Bearer " + "A" * 10_000,
)  # fmt: skip
WRONG_LOGINS = (
    b"", b"{}", b"null", b"[]", b'{"token": ""}', b'{"token": "x"}', b'{"token": null}', b'{"token": 5}', b'{"token": ["a"]}', b'{"token": true}',
    b'{"token": "' + b"x" * 1_000_000 + b'"}', b'{"token": "\\ud800"}', b'{"token": "\\u0000"}', b'{"Token": "x"}', b"\xff\xfe", b"[" * 50_000,
)  # fmt: skip
WRONG_ORIGINS = (
    "http://evil.example",
    "null",
    "http://127.0.0.1:1",
    "https://localhost.evil.example",
    "file://",
    "http://localhost:{port}.evil",
    "x",
)
METHODS = ("TRACE", "OPTIONS", "PATCH", "PROPFIND", "DEBUG", "get", "A" * 100)
STRANGE_PATHS = (
    "/../token", "/%2e%2e/token", "/..%2ftoken", "/static/../../token", "//etc/passwd", "/%00", "/api/%00", "/api/environments/..%2f..%2ftoken",
    "/api/environments/..%5c..%5ctoken", "/api/environments/token", "/api/environments/../token", "/api/jobs/..%2f..%2ftoken/log",
    "/api/jobs/x/files/..%2f..%2f..%2ftoken", "/api/assets/..%2f..%2ftoken/mesh.glb", "/api/assets/.%2f/mesh.glb", "/app.sqlite", "/token",
    "/api/sessions/..%2f/frame.jpg", "/api/environments/" + "a" * 5000, "/api/environments/%ff%fe", "/api/assets/%f0%9f%92%a9", "/" + "%2e%2e/" * 50,
    "/api/sessions/" + "0" * 32, "/api/jobs/" + "f" * 32 + "/preview.jpg", "/;/token", "/api;/assets", "/%2fapi/assets", "/API/assets", "/api//assets",
)  # fmt: skip
LOGINS = 400
"""Wrong ones in a row, each under another forwarded address."""


def trials() -> Iterator[Trial]:
    for host in WRONG_HOSTS:
        yield Trial("hosts", f"host {host!r} is refused", partial(_wrong_host, host))
    for host in RIGHT_HOSTS:
        yield Trial("hosts", f"host {host!r} is answered", partial(_right_host, host))
    for hosts in (("localhost", "evil.example"), ("evil.example", "localhost"), ("localhost", "localhost"), ()):
        yield Trial("hosts", f"{len(hosts)} Host headers {hosts} are refused", partial(_hosts, hosts))
    for words in WRONG_AUTHORIZATIONS:
        yield Trial("tokens", f"authorization {words[:30]!r} is refused", partial(_wrong_authorization, words))
    for body in WRONG_LOGINS:
        yield Trial("tokens", f"login {body[:30]!r} is refused", partial(_wrong_login, body))
    for name, headers in (
        ("cookie with the token", "drgs_session={token}"),
        ("empty cookie", "drgs_session="),
        ("broken cookie", 'drgs_session="'),
    ):
        yield Trial("tokens", f"{name} is refused", partial(_wrong_cookie, headers))
    yield Trial("tokens", "a token in the address is not looked at", _token_in_address)
    yield Trial("tokens", "every call of the interface needs the token", _every_call_needs_the_token)
    for origin in WRONG_ORIGINS:
        yield Trial("origins", f"origin {origin!r} may change nothing", partial(_wrong_origin, origin))
        yield Trial("origins", f"origin {origin!r} opens no stream", partial(_wrong_origin_of_stream, origin))
    for method in METHODS:
        for path in ("/", "/api/assets", "/healthz"):
            yield Trial("methods", f"{method[:20]} {path}", partial(_method, method, path))
    for path in STRANGE_PATHS:
        yield Trial("paths", f"{path[:50]} shows nothing", partial(_strange_path, path))
    yield Trial("rates", f"{LOGINS} wrong logins meet a limit, the right token none", _many_logins)
    yield Trial("rates", "wrong bearers meet a limit, the right token none", _many_bearers)


def raw(site: Site, data: bytes, seconds: float = 20.0) -> bytes:
    """What comes back on a connection of its own; empty where it was closed or reset without a word.

    Raises:
        TimeoutError: nothing came, and it stayed open.
    """
    with socket.create_connection(("127.0.0.1", site.port), timeout=seconds) as connection:
        try:
            connection.sendall(data)
            received = b""
            while b"\r\n\r\n" not in received and (piece := connection.recv(65536)):
                received += piece
            return received
        except (ConnectionResetError, BrokenPipeError):
            return b""


def status_of(answer: bytes) -> int:
    """0 where there is none."""
    found = re.match(rb"HTTP/1\.[01] (\d{3})", answer)
    return int(found[1]) if found else 0


def _hosts(hosts: tuple[str, ...], site: Site) -> str | None:
    lines = "".join(f"Host: {host}\r\n" for host in hosts)
    request = f"GET /api/assets HTTP/1.1\r\n{lines}Authorization: Bearer {site.token}\r\nConnection: close\r\n\r\n"
    status = status_of(raw(site, request.encode()))
    return None if status in (400, 0) else f"answered {status}"


def _wrong_host(host: str, site: Site) -> str | None:
    return _hosts((host,), site)


def _right_host(host: str, site: Site) -> str | None:
    request = f"GET /api/assets HTTP/1.1\r\nHost: {host.format(port=site.port)}\r\nAuthorization: Bearer {site.token}\r\nConnection: close\r\n\r\n"
    status = status_of(raw(site, request.encode()))
    return None if status == 200 else f"answered {status}"


def _wrong_authorization(words: str, site: Site) -> str | None:
    token = site.token
    filled = words.format(token=token, short=token[:-1], upper=token.upper() + "X", half=token[: len(token) // 2] + "0")
    answer = site.request("GET", "/api/assets", headers={"Authorization": filled}, bearer=False)
    return site.complaint(answer, {400, 401, 429, 431})


def _wrong_login(body: bytes, site: Site) -> str | None:
    answer = site.request("POST", "/api/login", body, {"Content-Type": "application/json"}, bearer=False)
    return site.complaint(answer, {400, 401, 413, 422, 429})


def _wrong_cookie(words: str, site: Site) -> str | None:
    answer = site.request("GET", "/api/assets", headers={"Cookie": words.format(token=site.token)}, bearer=False)
    return site.complaint(answer, {401, 429})


def _token_in_address(site: Site) -> str | None:
    answers = [site.request("GET", f"/api/assets?{key}={site.token}", bearer=False) for key in ("token", "access_token", "authorization")]
    return next((sentence for answer in answers if (sentence := site.complaint(answer, {401, 429}))), None)


def _every_call_needs_the_token(site: Site) -> str | None:
    calls = site.request("GET", "/api/openapi.json").document["paths"]
    open_calls = {"/healthz", "/api/login"}
    found = []
    for path, methods in calls.items():
        for method in methods:
            if path in open_calls:
                continue
            answer = site.request(method.upper(), re.sub(r"{[^}]*}", "0" * 32, path), b"{}" if method != "get" else None, bearer=False)
            if site.complaint(answer, {401, 403, 429}):
                found.append(f"{method} {path}: {answer.status}")
    return "; ".join(found) or None


def _wrong_origin(origin: str, site: Site) -> str | None:
    headers = {"Origin": origin.format(port=site.port), "Content-Type": "application/json"}
    body = json.dumps({"asset": site.asset}).encode()
    return site.complaint(site.request("POST", "/api/sessions", body, headers), {403})


def _wrong_origin_of_stream(origin: str, site: Site) -> str | None:
    lines = [
        f"GET /api/sessions/{'0' * 32}/stream HTTP/1.1", f"Host: 127.0.0.1:{site.port}", f"Origin: {origin.format(port=site.port)}",
        f"Authorization: Bearer {site.token}", "Connection: Upgrade", "Upgrade: websocket", "Sec-WebSocket-Version: 13",
        "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==",
    ]  # fmt: skip
    status = status_of(raw(site, ("\r\n".join(lines) + "\r\n\r\n").encode()))
    return None if status in (403, 400) else f"answered {status}"


def _method(method: str, path: str, site: Site) -> str | None:
    answer = site.request(method, path)
    if answer.status < 400 and method in ("OPTIONS",) and not answer.body:
        return None
    return site.complaint(answer, REFUSED | {501})


def _strange_path(path: str, site: Site) -> str | None:
    answer = site.request("GET", path)
    if site.token.encode() in answer.body or b"SQLite format" in answer.body or b"root:" in answer.body:
        return "the answer holds a file of the machine"
    return site.complaint(answer, REFUSED | {200, 304, 307})


def _many_logins(site: Site) -> str | None:
    statuses = set()
    for k in range(LOGINS):
        headers = {
            "Content-Type": "application/json",
            "X-Forwarded-For": f"198.51.{k // 250}.{k % 250}",
            "Forwarded": f"for=198.51.100.{k % 250}",
        }
        statuses.add(site.request("POST", "/api/login", b'{"token": "guess"}', headers, bearer=False).status)
    return _limited_but_open(site, statuses)


def _many_bearers(site: Site) -> str | None:
    statuses = set()
    for k in range(LOGINS):
        headers = {"Authorization": f"Bearer {k:064d}", "X-Forwarded-For": f"198.51.100.{k % 250}"}
        statuses.add(site.request("GET", "/api/assets", headers=headers, bearer=False).status)
    return _limited_but_open(site, statuses)


def _limited_but_open(site: Site, statuses: set[int]) -> str | None:
    if not statuses <= {401, 429}:
        return f"answered {sorted(statuses)}"
    if 429 not in statuses:
        return f"{LOGINS} failures met no limit"
    answer = site.request("GET", "/api/assets")
    if answer.status != 200:
        return f"the right token is answered {answer.status} after the failures of others"
    try:
        login = site.send("POST", "/api/login", {"token": site.token}, bearer=False)
    except (OSError, http.client.HTTPException) as error:
        return f"the right token cannot log in after the failures of others ({error})"
    return None if login.status == 204 else f"the right token's login is answered {login.status} after the failures of others"
