"""Saving a session as a new version of its asset, and what a full disk leaves behind."""

import asyncio
import json
import resource
from pathlib import Path

import pytest
from conftest import Service
from test_rest import is_problem, left_on_disk, zipped

from drgs.scene.asset import load_asset
from drgs_server.api.routes import assets

TETRAHEDRON = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


def opened(service: Service, folder: Path) -> tuple[str, str]:
    """Ids of a real asset and of a session on it with one edit."""
    (folder / "four.obj").write_bytes(TETRAHEDRON)
    asset = service.add_mesh(folder / "four.obj")
    session = service.client.post("/api/sessions", json={"asset": asset}).json()["id"]
    edit = {"op": "material", "select": {"all": True}, "set": {"roughness": 0.25}}
    assert service.client.post(f"/api/sessions/{session}/edits", json={"edit": edit}).status_code == 200
    return asset, session


@pytest.mark.slow
def test_an_export_of_a_session_holds_its_edits_and_keeps_no_version(service: Service, tmp_path: Path) -> None:
    asset, session = opened(service, tmp_path)
    plain, edited = (service.client.get(f"/api/{which}/export?format=zip") for which in (f"assets/{asset}", f"sessions/{session}"))
    assert edited.status_code == 200, edited.text
    assert "four.zip" in edited.headers["content-disposition"]
    roughness = []
    for name, answer in (("plain", plain), ("edited", edited)):
        (tmp_path / f"{name}.zip").write_bytes(answer.content)
        roughness.append(float(load_asset(tmp_path / f"{name}.zip").mesh.roughness.max()))
    assert roughness[0] > roughness[1] == 0.25
    assert service.client.get(f"/api/sessions/{session}/export?format=glb").content[:4] == b"glTF"
    refused = service.client.get(f"/api/sessions/{session}/export?format=ply")
    assert refused.status_code == 422 and "Gaussians" in refused.json()["detail"]
    assert service.client.get("/api/assets").json()["total"] == 1
    assert list(service.context.directory.uploads.iterdir()) == []


@pytest.mark.parametrize(
    ("asked", "status"), [(None, 200), ("bytes=0-1", 206), ("bytes=0-1,3-3", 206), ("bytes=90-", 416), ("bytes=junk", 400)]
)
def test_an_export_leaves_no_draft_whatever_range_is_asked_for(
    service: Service, monkeypatch: pytest.MonkeyPatch, asked: str | None, status: int
) -> None:
    async def tool(_: object, __: object, ___: object, kind: str, source: str, out: str, *rest: str) -> None:
        Path(out).write_bytes(b"glTF")

    monkeypatch.setattr(assets, "_run_tool", tool)
    headers = {} if asked is None else {"Range": asked}
    assert service.client.get(f"/api/assets/{service.add_asset()}/export?format=glb", headers=headers).status_code == status
    assert list(service.context.scratch.folder.glob(".export-*")) == []


def test_a_download_passes_on_how_many_faces_were_asked_for(service: Service, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    told: list[tuple[str, ...]] = []

    async def tool(_: object, __: object, ___: object, kind: str, source: str, out: str, *rest: str) -> None:
        told.append(rest)
        Path(out).write_bytes(b"glTF")

    asset, session = opened(service, tmp_path)
    monkeypatch.setattr(assets, "_run_tool", tool)
    for address in (f"/api/assets/{asset}/export", f"/api/sessions/{session}/export"):
        assert service.client.get(address, params={"format": "usdz"}).status_code == 200
        assert service.client.get(address, params={"format": "usdz", "faces": 500}).status_code == 200
        is_problem(service.client.get(address, params={"format": "glb", "faces": 3}), 422)
        refused = service.client.get(address, params={"format": "ply", "faces": 500})
        is_problem(refused, 422)
        assert "no textures; expected glb, mesh, usdz, usd" in refused.json()["detail"]
    assert [rest[:2] for rest in told] == [("usdz", "0"), ("usdz", "500")] * 2
    assert [len(rest) for rest in told] == [2, 2, 5, 5], "the session's come with its edits"


def test_an_export_leaves_no_draft_where_sending_fails(tmp_path: Path) -> None:
    folder = tmp_path / ".export-1"
    folder.mkdir()
    (folder / "asset.glb").write_bytes(b"glTF")

    async def receive() -> dict:
        return {"type": "http.disconnect"}

    async def send(_: object) -> None:
        raise ConnectionResetError("the other end is gone")

    scope = {"type": "http", "method": "GET", "headers": [], "asgi": {"spec_version": "2.4"}}
    with pytest.raises(ConnectionResetError):
        asyncio.run(assets.DraftResponse(folder / "asset.glb")(scope, receive, send))
    assert not folder.exists()


def files_of(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_a_disk_that_is_full_while_something_comes_in_is_said_and_leaves_nothing(service: Service) -> None:
    session = service.open_session()
    noise = bytes(range(256)) * 2000
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, limits[1]))
    try:
        answers = [
            service.client.post("/api/assets", files={"file": ("four.obj", TETRAHEDRON + b"#" * 200_000)}),
            service.client.post("/api/jobs", files={"file": ("mug.zip", zipped({"transforms.json": b"{}", "a.png": noise}))}),
            service.client.post("/api/environments", files={"file": ("sky.exr", noise)}),
            service.client.get("/api/environments/sun-and-sky-30.exr"),
            service.client.post("/api/weights", content=bytes(400_000), headers={"content-type": "application/octet-stream"}),
            service.client.post(f"/api/sessions/{session}/edits", json={"edit": {"op": "environment", "file": "sun-and-sky-31.exr"}}),
        ]
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    for answer in answers:
        assert "disk is full" in is_problem(answer, 503) and answer.headers["retry-after"]
    assert left_on_disk(service) == [] and [path for path in service.context.directory.environments.rglob("*") if path.is_file()] == []
    assert service.client.get(f"/api/sessions/{session}").json()["revision"] == 0


@pytest.mark.slow
def test_a_saved_session_is_a_new_version_with_its_edits_and_a_full_disk_leaves_all_as_it_was(service: Service, tmp_path: Path) -> None:
    asset, session = opened(service, tmp_path)
    folder = service.context.directory.asset(asset)
    before = files_of(folder)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, limits[1]))  # the tool inherits it: no file of it can grow further
    try:
        full = service.client.post(f"/api/sessions/{session}/save", json={"name": "never"})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert "disk is full" in is_problem(full, 503)
    assert files_of(folder) == before and service.client.get("/api/assets").json()["total"] == 1
    assert left_on_disk(service) == []
    assert [path.name for path in service.context.directory.assets.iterdir()] == [asset]

    saved = service.client.post(f"/api/sessions/{session}/save").json()
    assert (saved["name"], saved["version"], saved["parent_id"], saved["source"]) == ("four", 2, asset, "session")
    assert saved["edits"][0]["set"]["roughness"] == 0.25 and saved["has_thumbnail"]
    assert files_of(folder) == before
    version = load_asset(service.context.directory.asset(saved["id"]))
    assert float(version.mesh.roughness.max()) == 0.25
    assert json.dumps(version.provenance["versions"][0]["edits"]) == json.dumps(
        [{"op": "material", "select": {"all": True}, "set": {"roughness": 0.25}, "mode": "absolute"}]
    )
    assert service.client.get(f"/api/sessions/{session}").json()["revision"] == 1  # goes on as it was
