"""Nonsense by the thousand: requests drawn from the OpenAPI document, and messages of the stream. Nothing ends in a 5xx or a silent server."""

import json
import string
from typing import Any

import pytest
from conftest import Service
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from pydantic import TypeAdapter
from starlette.websockets import WebSocketDisconnect
from test_stream import Talk, camera, material

from drgs_server.api.routes.uploads import PART_TYPE
from drgs_server.live.messages import ClientMessage

QUIET = settings(
    deadline=None,
    database=None,
    derandomize=True,
    phases=[Phase.generate],
    suppress_health_check=list(HealthCheck),
)
REQUESTS_AN_OPERATION = 9
DOWNLOADS = ("/export", "/save", "/healthz")
"""Exports and saves start a process; test_versions and test_service do that."""


def part(value: Any) -> Any:
    """Of a multipart body; numbers and the like as text, which the client does not do by itself."""
    if isinstance(value, tuple):
        return (value[0], part(value[1]), *value[2:])
    return value if isinstance(value, bytes | str) else json.dumps(value)


def send(service: Service, case: Any) -> Any:
    """A case of schemathesis through the test client."""
    given = case.as_transport_kwargs(base_url="http://127.0.0.1:8000")
    wanted = {key: given[key] for key in ("params", "json", "data", "files", "headers") if given.get(key) is not None}
    if isinstance(wanted.get("data"), bytes | str):
        wanted["content"] = wanted.pop("data")
    if "files" in wanted:
        wanted["files"] = [(str(name), part(value)) for name, value in wanted["files"]]
    return service.client.request(given["method"], given["url"], **wanted)


@pytest.mark.slow
def test_no_request_that_the_openapi_document_allows_ends_in_a_server_error(service: Service) -> None:
    # Here, and not above: it takes as long to import as all of the service, and processes that share the tests import every file.
    schemathesis = pytest.importorskip("schemathesis", reason="needs the package schemathesis: pip install -e '.[dev]'")
    schemathesis.serializer.alias(PART_TYPE, "application/octet-stream")
    document = json.loads(json.dumps(service.app.openapi()))
    schema = schemathesis.openapi.from_dict(document)
    session = service.open_session()
    known = {"session_id": session, "asset_id": "a" * 32}
    seen: dict[int, int] = {}
    for result in schema.get_all_operations():
        operation = result.ok()
        if operation.path.endswith(DOWNLOADS):
            continue

        @settings(QUIET, max_examples=REQUESTS_AN_OPERATION)
        @given(case=operation.as_strategy(), real=st.integers(0, 4))
        def ask(case: Any, real: int) -> None:
            if real and case.path_parameters and case.method != "DELETE":
                case.path_parameters.update({name: known[name] for name in case.path_parameters if name in known})
            if case.query and "width" in case.query:
                case.query.update({"width": 16, "height": 16, "spp": 4})
            try:
                response = send(service, case)
            except (UnicodeEncodeError, ValueError) as error:  # the client itself will not send such a header
                assert "header" in str(error).lower() or "encode" in str(error), error
                return
            seen[response.status_code] = seen.get(response.status_code, 0) + 1
            assert response.status_code < 500, f"{case.method} {case.formatted_path} {case.body!r}: {response.text}"
            if response.status_code >= 400:
                assert response.headers["content-type"] == "application/problem+json", (case.formatted_path, response.text)
                if case.method.upper() != "HEAD":  # whose answers have no body
                    assert " " in response.json()["detail"]

        ask()
    assert sum(seen.values()) > 300 and seen.get(200, 0) > 80 and seen.get(422, 0) > 10, seen


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=20),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(string.ascii_lowercase, max_size=8), inner, max_size=4),
    max_leaves=12,
)
KINDS = ["hello", "camera", "edit", "undo", "redo", "ack", "settings", "visibility", "pick", "launch"]
GOOD = [
    camera(1, x=0.5),
    {"type": "edit", "id": 1, "edit": material(0.5)},
    {"type": "undo", "id": 2},
    {"type": "pick", "id": 3, "x": 0.2, "y": 0.3},
    {"type": "settings", "settings": {"exposure_stops": 1.0}},
]


@st.composite
def messages(draw: st.DrawFn) -> str | bytes:
    """Bytes, text, JSON, messages of a known type with wrong fields, and good ones with one value replaced."""
    way = draw(st.integers(0, 4))
    if way == 0:
        return draw(st.binary(max_size=40))
    if way == 1:
        return draw(st.text(max_size=40))
    if way == 2:
        return json.dumps(draw(JSON))
    if way == 3:
        return json.dumps(
            {"type": draw(st.sampled_from(KINDS))} | draw(st.dictionaries(st.sampled_from(["id", "v", "edit", "x", "y"]), JSON))
        )
    message = dict(draw(st.sampled_from(GOOD)))
    message[draw(st.sampled_from(sorted(message)))] = draw(JSON)
    return json.dumps(message)


@pytest.mark.slow
def test_a_server_that_was_sent_nonsense_still_answers(service: Service) -> None:
    session = service.open_session()

    @settings(QUIET, max_examples=40)
    @given(st.lists(messages(), min_size=1, max_size=12))
    def speak(said: list[str | bytes]) -> None:
        with service.client.websocket_connect(f"/api/sessions/{session}/stream", headers={"Host": "127.0.0.1:8000"}) as socket:
            conversation = Talk(socket)
            conversation.send(type="hello", v=1)
            for message in said:
                socket.send({"type": "websocket.receive", "bytes" if isinstance(message, bytes) else "text": message})
            # Answered after all that came before: an id that none of them has.
            conversation.send(type="pick", id=4_000_000_000, x=0.5, y=0.5)
            conversation.until(lambda found: isinstance(found, dict) and found.get("id") == 4_000_000_000)

    speak()
    assert service.client.get(f"/api/sessions/{session}").status_code == 200


@pytest.mark.slow
@settings(QUIET, max_examples=15)
@given(said=st.lists(messages(), min_size=1, max_size=1))
def test_a_first_message_that_is_no_hello_is_refused_with_a_sentence(said: list[str | bytes]) -> None:
    adapter = TypeAdapter(ClientMessage)
    first = said[0]
    try:
        parsed = adapter.validate_json(first)
    except ValueError:
        parsed = None
    if parsed is not None and parsed.type == "hello":
        return
    with first_service().client.websocket_connect(f"/api/sessions/{'0' * 32}/stream", headers={"Host": "127.0.0.1:8000"}) as socket:
        socket.send({"type": "websocket.receive", "bytes" if isinstance(first, bytes) else "text": first})
        error = socket.receive_json()
        assert error["type"] == "error" and error["fatal"] and " " in error["message"]
        with pytest.raises(WebSocketDisconnect):
            socket.receive_json()


_services: list[Service] = []


def first_service() -> Service:
    return _services[0]


@pytest.fixture(autouse=True)
def _share(service: Service) -> None:
    _services[:] = [service]
