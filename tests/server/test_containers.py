"""The container files, checked as far as that goes without an engine: what they name exists, and settings are spelt right."""

import json
import re
from pathlib import Path

import pytest
import yaml
from typer.testing import CliRunner

from drgs.cli import app
from worker.artifact_store import open_artifact_store
from worker.settings import ServiceSettings, read_settings

DOCKER = Path(__file__).parents[2] / "docker"
KNOWN_INSTRUCTIONS = {"FROM", "WORKDIR", "COPY", "RUN", "USER", "VOLUME", "ENTRYPOINT", "CMD", "ENV", "EXPOSE", "ARG"}


@pytest.mark.parametrize("name", ["Dockerfile", "Dockerfile.cuda"])
def test_an_image_is_built_by_the_same_command_as_elsewhere_and_does_not_run_as_root(name: str) -> None:
    lines = [line for line in (DOCKER / name).read_text().splitlines() if line and not line.startswith("#")]
    assert all(line.split()[0] in KNOWN_INSTRUCTIONS for line in lines)
    assert any("./run setup" in line for line in lines)
    users = [line.split()[1] for line in lines if line.startswith("USER")]
    assert users and users[-1] != "root"
    command = json.loads(next(line for line in lines if line.startswith("CMD")).removeprefix("CMD"))
    assert CliRunner().invoke(app, [command[0], "--help"]).exit_code == 0


def test_the_composition_names_settings_commands_and_services_that_exist(monkeypatch: pytest.MonkeyPatch) -> None:
    services = yaml.safe_load((DOCKER / "compose.yaml").read_text())["services"]
    proxied = set(re.findall(r"server (\S+):8000;", (DOCKER / "nginx.conf").read_text()))
    assert proxied == {name for name in services if name.startswith("server-")} and len(proxied) == 2
    for name in (*proxied, "worker"):
        service = services[name]
        assert set(service["depends_on"]) <= set(services)
        assert CliRunner().invoke(app, [service["command"][0], "--help"]).exit_code == 0
        ours = {key.removeprefix("DRGS_").lower() for key in service["environment"] if not key.startswith("AWS_")}
        assert ours <= set(ServiceSettings.model_fields)
        with monkeypatch.context() as patch:
            for key, value in service["environment"].items():
                patch.setenv(key, re.sub(r"\$\{\w+:\?.*\}", "0" * 64, re.sub(r"\$\{\w+:-(\w+)\}", r"\1", value)))
            settings = read_settings()
            open_artifact_store(settings.artifact_url or "")
        assert settings.token is not None and "0" * 64 not in repr(settings)
        assert settings.behind_proxy and settings.host == "0.0.0.0" and not settings.worker and "localhost" in settings.host_names
    assert all(port.startswith("127.0.0.1:") for service in services.values() for port in service.get("ports", ()))


def test_the_proxy_hashes_on_the_session_and_passes_streams_on() -> None:
    text = re.sub(r"#.*", "", (DOCKER / "nginx.conf").read_text())
    assert text.count("{") == text.count("}") and all(line.endswith((";", "{", "}")) for line in map(str.strip, text.splitlines()) if line)
    pattern = re.search(r"~(\S+) \$id;", text)
    assert pattern is not None
    found = re.match(pattern[1].replace("(?<", "(?P<"), "/api/sessions/0123abcd/stream")
    assert found is not None and found["id"] == "0123abcd"
    assert "hash $session consistent;" in text and "proxy_set_header Upgrade $http_upgrade;" in text
