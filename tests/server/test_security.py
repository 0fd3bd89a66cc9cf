"""What a stranger, a hostile page and a rebound name get: nothing."""

import stat
from pathlib import Path

import pytest
from conftest import Service
from starlette.websockets import WebSocketDisconnect
from test_rest import is_problem

from drgs_worker.store.settings import read_settings

OURS = "http://127.0.0.1:8000"
PATHS = ["/api/jobs", "/api/assets", "/api/environments", "/api/sessions", "/api/openapi.json", "/api/docs", "/api/no-such-call"]


@pytest.mark.slow
@pytest.mark.parametrize("path", PATHS)
def test_nothing_below_api_answers_without_the_token(lasting_service: Service, path: str) -> None:
    response = lasting_service.anonymous.get(path)
    assert response.status_code == 401
    assert response.headers["content-type"] == "application/problem+json"
    assert "token" in response.json()["detail"]


@pytest.mark.parametrize("header", ["Bearer ", "Bearer nope", "Basic {token}", "{token}", "Bearer {token}x", "Bearer \u00fc"])
def test_wrong_tokens_are_refused(lasting_service: Service, header: str) -> None:
    value = header.format(token=lasting_service.token).encode("latin-1")
    assert lasting_service.anonymous.get("/api/jobs", headers={"Authorization": value}).status_code == 401


def test_a_token_in_the_address_is_not_looked_at(service: Service) -> None:
    assert service.anonymous.get(f"/api/jobs?token={service.token}").status_code == 401


@pytest.mark.slow
@pytest.mark.parametrize(
    "host",
    [
        *("evil.example", "evil.example:8000", "127.0.0.1.evil.example", "localhost.evil.example", "0.0.0.0:8000", ""),
        *(
            "localhost:",
            "localhost:evil",
            "localhost:8000:evil",
            "localhost:80 evil",
            "localhost:99999",
            "localhost:-1",
            "[::1]evil",
            "evil@localhost",
        ),
    ],
)
def test_other_host_names_are_refused(lasting_service: Service, host: str) -> None:
    for path in ("/", "/healthz", "/api/jobs"):
        assert lasting_service.client.get(path, headers={"Host": host}).status_code == 400


@pytest.mark.parametrize("name", ["Host", "Origin", "Authorization"])
def test_what_decides_who_may_ask_is_said_once(lasting_service: Service, name: str) -> None:
    said = {"Host": "127.0.0.1:8000", "Origin": OURS, "Authorization": f"Bearer {lasting_service.token}"}
    request = lasting_service.anonymous.build_request("GET", "/api/jobs", headers=said)
    assert lasting_service.anonymous.send(request).status_code == 200
    for other in (said[name], "evil.example"):
        request.headers = type(request.headers)([*said.items(), (name, other)])
        assert lasting_service.anonymous.send(request).status_code == 400


@pytest.mark.slow
@pytest.mark.parametrize("host", ["localhost", "localhost:8000", "127.0.0.1:9", "[::1]:8000", "[::1]"])
def test_our_host_names_are_answered(lasting_service: Service, host: str) -> None:
    assert lasting_service.client.get("/api/jobs", headers={"Host": host}).status_code == 200


def test_the_cookie_is_given_for_the_token_and_hidden_from_scripts(service: Service) -> None:
    assert service.anonymous.post("/api/login", json={"token": "wrong"}).status_code == 401
    response = service.anonymous.post("/api/login", json={"token": service.token})
    assert response.status_code == 204
    cookie = response.headers["set-cookie"].lower()
    assert "httponly" in cookie and "samesite=strict" in cookie and service.token not in cookie
    assert service.anonymous.get("/api/jobs").status_code == 200


def test_a_page_of_another_origin_cannot_use_the_cookie(service: Service) -> None:
    service.anonymous.post("/api/login", json={"token": service.token})
    session = service.open_session()
    for origin in ("http://evil.example", "http://127.0.0.1:9999", "http://localhost:8000", "null"):
        assert service.anonymous.post(f"/api/sessions/{session}/undo", headers={"Origin": origin}).status_code == 403
    assert service.anonymous.post(f"/api/sessions/{session}/undo").status_code == 403  # no Origin at all, and only a cookie
    assert service.anonymous.post(f"/api/sessions/{session}/undo", headers={"Origin": OURS}).status_code == 409  # let in: nothing to undo


def connects(client, session: str, headers: dict[str, str]) -> bool:
    try:
        with client.websocket_connect(f"/api/sessions/{session}/stream", headers={"Host": "127.0.0.1:8000", **headers}) as socket:
            socket.send_json({"type": "hello", "v": 1})
            return socket.receive_json()["type"] in ("status", "hello")
    except WebSocketDisconnect as refused:
        assert refused.code == 1008
        return False


def test_websockets_of_strangers_and_other_origins_are_refused_before_they_open(service: Service) -> None:
    session = service.open_session()
    assert not connects(service.anonymous, session, {})
    assert not connects(service.anonymous, session, {"Origin": OURS})
    assert not connects(service.client, session, {"Origin": "http://evil.example"})
    assert not connects(service.client, session, {"Host": "evil.example"})
    assert connects(service.client, session, {})
    cookie = {"Cookie": service.anonymous.post("/api/login", json={"token": service.token}).headers["set-cookie"].split(";")[0]}
    assert not connects(service.anonymous, session, cookie)
    assert not connects(service.anonymous, session, {"Origin": "http://127.0.0.1:9999", **cookie})
    assert connects(service.anonymous, session, {"Origin": OURS, **cookie})


def test_answers_tell_browsers_to_be_careful(service: Service) -> None:
    for path in ("/", "/api/jobs", "/api/none"):
        headers = service.client.get(path).headers
        assert headers["x-content-type-options"] == "nosniff"
        assert "frame-ancestors 'none'" in headers["content-security-policy"]
        policy = dict(part.split(" ", 1) for part in headers["content-security-policy"].split("; "))
        assert policy["script-src"] == "'self' 'wasm-unsafe-eval'" and policy["default-src"] == "'self'"
        assert "access-control-allow-origin" not in headers


def test_large_bodies_are_refused_with_a_sentence_whether_their_size_was_said_or_not(service: Service) -> None:
    large, json_type = b"x" * ((16 << 20) + 1), {"content-type": "application/json"}
    for path, content in (("/api/sessions", large), ("/api/sessions", (large[k : k + (1 << 20)] for k in range(0, len(large), 1 << 20)))):
        assert "16777216 bytes" in is_problem(service.client.post(path, content=content, headers=json_type), 413)
    assert "4096 bytes" in is_problem(service.anonymous.post("/api/login", json={"token": "x" * 5000}), 413)
    assert "16777216 bytes" in is_problem(service.client.post("/api/weights", content=large), 413)


@pytest.mark.slow
@pytest.mark.parametrize("asset", ["../../token", "..%2f..%2ftoken", "%2e%2e", "a/../../token", "/etc/passwd"])
def test_ids_are_no_paths(lasting_service: Service, asset: str) -> None:
    for name in ("", "/mesh.glb", "/thumb.jpg", "/export?format=zip"):
        assert lasting_service.client.get(f"/api/assets/{asset}{name}").status_code in (404, 405)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["../token", "..%2Ftoken", "token", ".hidden.exr", "a b.exr", "x" * 200 + ".exr"])
def test_environment_names_are_no_paths(lasting_service: Service, name: str) -> None:
    assert lasting_service.client.get(f"/api/environments/{name}").status_code == 404
    edit = {"op": "environment", "file": name}
    response = lasting_service.client.post(f"/api/sessions/{lasting_service.open_session()}/edits", json={"edit": edit})
    assert response.status_code == 422 and "No environment" in response.json()["detail"]


def test_edits_over_the_network_name_no_files(service: Service) -> None:
    edit = {"op": "deform", "vertices": "/etc/passwd"}
    response = service.client.post(f"/api/sessions/{service.open_session()}/edits", json={"edit": edit})
    assert response.status_code == 422 and "vertices" in response.json()["detail"]


def test_jobs_name_captures_only_below_allowed_roots(service: Service) -> None:
    for dataset in ("/etc", "..", str(service.context.directory.root), "~"):
        assert service.client.post("/api/jobs", json={"dataset": dataset}).status_code == 403


def test_the_data_directory_is_private(service: Service) -> None:
    root = service.context.directory.root
    assert stat.S_IMODE(root.stat().st_mode) == 0o700
    assert stat.S_IMODE((root / "token").stat().st_mode) == 0o600
    assert len(service.token) == 64


def test_health_needs_no_token_and_says_nothing(service: Service) -> None:
    response = service.anonymous.get("/healthz")
    assert response.status_code == 200 and response.json() == {"status": "ok"}


def test_without_a_built_viewer_the_page_names_the_command(service: Service) -> None:
    assert "./run setup" in service.anonymous.get("/").text


def test_a_token_from_the_settings_takes_the_place_of_the_folders_own(tmp_path: Path) -> None:
    service = Service(tmp_path, token="s3cret-" * 6)
    with service.anonymous as client:
        answers = [
            client.get("/api/jobs", headers={"Authorization": f"Bearer {token}"}).status_code for token in ("s3cret-" * 6, service.token)
        ]
    assert answers == [200, 401] and "s3cret" not in repr(service.settings)
    with pytest.raises(ValueError, match="expected 32 characters or more"):
        read_settings(token="short")


@pytest.mark.parametrize(
    ("kept", "words"),
    [("", "found 0"), ("\n", "found 0"), ("abc\n", "found 3"), ("a b" * 20, "without blanks"), ("\xe9" * 40, "without blanks")],
)
def test_a_token_file_that_is_easy_to_guess_ends_the_start(tmp_path: Path, kept: str, words: str) -> None:
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "token").write_text(kept)
    with pytest.raises(ValueError, match=f"the token in .*{words}.*; delete the file"):
        Service(tmp_path)
    (tmp_path / "data" / "token").write_bytes(b"\xff\xfe" * 40)
    with pytest.raises(ValueError, match="it is not text"):
        Service(tmp_path)
    (tmp_path / "data" / "token").unlink()
    assert len(Service(tmp_path).token) == 64
