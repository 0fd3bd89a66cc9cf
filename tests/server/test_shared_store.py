"""Two servers, each with a data folder of its own, on one database and one S3 server."""

import uuid
from collections.abc import Iterator
from pathlib import Path

import pytest
from conftest import Service
from painter import PaintedAsset, Painter
from test_rest import exr, is_problem, uploaded_environments, zipped

from drgs_server.api.routes.assets import remove_deleted_assets
from drgs_server.settings import Limits
from drgs_worker.store.artifacts import share_job
from drgs_worker.store.register_asset import register_asset
from tests.new_databases import put_new_databases
from tests.worker import store_server as servers

ASSET = "a" * 32


class Reader(Painter):
    """Needs the asset's files."""

    def load(self, folder: Path, environments: Path) -> PaintedAsset:
        assert (folder / "mesh.glb").read_bytes() == b"glTF"
        return super().load(folder, environments)


@pytest.fixture(scope="module")
def s3() -> Iterator[servers.StoreServer]:
    with servers.store_server() as server:
        yield server


@pytest.fixture
def pair(tmp_path: Path, s3: servers.StoreServer) -> Iterator[tuple[Service, Service]]:
    put_new_databases(tmp_path)
    shared = {
        "database_url": f"sqlite:///{tmp_path / 'app.sqlite'}",
        "queue_url": f"sqlite:///{tmp_path / 'jobs.sqlite'}",
        "limits": Limits(undo_delete_seconds=0),
        "artifact_url": f"s3://{servers.BUCKET}/{uuid.uuid4().hex}",
    }
    first, second = (Service(tmp_path / name, Reader(), **shared) for name in ("first", "second"))
    with first.client, second.client:
        yield first, second


def add(service: Service) -> None:
    folder = service.context.directory.asset(ASSET)
    folder.mkdir()
    (folder / "asset.json").write_text('{"counts": {"vertices": 8}}')
    for name, data in (("mesh.glb", b"glTF"), ("thumb.jpg", b"\xff\xd8")):
        (folder / name).write_bytes(data)
    register_asset(service.context.directory, service.context.engine, ASSET, "ball", "upload")


@pytest.mark.slow
def test_what_one_server_has_the_other_shows(pair: tuple[Service, Service]) -> None:
    first, second = pair
    add(first)
    here = second.context.directory.asset(ASSET)
    assert second.client.get("/api/assets").json()["assets"][0]["has_thumbnail"] is True
    assert second.client.get(f"/api/assets/{ASSET}/thumb.jpg").content == b"\xff\xd8" and not here.exists()
    session = second.client.post("/api/sessions", json={"asset": ASSET}).json()["id"]
    assert second.client.get(f"/api/sessions/{session}/frame.jpg?spp=4").content.startswith(b"\xff\xd8")
    assert here.is_dir() and second.client.get(f"/api/assets/{ASSET}/mesh.glb").content == b"glTF"
    name = first.client.post("/api/environments", files={"file": ("sky.exr", exr(8, 16))}).json()["name"]
    body = {"edit": {"op": "environment", "file": name}}
    assert second.client.post(f"/api/sessions/{session}/edits", json=body).status_code == 200
    assert uploaded_environments(second) == [name]
    again = second.client.post("/api/environments", files={"file": ("sky.exr", exr(8, 16))}).json()["name"]
    assert again == "sky-2.exr" and first.client.get(f"/api/environments/{again}").status_code == 200


@pytest.mark.slow
def test_a_store_that_is_away_is_a_problem_that_passes(pair: tuple[Service, Service], s3: servers.StoreServer) -> None:
    first, second = pair
    add(first)
    session = second.client.post("/api/sessions", json={"asset": ASSET}).json()["id"]
    with s3.away():
        for answer in (
            first.client.post("/api/environments", files={"file": ("sky.exr", exr(8, 16))}),
            second.client.get(f"/api/assets/{ASSET}/mesh.glb"),
            second.client.get(f"/api/sessions/{session}/frame.jpg"),
        ):
            assert "does not answer" in is_problem(answer, 503)
        assert first.client.get(f"/api/assets/{ASSET}/mesh.glb").status_code == 200  # it has the folder
    assert uploaded_environments(first) == []
    assert first.client.post("/api/environments", files={"file": ("sky.exr", exr(8, 16))}).status_code == 201
    assert second.client.get(f"/api/sessions/{session}/frame.jpg?spp=4").status_code == 200


@pytest.mark.slow
def test_a_damaged_asset_is_refused_and_leaves_nothing(pair: tuple[Service, Service], s3: servers.StoreServer) -> None:
    first, second = pair
    add(first)
    for key in s3.keys(first.settings.artifact_url.removeprefix(f"s3://{servers.BUCKET}/")):  # type: ignore[union-attr]
        if not key.endswith("manifest.json"):
            s3.client.put_object(Bucket=servers.BUCKET, Key=key, Body=b"rot!")
    assert "is damaged" in is_problem(second.client.get(f"/api/assets/{ASSET}/mesh.glb"), 502)
    session = second.client.post("/api/sessions", json={"asset": ASSET}).json()["id"]
    assert "is damaged" in is_problem(second.client.get(f"/api/sessions/{session}/frame.jpg"), 502)
    assert list(second.context.directory.assets.iterdir()) == []


def test_an_asset_deleted_for_good_leaves_the_store(pair: tuple[Service, Service], s3: servers.StoreServer) -> None:
    first, _ = pair
    add(first)
    assert first.client.delete(f"/api/assets/{ASSET}").status_code == 204
    assert remove_deleted_assets(first.context) == 1
    assert s3.keys(first.settings.artifact_url.removeprefix(f"s3://{servers.BUCKET}/")) == []  # type: ignore[union-attr]


def test_what_a_job_made_on_another_machine_is_listed_downloaded_and_deleted(
    pair: tuple[Service, Service], s3: servers.StoreServer
) -> None:
    first, second = pair
    job = first.client.post("/api/jobs", files={"file": ("mug.zip", zipped({"mug/transforms.json": b"{}"}))}).json()["id"]
    folder = second.context.directory.job(job)
    (folder / "files").mkdir(parents=True)
    (folder / "files" / "asset-own-0000.png").write_bytes(b"picture")
    (folder / "files" / "draft-asset.glb").write_bytes(b"half")
    (folder / "log.txt").write_text("render: finished\n")
    (folder / "preview.jpg").write_bytes(b"\xff\xd8")
    share_job(second.context.directory, job)
    url = f"/api/jobs/{job}"
    assert [found["name"] for found in first.client.get(f"{url}/files").json()["files"]] == ["asset-own-0000.png"]
    assert first.client.get(f"{url}/files/asset-own-0000.png", headers={"Range": "bytes=1-3"}).content == b"ict"
    assert first.client.get(f"{url}/log").text == "render: finished\n"
    assert first.client.get(f"{url}/preview.jpg").content == b"\xff\xd8"
    assert first.client.post(f"{url}/cancel").json()["state"] == "cancelled"
    with s3.away():
        assert "does not answer" in is_problem(first.client.delete(url), 503)
    assert first.client.get(url).status_code == 200 and first.client.delete(url).status_code == 204
    assert s3.keys(first.settings.artifact_url.removeprefix(f"s3://{servers.BUCKET}/")) == []  # type: ignore[union-attr]
