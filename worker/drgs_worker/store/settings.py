"""One settings object of the whole service, server and workers alike.

Read, the first that says something: arguments of the command; environment variables DRGS_NAME (DRGS_LIMITS__NAME for limits, lists as
JSON); the TOML file that DRGS_CONFIG names; the defaults below. A worker that the server starts gets the server's by inheriting its
environment.
"""

import os
from ipaddress import ip_network
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, SecretStr, ValidationError, field_validator
from pydantic_settings import BaseSettings, PydanticBaseSettingsSource, SettingsConfigDict, TomlConfigSettingsSource

from drgs_worker.store.artifact_store import SCHEMES
from drgs_worker.store.bundled import bundled_folder
from drgs_worker.store.data_directory import check_token, default_data_folder

CONFIG_VARIABLE = "DRGS_CONFIG"
"""Environment variable: path of a TOML file."""
LOOPBACK = ("127.0.0.1", "localhost", "::1")

Positive = Annotated[int, Field(ge=1)]


class Limits(BaseModel):
    """What callers may ask for, and how much is kept in memory."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    body_bytes: Positive = 16 << 20
    """Of requests that are not uploads, with the token; a login has at most 4 KiB."""
    upload_bytes: Positive = 4 << 30
    incoming_uploads: Positive = 64
    """That are sent in parts and unfinished; more are answered 429."""
    incoming_bytes: Positive = 16 << 30
    """Of them all when they are complete."""
    keep_upload_seconds: Annotated[float, Field(ge=0)] = 24 * 3600
    """After the last byte of an unfinished upload came, and after a capture came that nothing is built from; then it is removed."""
    active_jobs: Positive = 1000
    """That wait or run; more are answered 429."""
    requests_a_second: Annotated[float, Field(gt=0)] = 200.0
    """On the whole, of one address that has the token; more are answered 429, beyond ten seconds' worth at once. Streams are not counted."""
    failures_a_second: Annotated[float, Field(gt=0)] = 5.0
    """Calls without the token or with a wrong one, likewise, of one address that opens connections, a proxy's its own."""
    connections: Positive = 512
    """Open at the same time by callers with the token, beside as many streams; more are answered 503."""
    stranger_connections: Positive = 128
    """Open at the same time without having shown the token; for one more the oldest of the address that has most is closed."""
    head_bytes: Positive = 64 << 10
    """Of a request's first line and headers; more are answered 431."""
    head_seconds: Annotated[float, Field(gt=0)] = 10.0
    """For the head of a request to arrive, from the connection's opening or its first byte on; later ones are answered 408."""
    body_seconds: Annotated[float, Field(gt=0)] = 30.0
    """That may pass with nothing of a body arriving, and for the whole body where the caller has not shown the token."""
    send_seconds: Annotated[float, Field(gt=0)] = 60.0
    """That may pass with a caller taking nothing of its answer; then the connection is closed."""
    viewers: Positive = 64
    sessions: Positive = 1000
    snapshots: Positive = 200
    """Of one session."""
    edits: Positive = 20_000
    """In one session's log."""
    undo_delete_seconds: Annotated[float, Field(ge=0)] = 24 * 3600
    """How long a deleted asset can be brought back."""
    loaded_assets: Positive = 16
    """In memory; the least recently used one that nobody looks at goes first."""
    loaded_bytes: Positive = 768 << 20
    """Of asset folders whose contents are in memory, which is about what they need there, and of the poses, simulations and environments there."""
    heavy_bytes: Positive = 1 << 30
    """Of memory, by estimate, that finished pictures and the processes that read and write files may take at once; others wait."""
    pictures_at_once: Positive = 2
    """Over REST. One thread renders them all; the second is prepared and encoded meanwhile."""
    poses_at_once: Positive = 4
    """Changes of sessions that are computed at once."""
    simulations_at_once: Positive = 2
    """Of those, such as take longer than a moment; they make room for the others."""
    file_tools_at_once: Positive = 2
    """Processes that read an upload or write a download."""
    waiting: Positive = 512
    """Requests of one of these kinds that wait for their turn; more are answered 429."""
    waiting_of_one: Positive = 256
    """The same, of one address."""
    unsent_bytes: Positive = 16 << 20
    """That wait for one viewer that does not read; it is let go beyond that."""


class ServiceSettings(BaseSettings):
    """How a service runs."""

    model_config = SettingsConfigDict(env_prefix="DRGS_", env_nested_delimiter="__", extra="forbid", frozen=True)

    data: Path = Field(default_factory=default_data_folder)
    """Folder of everything that is kept (worker/drgs_worker/store/data_directory.py)."""
    host: str = "127.0.0.1"
    port: Annotated[int, Field(ge=0, le=65535)] = 8000
    """0 picks a free one."""
    behind_proxy: bool = False
    """A proxy with TLS stands before the server: it may then listen on other addresses than loopback, and host_names must name it."""
    trusted_proxies: tuple[str, ...] = ()
    """Addresses and networks (10.0.0.0/8) of the proxies whose X-Forwarded-For and X-Forwarded-Proto are believed. Without them, all who come
    through a proxy count as one caller where requests a second are limited."""
    host_names: tuple[str, ...] = ("localhost", "127.0.0.1", "[::1]")
    """Values of `Host`, without the port, that are answered."""
    capture_roots: tuple[Path, ...] = ()
    """Folders below which a job may name a capture."""
    worker: bool = True
    """Whether the server keeps a worker of its own."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where frames are rendered and jobs computed."""
    database_url: str | None = None
    """postgresql://USER:PASSWORD@HOST/NAME, for several workers and servers; None: SQLite in the data folder."""
    queue_url: str | None = None
    """Of DBOS's tables; None: NAME_jobs beside database_url's NAME, or SQLite in the data folder."""
    artifact_url: str | None = None
    """s3://BUCKET[/PREFIX] or file:///FOLDER: what several machines with a data folder each share; None: the data folder is all there is."""
    token: SecretStr | None = None
    """What callers must know; None: the data folder's own. Several servers behind one proxy need the same."""
    log_format: Literal["text", "json"] = "text"
    limits: Limits = Limits()
    sample_capture: Path = bundled_folder("sample_capture")
    bundled_environments: Path = bundled_folder("environments")
    """EXR files that every data directory gets a copy of."""
    static_folder: Path | None = None
    """Of the built viewer; None: the one that lies in drgs_server, where web/build.py writes."""

    @field_validator("database_url", "queue_url")
    @classmethod
    def _is_a_known_database(cls, url: str | None) -> str | None:
        if url is not None and not url.startswith(("postgresql://", "postgresql+psycopg://", "sqlite:///")):
            raise ValueError("expected postgresql://USER:PASSWORD@HOST/NAME or sqlite:///PATH")
        return url

    @field_validator("trusted_proxies")
    @classmethod
    def _are_addresses(cls, proxies: tuple[str, ...]) -> tuple[str, ...]:
        for proxy in proxies:
            try:
                ip_network(proxy)  # an address is a network of one
            except ValueError as error:
                raise ValueError(f"expected addresses or networks like 10.0.0.2 or 10.0.0.0/8, found {proxy!r}") from error
        return proxies

    @field_validator("token")
    @classmethod
    def _is_hard_to_guess(cls, token: SecretStr | None) -> SecretStr | None:
        if token is not None:
            check_token(token.get_secret_value())
        return token

    @field_validator("artifact_url")
    @classmethod
    def _is_a_known_store(cls, url: str | None) -> str | None:
        if url is not None and not url.startswith(SCHEMES):
            raise ValueError(f"expected one of {', '.join(SCHEMES)}")
        return url

    @classmethod
    def settings_customise_sources(
        cls,
        settings_cls: type[BaseSettings],
        init_settings: PydanticBaseSettingsSource,
        env_settings: PydanticBaseSettingsSource,
        dotenv_settings: PydanticBaseSettingsSource,
        file_secret_settings: PydanticBaseSettingsSource,
    ) -> tuple[PydanticBaseSettingsSource, ...]:
        file = os.environ.get(CONFIG_VARIABLE)
        toml = (TomlConfigSettingsSource(settings_cls, Path(file)),) if file else ()
        return (init_settings, env_settings, *toml)


def read_settings(**given: object) -> ServiceSettings:
    """The settings in force, with what is given (and not None) before all else.

    Raises:
        ValueError: one sentence that names the wrong setting, or the missing or damaged file.
    """
    file = os.environ.get(CONFIG_VARIABLE)
    if file and not Path(file).is_file():
        raise ValueError(f"{CONFIG_VARIABLE}={file}: there is no such file")
    try:
        settings = ServiceSettings(**{name: value for name, value in given.items() if value is not None})  # type: ignore[arg-type]
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        raise ValueError(f"setting {'.'.join(map(str, first['loc']))}: {first['msg']}") from error
    if settings.host not in LOOPBACK and not settings.behind_proxy:
        raise ValueError(
            f"--host {settings.host}: drgs serve listens on this machine only ({', '.join(LOOPBACK)}), since it has no TLS of its own; "
            "put a TLS proxy in front of it and say so with DRGS_BEHIND_PROXY=true and DRGS_HOST_NAMES, or use an SSH tunnel"
        )
    return settings
