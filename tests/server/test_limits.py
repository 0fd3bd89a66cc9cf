"""Rates, metrics and settings: what an operator turns and reads."""

import asyncio
import json
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import Service

from drgs.convert.import_mesh import import_mesh
from drgs.exchange.exr import encode_environment
from drgs.scene.asset import save_asset
from drgs_server.api.door.rate_limit import BURST_SECONDS, CallBuckets, RateLimit
from drgs_server.api.metrics import Metrics
from drgs_server.render.drgs_renderer import DrgsRenderer
from drgs_server.run import uvicorn_config
from drgs_worker.store.settings import CONFIG_VARIABLE, Limits, ServiceSettings, read_settings
from tests.web.browser import write_ball


def statuses(limit: RateLimit, address: str, count: int, path: str = "/api/jobs") -> list[int]:
    found: list[int] = []

    async def send(message: dict) -> None:
        if message["type"] == "http.response.start":
            found.append(message["status"])

    async def receive() -> dict:
        return {"type": "http.request", "body": b""}

    async def run() -> None:
        for _ in range(count):
            await limit({"type": "http", "path": path, "client": (address, 1), "method": "GET", "headers": []}, receive, send)  # type: ignore[arg-type]

    asyncio.run(run())
    return found


def test_a_caller_beyond_the_rate_waits_and_others_do_not() -> None:
    time = 0.0

    async def app(scope, receive, send) -> None:
        await send({"type": "http.response.start", "status": 200, "headers": []})

    limit = RateLimit(app, 2.0, lambda: time)
    burst = int(2 * BURST_SECONDS)
    assert statuses(limit, "a", burst + 3) == [200] * burst + [429] * 3
    assert statuses(limit, "b", 1) == [200]
    assert statuses(limit, "a", 1, "/index.html") == [200]
    time = 1.0
    assert statuses(limit, "a", 3) == [200, 200, 429]


def status_through(app: Any, peer: str, forwarded_for: str | None, token: str) -> int:
    """Of one call that comes from the address `peer`."""
    found: list[int] = []
    headers = [(b"host", b"localhost:8000"), (b"authorization", f"Bearer {token}".encode())]
    headers += [(b"x-forwarded-for", forwarded_for.encode())] if forwarded_for else []
    scope = {"type": "http", "method": "GET", "path": "/api/environments", "query_string": b"", "headers": headers, "client": (peer, 5)}

    async def send(message: dict) -> None:
        if message["type"] == "http.response.start":
            found.append(message["status"])

    async def receive() -> dict:
        return {"type": "http.request", "body": b""}

    asyncio.run(app({**scope, "http_version": "1.1", "scheme": "http", "root_path": ""}, receive, send))
    return found[0]


def test_users_behind_a_proxy_have_a_rate_each_and_nobody_else_may_say_who_they_are(tmp_path: Path) -> None:
    service = Service(tmp_path, trusted_proxies=["10.0.0.2"], limits={"requests_a_second": 0.1})  # one request, then none for 10 s
    config = uvicorn_config(service.app, service.settings)
    config.load()
    calls = [
        ("10.0.0.2", "198.51.100.1", 200),
        ("10.0.0.2", "198.51.100.2", 200),
        ("10.0.0.2", "198.51.100.1", 429),
        ("10.0.0.2", "198.51.100.3, 198.51.100.2", 429),  # the caller wrote the first itself; the proxy added the second
        ("10.0.0.9", "198.51.100.4", 200),
        ("10.0.0.9", "198.51.100.5", 429),  # no proxy of ours: its word counts for nothing
        ("10.0.0.9", None, 429),
    ]
    assert [status_through(config.loaded_app, peer, said, service.token) for peer, said, _ in calls] == [status for *_, status in calls]


def test_without_a_named_proxy_no_caller_is_believed(tmp_path: Path) -> None:
    service = Service(tmp_path, limits={"requests_a_second": 0.1})
    config = uvicorn_config(service.app, service.settings)
    config.load()
    assert [status_through(config.loaded_app, "127.0.0.1", f"198.51.100.{k}", service.token) for k in range(2)] == [200, 429]


def test_wrong_tokens_have_a_limit_of_their_own_that_takes_nothing_from_the_right_one(tmp_path: Path) -> None:
    service = Service(tmp_path, limits={"failures_a_second": 0.3, "requests_a_second": 0.5})  # bursts of 3 and 5

    def login(token: str) -> int:
        return service.anonymous.post("/api/login", json={"token": token}).status_code

    wrong = {"Authorization": "Bearer " + "x" * 64}
    assert [service.anonymous.get("/api/jobs", headers=wrong).status_code for _ in range(2)] == [401, 401]
    assert [login("wrong") for _ in range(3)] == [401, 429, 429]
    refused = service.anonymous.get("/api/jobs", headers=wrong)
    assert refused.status_code == 429 and refused.headers["retry-after"] == "1" and "refused requests" in refused.json()["detail"]
    assert service.anonymous.get("/healthz").status_code == 200
    assert [login(service.token) for _ in range(6)] == [204] * 5 + [429]


def test_wrong_tokens_through_a_proxy_count_for_the_proxy_whoever_it_names(tmp_path: Path) -> None:
    service = Service(tmp_path, trusted_proxies=["10.0.0.2"], limits={"failures_a_second": 0.2})
    config = uvicorn_config(service.app, service.settings)
    config.load()
    wrong = [status_through(config.loaded_app, "10.0.0.2", f"198.51.100.{k}", "x" * 64) for k in range(4)]
    assert wrong == [401, 401, 429, 429]
    assert status_through(config.loaded_app, "10.0.0.2", "198.51.100.1", service.token) == 200
    assert status_through(config.loaded_app, "10.0.0.3", None, "x" * 64) == 401


def test_all_addresses_of_one_network_are_one_caller() -> None:
    buckets = CallBuckets(0.1, lambda: 0.0)
    calls = ("2001:db8::1", "2001:db8::2", "2001:db8:0:1::1", "::ffff:192.0.2.1", "192.0.2.1", "anything", "anything")
    assert [buckets.take(address) for address in calls] == [True, False, True, True, False, True, False]


def test_metrics_count_requests_edits_and_what_is_live(service: Service) -> None:
    url = f"/api/sessions/{service.open_session()}"
    for _ in range(2):
        service.client.post(f"{url}/edits", json={"edit": {"op": "material", "select": {"all": True}, "set": {"roughness": 0.5}}})
    service.client.get("/api/assets/none")
    text = service.client.get("/metrics").text
    lines = dict(line.rsplit(" ", 1) for line in text.splitlines() if not line.startswith("#"))
    assert lines['drgs_edits_total{kind="edit"}'] == "2.0"
    assert lines['drgs_requests_total{method="POST",route="/api/sessions/{session_id}/edits",status="200"}'] == "2.0"
    assert lines['drgs_requests_total{method="GET",route="/api/assets/{asset_id}",status="404"}'] == "1.0"
    assert lines["drgs_sessions_live"] == "1.0" and lines["drgs_assets_loaded"] == "1.0"
    assert lines['drgs_request_seconds_bucket{kind="call",le="+Inf"}'] == lines['drgs_request_seconds_count{kind="call"}']
    assert service.anonymous.get("/metrics").status_code == 401


def test_metrics_are_exact_however_large_they_become(service: Service) -> None:
    service.context.metrics.frame_bytes.inc(1_234_567_891)
    service.context.metrics.frame_bytes.inc(1)
    (line,) = [line for line in service.client.get("/metrics").text.splitlines() if line.startswith("drgs_frame_bytes_total ")]
    assert float(line.rsplit(" ", 1)[1]) == 1_234_567_892


def test_buckets_are_listed_from_the_smallest_to_the_largest(service: Service) -> None:
    service.client.get("/healthz")
    answer = service.client.get("/metrics")
    bounds = re.findall(r'drgs_request_seconds_bucket\{kind="call",le="([^"]+)"', answer.text)
    assert len(bounds) == 11 and bounds[-1] == "+Inf"
    assert [float(bound) for bound in bounds] == sorted(map(float, bounds))
    assert answer.headers["content-type"].startswith("text/plain; version=0.0.4")


def test_a_label_cannot_end_its_quotes() -> None:
    metrics = Metrics()
    metrics.edits.labels(kind='a"b\\').inc()
    assert rb'{kind="a\"b\\"} 1.0' in metrics.text({})


def test_settings_come_from_arguments_then_environment_then_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "drgs.toml"
    file.write_text('port = 1\nhost_names = ["a"]\ndevice = "cpu"\n[limits]\nviewers = 3\nsessions = 4\n')
    monkeypatch.setenv(CONFIG_VARIABLE, str(file))
    monkeypatch.setenv("DRGS_PORT", "2")
    monkeypatch.setenv("DRGS_LIMITS__VIEWERS", "5")
    monkeypatch.setenv("DRGS_THREADS", "1")  # of another part of drgs
    settings = read_settings(host_names=("b",), data=None)
    assert (settings.port, settings.host_names, settings.device, settings.data) == (2, ("b",), "cpu", Path("data"))
    assert (settings.limits.viewers, settings.limits.sessions, settings.limits.snapshots) == (5, 4, 200)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("prot = 1", "prot"),
        ("port = -1", "port"),
        ('database_url = "mysql://x"', "expected postgresql"),
        ("[limits]\nviewers = 0", "limits.viewers"),
        ('trusted_proxies = ["proxy.example.org"]', r"trusted_proxies: .*10\.0\.0\.2.*found 'proxy\.example\.org'"),
    ],
)
def test_a_wrong_setting_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str, words: str) -> None:
    file = tmp_path / "drgs.toml"
    file.write_text(text)
    monkeypatch.setenv(CONFIG_VARIABLE, str(file))
    with pytest.raises(ValueError, match=words):
        read_settings()


def test_a_public_address_needs_a_proxy_that_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ValueError, match="this machine only"):
        read_settings(host="0.0.0.0")
    assert read_settings(host="0.0.0.0", behind_proxy=True).host == "0.0.0.0"
    monkeypatch.setenv(CONFIG_VARIABLE, "/no/such/file")
    with pytest.raises(ValueError, match="no such file"):
        read_settings()


def test_unused_assets_leave_memory_beyond_the_budget_and_come_back(tmp_path: Path) -> None:
    service = Service(tmp_path, limits={"loaded_assets": 2, "loaded_bytes": 1 << 30})
    with service.client:
        urls = []
        for letter in "abc":
            asset = service.add_asset(letter * 32, letter)
            urls.append(f"/api/sessions/{service.client.post('/api/sessions', json={'asset': asset}).json()['id']}")
        for url in (*urls, urls[0]):
            assert service.client.get(f"{url}/frame.png?width=16&height=16&spp=4").status_code == 200
            assert service.context.sessions.loaded_count() <= 2
        assert service.painter.loads == 4  # the first one again
    assert ServiceSettings(limits={"loaded_bytes": 5}).limits.loaded_bytes == 5  # type: ignore[arg-type]


@pytest.mark.slow
def test_frames_of_simulations_count_as_loaded_and_leave_memory_for_newer_ones(tmp_path: Path) -> None:
    service = Service(tmp_path, DrgsRenderer("cpu"), limits={"loaded_bytes": 1 << 19})  # type: ignore[arg-type]
    with service.client:
        asset = service.add_asset()
        write_ball(tmp_path / "ball.ply")
        shutil.rmtree(service.context.directory.asset(asset))
        save_asset(import_mesh(tmp_path / "ball.ply"), service.context.directory.asset(asset))
        session, sessions = service.client.post("/api/sessions", json={"asset": asset}).json()["id"], service.context.sessions
        vertices, used = json.loads((service.context.directory.asset(asset) / "asset.json").read_text())["counts"]["vertices"], []
        for seed in range(4):
            scene = {"particles": 500, "seed": seed, "duration": 1.0}
            edit = {"op": "simulate", "scene": scene, "time": 10 / 24}
            answer = service.client.post(f"/api/sessions/{session}/edits", json={"edit": edit})
            assert answer.status_code == 200, answer.text
            used.append(sessions.loaded_bytes())
        # Ten frames of positions and normals; where they sleep, fewer.
        assert used[1] - used[0] == 10 * vertices * 2 * 3 * 4
        assert max(used) <= 1 << 19


@pytest.mark.slow
def test_environments_count_as_loaded_and_leave_memory_with_the_poses_that_they_light(tmp_path: Path) -> None:
    """The ball's own renderer: each session shows the same asset under an environment of 400 kB."""
    service = Service(tmp_path, DrgsRenderer("cpu"), limits={"loaded_bytes": 1 << 20})  # type: ignore[arg-type]
    with service.client:
        asset = service.add_asset()
        write_ball(tmp_path / "ball.ply")
        shutil.rmtree(service.context.directory.asset(asset))
        save_asset(import_mesh(tmp_path / "ball.ply"), service.context.directory.asset(asset))
        used = []
        kept = sum(path.stat().st_size for path in service.context.directory.asset(asset).rglob("*") if path.is_file())
        for k in range(5):
            light = np.full((128, 256, 3), 0.1 * k, np.float32)
            (service.context.directory.environments / f"light{k}.exr").write_bytes(encode_environment(light))
            session = service.client.post("/api/sessions", json={"asset": asset}).json()["id"]
            edit = {"op": "environment", "file": f"light{k}.exr"}
            assert service.client.post(f"/api/sessions/{session}/edits", json={"edit": edit}).status_code == 200
            used.append(service.context.sessions.loaded_bytes())
        assert used[1] - used[0] == 128 * 256 * 3 * 4 + kept, "each is counted, and its pose as much as the asset"
        assert max(used) <= 1 << 20
        assert service.client.get(f"/api/sessions/{session}/frame.png?width=16&height=16&spp=4").status_code == 200


def test_every_limit_is_named_in_the_page_on_security() -> None:
    page = (Path(__file__).parents[2] / "SECURITY.md").read_text()
    table = page[page.index("## What is limited") :]
    assert [name for name in Limits.model_fields if f"`{name}`" not in table] == []
