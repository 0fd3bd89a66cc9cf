"""What the service says when something goes wrong: short, without its own folders, and on a connection that stays open."""

import http.client
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
import uvicorn
from conftest import Service

from drgs_server.render.interface import AbstractPose
from drgs_server.run import uvicorn_config
from tests.patience import PATIENCE_SECONDS

MOST = 700
"""Characters of a sentence."""


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
def test_what_was_sent_is_not_sent_back_whole(body: dict, service: Service) -> None:
    session = service.open_session()
    response = service.client.post(f"/api/sessions/{session}/edits", json=body)
    assert response.status_code == 422 and len(response.json()["detail"]) < MOST
    with service.client.websocket_connect(f"ws://127.0.0.1:8000/api/sessions/{session}/stream") as stream:
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
