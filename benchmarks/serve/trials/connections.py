"""What comes over a connection that is no request, or half of one, or one of very many."""

import http.client
import socket
import time
from collections.abc import Iterator
from contextlib import ExitStack
from functools import partial

from benchmarks.serve.trials.access import raw, status_of
from benchmarks.serve.trials.site import Site, Trial

HOST = b"Host: localhost\r\n"
JUNK: dict[str, bytes] = {
    "a TLS hello": b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03" + bytes(range(200)),
    "zeros": bytes(2000) + b"\r\n\r\n",
    "another protocol": b"SSH-2.0-OpenSSH_9.2\r\n\r\n",
    "no version": b"GET /healthz\r\n\r\n",
    "version 9": b"GET /healthz HTTP/9.9\r\n" + HOST + b"\r\n",
    "HTTP/2": b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n",
    "a body of no length": b"POST /api/login HTTP/1.1\r\n" + HOST + b"Content-Length: -5\r\n\r\n",
    "a length of words": b"POST /api/login HTTP/1.1\r\n" + HOST + b"Content-Length: many\r\n\r\n",
    "two lengths": b"POST /api/login HTTP/1.1\r\n" + HOST + b"Content-Length: 2\r\nContent-Length: 3\r\n\r\n{}",
    "a length and chunks": b"POST /api/login HTTP/1.1\r\n" + HOST + b"Content-Length: 2\r\nTransfer-Encoding: chunked\r\n\r\nzz\r\n",
    "a chunk of words": b"POST /api/login HTTP/1.1\r\n" + HOST + b"Transfer-Encoding: chunked\r\n\r\nzzzz\r\nabc\r\n",
    "a chunk of 2**70": b"POST /api/login HTTP/1.1\r\n" + HOST + b"Transfer-Encoding: chunked\r\n\r\n" + b"f" * 18 + b"\r\nabc\r\n",
    "an unknown encoding": b"POST /api/login HTTP/1.1\r\n" + HOST + b"Transfer-Encoding: identity, x\r\n\r\n",
    "a header with NUL": b"GET /healthz HTTP/1.1\r\n" + HOST + b"X: a\x00b\r\n\r\n",
    "a header that goes on": b"GET /healthz HTTP/1.1\r\n" + HOST + b"X: a\r\n b\r\n\r\n",
    "a header without a name": b"GET /healthz HTTP/1.1\r\n" + HOST + b": a\r\n\r\n",
    "a header with a space": b"GET /healthz HTTP/1.1\r\n" + HOST + b"X : a\r\n\r\n",
    "10 000 headers": b"GET /healthz HTTP/1.1\r\n" + HOST + b"X: a\r\n" * 10_000 + b"\r\n",
    "a path of 100 kB": b"GET /" + b"x" * 100_000 + b" HTTP/1.1\r\n" + HOST + b"\r\n",
    "a header of 1 MB": b"GET /healthz HTTP/1.1\r\n" + HOST + b"X: " + b"y" * 1_000_000 + b"\r\n\r\n",
    "a whole address": b"GET http://evil.example/healthz HTTP/1.1\r\n" + HOST + b"\r\n",
    "a tunnel": b"CONNECT evil.example:443 HTTP/1.1\r\nHost: evil.example:443\r\n\r\n",
    "a stream that is none": b"GET /healthz HTTP/1.1\r\n" + HOST + b"Connection: Upgrade\r\nUpgrade: websocket\r\n\r\n",
    "a stream of version 0": b"GET /api/sessions/x/stream HTTP/1.1\r\n" + HOST
    + b"Connection: Upgrade\r\nUpgrade: websocket\r\nSec-WebSocket-Version: 0\r\nSec-WebSocket-Key: x\r\n\r\n",
    "a body of 1 TB": b"POST /api/login HTTP/1.1\r\n" + HOST + b"Content-Length: 1000000000000\r\nConnection: close\r\n\r\n",
    "a packed body": b"POST /api/login HTTP/1.1\r\n" + HOST + b"Content-Encoding: gzip\r\nContent-Length: 2\r\n\r\n\x1f\x8b",
    "an unknown expectation": b"POST /api/login HTTP/1.1\r\n" + HOST + b"Expect: 200-maybe\r\nContent-Length: 2\r\n\r\n{}",
    "a trailer with NUL": b"POST /api/login HTTP/1.1\r\n" + HOST + b"Transfer-Encoding: chunked\r\n\r\n2\r\n{}\r\n0\r\nX: a\x00b\r\n\r\n",
    "two transfer encodings": b"POST /api/login HTTP/1.1\r\n" + HOST + b"Transfer-Encoding: chunked\r\nTransfer-Encoding: chunked\r\n\r\n0\r\n\r\n",
    "line ends alone": b"\r\n" * 5000,
    "a request in line feeds": b"GET /healthz HTTP/1.1\nHost: localhost\n\n",
}  # fmt: skip
HEADER_BYTES = 100 << 20
MOST_TAKEN = 1 << 20
"""Bytes of headers that may be taken before the answer [bytes]; what the system's buffers hold comes on top."""
IDLE = 600
HALF_SECONDS = 60.0
"""After which a request whose headers do not end is let go."""


def trials() -> Iterator[Trial]:
    for title, data in JUNK.items():
        yield Trial("connections", title, partial(_junk, data))
    yield Trial("connections", f"{IDLE} open ones without a token leave room for others", _idle)
    yield Trial("connections", "headers of 100 MB are not taken", _endless_headers)
    yield Trial("connections", f"half a request is let go within {HALF_SECONDS:.0f} s", _half_request, quick=False)
    yield Trial("connections", f"a body that does not come is let go within {HALF_SECONDS:.0f} s", _half_body, quick=False)
    yield Trial("connections", "a call after a refusal finds its connection open or closed with a word", _kept_connection)


def _junk(data: bytes, site: Site) -> str | None:
    try:
        answer = raw(site, data, seconds=5.0)
    except TimeoutError:
        answer = b""  # it waits for more, as it may for a while
    status = status_of(answer)
    if status >= 500 and status != 501 and status != 505:
        return f"answered {status}"
    return site.is_well()


def _idle(site: Site) -> str | None:
    with ExitStack() as stack:
        for _ in range(IDLE):
            try:
                stack.enter_context(socket.create_connection(("127.0.0.1", site.port), timeout=5))
            except OSError:
                break  # no more are taken, which is well as long as others are answered
        time.sleep(0.5)
        start = time.monotonic()
        if complaint := site.is_well():
            return complaint
        answer = site.request("GET", "/api/assets", seconds=20)
        seconds = time.monotonic() - start
    if answer.status != 200:
        return f"a call with the token is answered {answer.status}"
    return None if seconds < 5 else f"two calls took {seconds:.1f} s"


def _endless_headers(site: Site) -> str | None:
    sent = 0
    with socket.create_connection(("127.0.0.1", site.port), timeout=10) as connection:
        try:
            connection.sendall(b"GET /healthz HTTP/1.1\r\n" + HOST)
            line = b"X: " + b"y" * 8000 + b"\r\n"
            while sent < HEADER_BYTES:
                connection.sendall(line)
                sent += len(line)
        except OSError:
            pass
    # What lay in the buffers of both sockets was sent, but not read.
    return None if sent < 16 * MOST_TAKEN else f"{sent >> 20} MiB of headers were taken"


def _let_go(site: Site, data: bytes) -> str | None:
    with socket.create_connection(("127.0.0.1", site.port), timeout=HALF_SECONDS) as connection:
        connection.sendall(data)
        start = time.monotonic()
        try:
            while connection.recv(65536):
                pass
        except TimeoutError:
            return f"it was still open after {time.monotonic() - start:.0f} s"
        except ConnectionResetError:
            pass
    return site.is_well()


def _half_request(site: Site) -> str | None:
    return _let_go(site, b"GET /healthz HTTP/1.1\r\n" + HOST)


def _half_body(site: Site) -> str | None:
    return _let_go(site, b"POST /api/login HTTP/1.1\r\n" + HOST + b"Content-Type: application/json\r\nContent-Length: 100\r\n\r\n{")


def _kept_connection(site: Site) -> str | None:
    """Also after an error: the next call must not meet a reset."""
    connection = http.client.HTTPConnection("127.0.0.1", site.port, timeout=20)
    headers = {"Authorization": f"Bearer {site.token}", "Content-Type": "application/json"}
    calls = (
        ("GET", "/api/assets", None),
        ("POST", "/api/sessions", b"{"),
        ("GET", "/api/sessions/none", None),
        (
            "PUT",
            f"/api/sessions/{site.session()}/edits",
            b'{"edits": [{"op": "simulate", "scene": {"matter": {"law": "fluid", "density": 1e-320}}, "time": 0.1}]}',
        ),
        ("GET", "/api/environments/none.exr/thumb.jpg", None),
        ("GET", "/healthz", None),
    )
    try:
        for method, path, body in calls:
            connection.request(method, path, body, headers)
            answer = connection.getresponse()
            answer.read()
            if answer.status >= 500:
                return f"{path} is answered {answer.status}"
            # http.client opens a new connection by itself where the answer says that this one closes.
    except (OSError, http.client.HTTPException) as error:
        return f"the call {path} met {type(error).__name__}: {error}"
    finally:
        connection.close()
    return None
