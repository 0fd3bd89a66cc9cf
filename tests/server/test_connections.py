"""Connections of strangers: a real server whose callers are slow, many, endless, or do not read. Everybody else is answered."""

import json
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

import httpx
import pytest
import uvicorn
from conftest import Service

from drgs_server.run import uvicorn_config
from tests.patience import PATIENCE_SECONDS

SHORT = {"head_seconds": 0.9, "body_seconds": 1.2, "send_seconds": 0.9, "stranger_connections": 6, "connections": 4, "head_bytes": 8192}


class Listening:
    """A service on a port."""

    def __init__(self, service: Service, port: int) -> None:
        self.service = service
        self.port = port
        self.address = f"http://127.0.0.1:{port}"

    def connect(self, first: bytes = b"") -> socket.socket:
        connection = socket.create_connection(("127.0.0.1", self.port), timeout=PATIENCE_SECONDS)
        connection.sendall(first)
        return connection

    def healthy(self) -> bool:
        return httpx.get(f"{self.address}/healthz", timeout=PATIENCE_SECONDS).status_code == 200


@contextmanager
def listening(root: Path, **limits: float) -> Iterator[Listening]:
    service = Service(root, port=0, limits=SHORT | limits)
    server = uvicorn.Server(uvicorn_config(service.app, service.settings))
    thread = threading.Thread(target=server.run)
    thread.start()
    try:
        started = time.monotonic()
        while not server.started:
            assert time.monotonic() - started < PATIENCE_SECONDS
            time.sleep(0.01)
        yield Listening(service, server.servers[0].sockets[0].getsockname()[1])
    finally:
        server.should_exit = True
        thread.join(PATIENCE_SECONDS)


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Listening]:
    with listening(tmp_path_factory.mktemp("server")) as server:
        yield server


def rest(connection: socket.socket) -> bytes:
    """All that comes until the other side closes."""
    received = b""
    try:
        while piece := connection.recv(65536):
            received += piece
    except ConnectionResetError:
        pass
    return received


def answers(connection: socket.socket) -> list[int]:
    """Statuses of all answers until the other side closes."""
    return [int(part.split()[1]) for part in rest(connection).split(b"HTTP/")[1:] if part.split()[1].isdigit()]


HOST = b"Host: 127.0.0.1\r\n"


def test_a_thousand_silent_strangers_keep_nobody_out(server: Listening) -> None:
    with ExitStack() as open_ones:
        for _ in range(60):
            open_ones.enter_context(server.connect(b"GET / HT"))
        assert server.healthy()
        bearer = {"Authorization": f"Bearer {server.service.token}"}
        assert httpx.get(f"{server.address}/api/jobs", headers=bearer, timeout=PATIENCE_SECONDS).status_code == 200


@pytest.mark.parametrize(
    ("sent", "status"),
    [
        (b"", []),
        (b"\r\n\r\n", [408]),
        (b"GET /healthz HTTP/1.1\r\n" + HOST, [408]),
        (b"GET /healthz HTTP/1.1\r\n" + HOST + b"\r\nGET /he", [200, 408]),
        (b"POST /api/login HTTP/1.1\r\n" + HOST + b"content-length: 90\r\n\r\n{", [408]),
        (b"POST /api/jobs HTTP/1.1\r\n" + HOST + b"content-length: 90\r\n\r\n{", [401]),
        (b"\x16\x03\x01 not http at all\r\n\r\n", [400]),
    ],
)
def test_what_does_not_arrive_is_not_waited_for(server: Listening, sent: bytes, status: list[int]) -> None:
    begun = time.monotonic()
    with server.connect(sent) as connection:
        assert answers(connection) == status
    assert time.monotonic() - begun < 4


def test_line_ends_between_requests_keep_no_connection(server: Listening) -> None:
    with server.connect(b"GET /healthz HTTP/1.1\r\n" + HOST + b"\r\n") as connection:
        assert connection.recv(4096).startswith(b"HTTP/1.1 200")
        begun = time.monotonic()
        connection.sendall(b"\r\n")
        assert answers(connection) == [] and time.monotonic() - begun < 4  # an idle one has five seconds


def test_a_drip_of_a_body_is_cut_off_for_strangers_and_waited_for_with_the_token(server: Listening) -> None:
    body = json.dumps({"token": "x" * 40}).encode()
    head = HOST + b"content-type: application/json\r\n"
    for path, more, wanted in (
        (b"/api/login", b"", [408]),
        (b"/api/sessions", b"Authorization: Bearer " + server.service.token.encode() + b"\r\nconnection: close\r\n", [422]),
    ):
        with server.connect(b"POST " + path + b" HTTP/1.1\r\n" + head + more + b"content-length: %d\r\n\r\n" % len(body)) as connection:
            with suppress(OSError):  # cut off
                for at in range(0, len(body), 8):
                    connection.sendall(body[at : at + 8])
                    time.sleep(0.3)
            assert answers(connection) == wanted


@pytest.mark.parametrize("head", [b"X: " + b"y" * 9000 + b"\r\n\r\n", b"X: y\r\n" * 2000 + b"\r\n", b"X: " + b"y" * (1 << 20)])
def test_long_heads_are_refused(server: Listening, head: bytes) -> None:
    with server.connect() as connection:
        with suppress(OSError):  # refused before all was sent
            connection.sendall(b"GET /healthz HTTP/1.1\r\n" + HOST + head)
        assert answers(connection) in ([431], [])  # a reset may overtake the answer
    assert server.healthy()


def test_a_login_has_a_small_body(server: Listening) -> None:
    answer = httpx.post(f"{server.address}/api/login", json={"token": "x" * 5000}, timeout=PATIENCE_SECONDS)
    assert answer.status_code == 413


def test_callers_with_the_token_have_a_number_of_connections_and_health_one_more(server: Listening) -> None:
    head = b"GET /api/jobs HTTP/1.1\r\n" + HOST + b"Authorization: Bearer " + server.service.token.encode() + b"\r\n\r\n"
    with ExitStack() as open_ones:
        statuses = []
        for _ in range(6):
            connection = open_ones.enter_context(server.connect(head))
            statuses.append(int(connection.recv(64).split()[1]))
        assert statuses == [200] * 4 + [503] * 2
        assert server.healthy()


UPGRADE = (
    HOST + b"Connection: Upgrade\r\nUpgrade: websocket\r\nSec-WebSocket-Version: 13\r\nSec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n"
)


def test_streams_of_strangers_are_closed_at_once_and_those_of_others_are_numbered(server: Listening) -> None:
    path = b"GET /api/sessions/" + b"0" * 32 + b"/stream HTTP/1.1\r\n"
    with server.connect(path + UPGRADE + b"\r\n") as connection:
        assert answers(connection) == [403]
    bearer = b"Authorization: Bearer " + server.service.token.encode() + b"\r\n\r\n"
    with ExitStack() as open_ones:
        statuses = []
        for _ in range(6):
            connection = open_ones.enter_context(server.connect(path + UPGRADE + bearer))
            statuses.append(int(connection.recv(64).split()[1]))
        assert statuses == [101] * 4 + [403] * 2  # nobody has said hello yet
        assert server.healthy()


def test_a_stream_outlives_the_clocks_of_requests(tmp_path: Path) -> None:
    with listening(tmp_path) as server:
        bearer = b"Authorization: Bearer " + server.service.token.encode() + b"\r\n\r\n"
        with server.connect(b"GET /api/sessions/" + b"0" * 32 + b"/stream HTTP/1.1\r\n" + UPGRADE + bearer) as connection:
            assert connection.recv(4096).startswith(b"HTTP/1.1 101")
            connection.settimeout(3 * SHORT["head_seconds"])
            with pytest.raises(TimeoutError):
                connection.recv(1)  # nothing comes before a hello, not even an end


@pytest.mark.slow
def test_a_caller_that_does_not_read_is_let_go(tmp_path: Path) -> None:
    with listening(tmp_path) as server:
        asset = server.service.add_asset()
        with (server.service.context.directory.asset(asset) / "mesh.glb").open("wb") as file:
            file.truncate(64 << 20)
        head = f"GET /api/assets/{asset}/mesh.glb HTTP/1.1\r\nHost: localhost\r\nAuthorization: Bearer {server.service.token}\r\n\r\n"
        with server.connect(head.encode()) as connection:
            connection.recv(16)
            time.sleep(3.0)
            assert len(rest(connection)) < 64 << 20
        assert server.healthy()
