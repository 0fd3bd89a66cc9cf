"""Rates, metrics and settings: what an operator turns and reads."""

import asyncio
from pathlib import Path

import pytest
from conftest import Service

from server.metrics import Metrics
from server.rate_limit import BURST_SECONDS, RateLimit
from worker.settings import CONFIG_VARIABLE, ServiceSettings, read_settings


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


def test_metrics_count_requests_edits_and_what_is_live(service: Service) -> None:
    url = f"/api/sessions/{service.open_session()}"
    for _ in range(2):
        service.client.post(f"{url}/edits", json={"edit": {"op": "material", "select": {"all": True}, "set": {"roughness": 0.5}}})
    service.client.get("/api/assets/none")
    text = service.client.get("/metrics").text
    lines = dict(line.rsplit(" ", 1) for line in text.splitlines() if not line.startswith("#"))
    assert lines['drgs_edits_total{kind="edit"}'] == "2"
    assert lines['drgs_requests_total{method="POST",route="/api/sessions/{session_id}/edits",status="200"}'] == "2"
    assert lines['drgs_requests_total{method="GET",route="/api/assets/{asset_id}",status="404"}'] == "1"
    assert lines["drgs_sessions_live"] == "1" and lines["drgs_assets_loaded"] == "1"
    assert lines['drgs_request_seconds_bucket{kind="call",le="+Inf"}'] == lines['drgs_request_seconds_count{kind="call"}']
    assert service.anonymous.get("/metrics").status_code == 401


def test_a_label_cannot_end_its_quotes() -> None:
    metrics = Metrics()
    metrics.add("drgs_edits_total", kind='a"b\\')
    assert r'{kind="a\"b\\"} 1' in metrics.text({})


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
