"""The container files, checked as far as that goes without an engine: what they name exists, and settings are spelt right."""

import json
import re
import tomllib
from ipaddress import ip_address, ip_network
from pathlib import Path

import pytest
import yaml
from painter import Painter
from starlette.testclient import TestClient
from typer.testing import CliRunner

from drgs.cli import app
from drgs_server.app import create_app
from drgs_server.run import _announce
from drgs_worker.store.artifact_store import open_artifact_store
from drgs_worker.store.settings import ServiceSettings, read_settings

DOCKER = Path(__file__).parents[2] / "docker"
KNOWN_INSTRUCTIONS = {"FROM", "WORKDIR", "COPY", "RUN", "USER", "VOLUME", "ENTRYPOINT", "CMD", "ENV", "EXPOSE", "ARG"}


def stages(name: str) -> list[list[tuple[str, str]]]:
    """Instructions with their arguments, of each stage of a Dockerfile."""
    text = re.sub(r"^#.*\n", "", (DOCKER / name).read_text(), flags=re.MULTILINE)
    lines = [line.split(maxsplit=1) for line in re.sub(r"\\\n", " ", text).splitlines() if line.strip()]
    found: list[list[tuple[str, str]]] = []
    for instruction, arguments in lines:
        if instruction == "FROM":
            found.append([])
        found[-1].append((instruction, " ".join(arguments.split())))
    return found


def of_stage(stage: list[tuple[str, str]], instruction: str) -> list[str]:
    return [arguments for found, arguments in stage if found == instruction]


def image_settings(name: str) -> dict[str, str]:
    """The environment variables of ours that an image sets."""
    pairs = dict(pair.split("=", 1) for pair in " ".join(of_stage(stages(name)[-1], "ENV")).split())
    return {key: value for key, value in pairs.items() if key.startswith("DRGS_")}


@pytest.mark.parametrize("name", ["Dockerfile", "Dockerfile.cuda"])
def test_an_image_holds_the_wheel_that_is_built_as_elsewhere_and_no_tools(name: str) -> None:
    build, runtime = stages(name)
    assert all(instruction in KNOWN_INSTRUCTIONS for instruction, _ in (*build, *runtime))
    assert build[0] == ("FROM", "python:3.12-slim AS build") and of_stage(build, "RUN") == ["./run wheel"]
    # Nothing of the repository is copied: the wheel is installed from the first stage, which is only looked into.
    assert of_stage(runtime, "COPY") == []
    (install,) = of_stage(runtime, "RUN")
    assert "--mount=type=bind,from=build,source=/src" in install and "/src/dist/*.whl" in install and "-c /src/constraints.txt" in install
    assert not re.search(r"\bdev\b|node|npm|gcc|build-essential", install)
    (extras,) = re.findall(r'"drgs\[([\w,]+)\] @', install)
    known = tomllib.loads((DOCKER.parent / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    assert {"serve"} <= set(extras.split(",")) <= set(known)


@pytest.mark.parametrize("name", ["Dockerfile", "Dockerfile.cuda"])
def test_an_image_serves_on_a_published_port_and_does_not_run_as_root(name: str) -> None:
    runtime = stages(name)[-1]
    users = of_stage(runtime, "USER")
    assert users and users[-1] != "root"
    (command,) = of_stage(runtime, "CMD")
    assert of_stage(runtime, "ENTRYPOINT") == ['["drgs"]']
    assert CliRunner().invoke(app, [*json.loads(command), "--help"]).exit_code == 0
    ours = image_settings(name)
    assert {key.removeprefix("DRGS_").lower() for key in ours} <= set(ServiceSettings.model_fields)
    assert ours["DRGS_HOST"] == "0.0.0.0", "the engine reaches a container by its own address, not by loopback"
    assert of_stage(runtime, "EXPOSE") == [str(ServiceSettings().port)]
    assert of_stage(runtime, "VOLUME") == [ours["DRGS_DATA"]]


@pytest.mark.parametrize(
    ("host", "token", "status"),
    [
        ("localhost:8000", True, 200),
        ("localhost:49153", True, 200),
        ("127.0.0.1:9000", True, 200),
        ("localhost:8000", False, 401),
        ("evil.example.org:8000", True, 400),
        ("192.168.1.7:8000", True, 400),
        ("0.0.0.0:8000", True, 400),
    ],
)
def test_a_container_is_asked_by_localhost_on_any_port_and_with_the_token(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, host: str, token: bool, status: int
) -> None:
    for key, value in image_settings("Dockerfile").items():
        monkeypatch.setenv(key, value)
    settings = read_settings(data=tmp_path / "data", bundled_environments=tmp_path)
    service = create_app(settings, Painter())
    headers = {"Host": host} | ({"Authorization": f"Bearer {service.state.context.gatekeeper._token.decode()}"} if token else {})
    with TestClient(service) as client:
        assert client.get("/api/environments", headers=headers).status_code == status


def test_what_a_container_prints_can_be_opened() -> None:
    said: list[str] = []
    for host in ("0.0.0.0", "::", "127.0.0.1", "::1"):
        _announce(8000, host, "t", False, said.append)
    assert said == [f"http://{name}:8000/#token=t" for name in ("localhost", "localhost", "127.0.0.1", "[::1]")]


def test_what_an_image_is_built_from_leaves_out_what_git_does() -> None:
    ignored = set((DOCKER.parent / ".dockerignore").read_text().split())
    assert {".git", ".venv", "**/node_modules", "**/__pycache__", "data", "dist", "out"} <= ignored


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
    assert "proxy_set_header X-Forwarded-For $proxy_add_x_forwarded_for;" in text
    assert "hash $session consistent;" in text and "proxy_set_header Upgrade $http_upgrade;" in text


def test_the_servers_believe_the_proxy_of_the_composition_and_nobody_else() -> None:
    composition = yaml.safe_load((DOCKER / "compose.yaml").read_text())
    (network,) = composition["networks"]["default"]["ipam"]["config"]
    proxy = composition["services"]["proxy"]["networks"]["default"]["ipv4_address"]
    for name in ("server-1", "server-2"):
        assert json.loads(composition["services"][name]["environment"]["DRGS_TRUSTED_PROXIES"]) == [proxy]
    assert ip_address(proxy) in ip_network(network["subnet"])
    assert ip_address(proxy) not in ip_network(network["ip_range"]), "another container could be given the proxy's address"
