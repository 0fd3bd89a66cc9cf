"""A server in this process, with a painter instead of a renderer and no worker."""

import json
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from painter import Painter
from sqlalchemy.orm import Session
from starlette.testclient import TestClient

from drgs_server.api.context import ServerContext
from drgs_server.app import create_app
from drgs_server.settings import ServerSettings
from drgs_worker.jobs.file_tool import make_asset
from drgs_worker.store.data_directory import read_token
from drgs_worker.store.database import AssetRow, now
from drgs_worker.store.register_asset import register_asset
from tests.new_databases import put_new_databases


class Service:
    """A running app and what tests need to talk to it."""

    def __init__(self, root: Path, painter: Painter | None = None, **settings: object) -> None:
        self.painter = painter or Painter()
        if not (root / "data").exists() and "database_url" not in settings:
            put_new_databases(root / "data")
        self.settings = ServerSettings(data=root / "data", bundled_environments=root / "none", static_folder=root / "none", **settings)
        self.app = create_app(self.settings, self.painter)
        self.context: ServerContext = self.app.state.context
        self.token = read_token(self.context.directory)
        self.anonymous = TestClient(self.app, base_url="http://127.0.0.1:8000")
        self.client = TestClient(self.app, base_url="http://127.0.0.1:8000", headers={"Authorization": f"Bearer {self.token}"})

    @contextmanager
    def running(self) -> Iterator["Service"]:
        """Both clients on one event loop, as of a real server: what a session's streams wait for belongs to that."""
        with self.client:
            self.anonymous.portal = self.client.portal
            yield self
            self.anonymous.portal = None

    def add_asset(self, asset_id: str = "a" * 32, name: str = "ball") -> str:
        folder = self.context.directory.asset(asset_id)
        folder.mkdir()
        (folder / "asset.json").write_text(json.dumps({"counts": {"surfels": 0, "vertices": 8, "faces": 12}}))
        (folder / "mesh.glb").write_bytes(b"glTF")
        with Session(self.context.engine) as session, session.begin():
            session.add(
                AssetRow(id=asset_id, name=name, created_at=now(), source="upload", bytes=10, surfel_count=0, vertex_count=8, face_count=12)
            )
        return asset_id

    def add_mesh(self, source: Path) -> str:
        """A real asset, as the upload of a mesh file makes it; in this process, since another would take two seconds to load what is here."""
        asset_id = uuid.uuid4().hex
        make_asset(source, self.context.directory.asset(asset_id))
        return register_asset(self.context.directory, self.context.engine, asset_id, source.stem, "upload").id

    def open_session(self) -> str:
        known = self.context.directory.asset("a" * 32)
        response = self.client.post("/api/sessions", json={"asset": known.name if known.exists() else self.add_asset(known.name)})
        assert response.status_code == 201, response.text
        return response.json()["id"]


@pytest.fixture
def service(tmp_path: Path) -> Iterator[Service]:
    with Service(tmp_path).running() as service:
        yield service


@pytest.fixture(scope="module")
def lasting_service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    """One for all tests of a module that are refused, or change nothing that others see: to begin and end a service takes longer than to ask it."""
    with Service(tmp_path_factory.mktemp("service")).running() as service:
        yield service
