"""What the service says when something goes wrong: short, without its own folders, and on a connection that stays open."""

import copy
import errno
import gzip
import http.client
import json
import os
import socket
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import product

import pytest
import uvicorn
from conftest import Service
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from drgs_server.render.interface import AbstractPose
from drgs_server.run import uvicorn_config
from tests.patience import PATIENCE_SECONDS

MOST = 700
"""Characters of a sentence."""
ODD_TEXTS = ("\0", "\ud800", "a\0b", "~nobody-of-this-name/x", "x" * 400)


@contextmanager
def served(service: Service) -> Iterator[int]:
    """The app behind a real uvicorn; gives its port."""
    listener = socket.create_server(("127.0.0.1", 0))
    server = uvicorn.Server(uvicorn_config(service.app, service.settings))
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]}, daemon=True)
    thread.start()
    while not server.started:
        time.sleep(0.01)
    try:
        yield listener.getsockname()[1]
    finally:
        server.should_exit = True
        thread.join(PATIENCE_SECONDS)


def test_the_connection_outlives_an_error_of_the_server(tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:
    service = Service(tmp_path)

    def fail() -> None:
        raise KeyError("nobody foresaw this")

    monkeypatch.setattr(service.context.environments, "all", fail)
    with served(service) as port:
        connection = http.client.HTTPConnection("127.0.0.1", port, timeout=PATIENCE_SECONDS)
        connection.connect()
        first = connection.sock
        for path, status in (("/api/environments", 500), ("/healthz", 200), ("/api/environments", 500), ("/api/assets", 200)):
            connection.request("GET", path, headers={"Authorization": f"Bearer {service.token}"})
            answer = connection.getresponse()
            body = answer.read()
            assert answer.status == status, body
            assert answer.getheader("connection") != "close" and connection.sock is first
            if status == 500:
                assert answer.getheader("content-type") == "application/problem+json" and b"nobody foresaw" not in body
        connection.close()


@pytest.mark.parametrize("body", [{"edit": {"op": "x" * 1_000_000}}, {"edit": {"op": "material", "y" * 1_000_000: 1}}])
def test_what_was_sent_is_not_sent_back_whole(body: dict, lasting_service: Service) -> None:
    session = lasting_service.open_session()
    response = lasting_service.client.post(f"/api/sessions/{session}/edits", json=body)
    assert response.status_code == 422 and len(response.json()["detail"]) < MOST
    with lasting_service.client.websocket_connect(f"ws://127.0.0.1:8000/api/sessions/{session}/stream") as stream:
        stream.send_json({"type": "hello", "v": 1})
        while stream.receive_json()["type"] != "hello":
            pass
        stream.send_json({"type": "edit", "id": 1, **body})
        while (answer := stream.receive_json())["type"] != "error":
            pass
        assert len(answer["message"]) < MOST


def test_sentences_name_files_by_their_place_in_the_data_folder(service: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    session = service.open_session()
    root = service.context.directory.root

    def fail(*_: object) -> AbstractPose:
        raise ValueError(f"{root}/environments/clips/b/clip.json: does not exist, nor does {root}")

    from painter import PaintedAsset

    monkeypatch.setattr(PaintedAsset, "pose", fail)
    response = service.client.get(f"/api/sessions/{session}/frame.jpg")
    assert response.status_code == 422
    assert response.json()["detail"] == "environments/clips/b/clip.json: does not exist, nor does the data folder."


@pytest.mark.parametrize("error", [OverflowError("too large"), ZeroDivisionError("division by zero"), FloatingPointError("inf")])
def test_numbers_that_cannot_be_computed_with_are_the_callers_mistake(
    error: ArithmeticError, service: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    session = service.open_session()

    def fail(*_: object) -> AbstractPose:
        raise error

    from painter import PaintedAsset

    monkeypatch.setattr(PaintedAsset, "pose", fail)
    response = service.client.get(f"/api/sessions/{session}/frame.jpg")
    assert response.status_code == 422 and str(error) in response.json()["detail"]


def texts(document: object, way: tuple = ()) -> Iterator[tuple]:
    """Ways to all strings in a document."""
    if isinstance(document, dict | list):
        for key, inner in document.items() if isinstance(document, dict) else enumerate(document):
            yield from texts(inner, (*way, key))
    elif isinstance(document, str):
        yield way


@pytest.mark.parametrize(
    ("method", "path", "body"),
    [
        ("POST", "/api/sessions", {"asset": "0"}),
        ("POST", "/api/login", {"token": "x"}),
        ("POST", "/api/jobs", {"kind": "build", "dataset": "x", "name": "n", "preset": "fast"}),
        ("POST", "/api/jobs", {"kind": "export", "asset": "0", "formats": ["glb"]}),
        ("POST", "/api/jobs", {"kind": "simulate", "asset": "0", "scene": {"matter": {"preset": "jelly"}}}),
        ("POST", "/api/jobs", {"kind": "redecouple", "asset": "0", "preset": "full"}),
        ("POST", "/api/jobs", {"kind": "render", "asset": "0", "environments": ["own"], "variants": [{"name": "a", "edits": []}]}),
        ("POST", "{session}/save", {"name": "x"}),
        ("POST", "{session}/edits", {"edit": {"op": "environment", "file": "studio.exr"}}),
        ("POST", "{session}/edits", {"edit": {"op": "pose", "clip": "x", "time": 0}}),
        ("PUT", "{session}/edits", {"edits": [{"op": "material", "select": {"weights_file": "x"}, "set": {"roughness": 1}}]}),
    ],
)
def test_no_string_of_a_body_is_too_odd_for_a_sentence(lasting_service: Service, method: str, path: str, body: dict) -> None:
    address = path.format(session=f"/api/sessions/{lasting_service.open_session()}")
    for bad, way in product(ODD_TEXTS, texts(body)):
        changed = copy.deepcopy(body)
        node = changed
        for key in way[:-1]:
            node = node[key]
        node[way[-1]] = bad
        answer = lasting_service.client.request(method, address, content=json.dumps(changed), headers={"Content-Type": "application/json"})
        assert answer.status_code in (201, 401, 403, 404, 422), (bad, way, answer.text)
        assert answer.status_code == 201 or answer.json()["detail"].endswith((".", "?", "!"))


@pytest.mark.parametrize(
    "path", ["/api/assets?search=%00", "/api/assets/%00", "/api/sessions/a%00b", "/api/jobs/%00/log", "/api/weights/%00", "/%00"]
)
def test_an_address_with_nul_is_none(lasting_service: Service, path: str) -> None:
    """Postgres raises at such text, and SQLite takes what stands before it: a search for it found everything."""
    assert lasting_service.client.get(path).status_code == 400


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EROFS, errno.EACCES, errno.EIO, errno.EMFILE])
def test_trouble_of_the_disk_is_told_and_passes(
    lasting_service: Service, monkeypatch: pytest.MonkeyPatch, number: int, caplog: pytest.LogCaptureFixture
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise OSError(number, os.strerror(number), "/srv/secret/place")

    monkeypatch.setattr(tempfile, "mkdtemp", fail)
    answers = [
        lasting_service.client.post("/api/weights", content=bytes(4)),
        lasting_service.client.post("/api/assets", files={"file": ("a.obj", b"v")}),
        lasting_service.client.post("/api/environments", files={"file": ("a.exr", b"v")}),
        lasting_service.client.get(f"/api/sessions/{lasting_service.open_session()}/export?format=ply"),
    ]
    for answer in answers:
        assert answer.status_code == 503 and "retry-after" in answer.headers, answer.text
        assert "nothing was changed" in answer.json()["detail"] and "secret" not in answer.text
    assert "Traceback" not in caplog.text


def test_a_packed_body_is_not_taken_for_what_it_says(service: Service) -> None:
    session = service.open_session()
    edit = gzip.compress(json.dumps({"edit": {"op": "environment"}}).encode())
    for path, content in ((f"/api/sessions/{session}/edits", edit), ("/api/weights", bytes(8)), ("/api/login", b"{}")):
        answer = service.client.post(path, content=content, headers={"Content-Encoding": "gzip", "Content-Type": "application/json"})
        assert answer.status_code == 415 and "Content-Encoding" in answer.json()["detail"]
    plain = service.client.post("/api/weights", content=bytes(8), headers={"Content-Encoding": "identity"})
    assert plain.status_code == 201


def test_bytes_that_are_no_text_end_a_stream_without_a_stack(tmp_path, caplog: pytest.LogCaptureFixture) -> None:
    service = Service(tmp_path)
    session = service.open_session()
    with served(service) as port:
        address = f"ws://127.0.0.1:{port}/api/sessions/{session}/stream"
        with connect(address, additional_headers={"Authorization": f"Bearer {service.token}"}) as stream:
            stream.send(b"\xff\xfe", text=True)
            with pytest.raises(ConnectionClosed):
                stream.recv(timeout=PATIENCE_SECONDS)
            assert stream.protocol.close_code == 1007
        with connect(address, additional_headers={"Authorization": f"Bearer {service.token}"}) as stream:
            stream.send(b"\xff\xfe", text=True)  # and the close right behind it, so that both arrive at once
        assert service.client.get("/healthz").status_code == 200
    assert "no text" in caplog.text and "Traceback" not in caplog.text
