"""REST: jobs and uploads as answers, without a worker; every refusal is a problem document with a sentence."""

import io
import json
import zipfile
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from conftest import Service
from sqlalchemy.orm import Session

from drgs.exchange.exr import decode_environment
from drgs_server.api.made_environments import SIZE, is_made
from drgs_server.api.routes.assets import remove_deleted_assets
from drgs_worker.store.asset_folder import count_asset_folder
from drgs_worker.store.database import AssetRow, JobRow, now


def zipped(entries: dict[str, bytes]) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for name, data in entries.items():
            archive.writestr(name, data)
    return stream.getvalue()


def submit(service: Service, data: bytes, name: str = "teapot.zip", **fields: str):
    return service.client.post("/api/jobs", files={"file": (name, data)}, data=fields)


def is_problem(response, status: int) -> str:
    assert response.status_code == status, response.text
    assert response.headers["content-type"] == "application/problem+json"
    document = response.json()
    assert set(document) == {"type", "title", "status", "detail"} and document["status"] == status
    assert document["detail"].endswith((".", "?")) and " " in document["detail"]
    return document["detail"]


def left_on_disk(service: Service) -> list[Path]:
    """But for copies of databases, which are made at any time."""
    half_made = [path for path in service.context.scratch.folder.iterdir() if ".sqlite.backup" not in path.name]
    return [*service.context.directory.uploads.iterdir(), *half_made]


def test_an_uploaded_capture_becomes_a_queued_job(service: Service) -> None:
    response = submit(service, zipped({"teapot/transforms.json": b"{}"}), preset="draft", seed="7", binding="mesh")
    assert response.status_code == 202
    job = response.json()
    assert (job["state"], job["name"], job["preset"], job["attempts"], job["asset_id"]) == ("queued", "teapot", "draft", 0, None)
    assert (service.context.directory.uploads / job["id"] / "teapot" / "transforms.json").is_file()
    with Session(service.context.engine) as session:
        assert session.get_one(JobRow, job["id"]).parameters["binding"] == "mesh"
    listed = service.client.get("/api/jobs").json()
    assert listed["total"] == 1 and listed["jobs"] == [job] and listed["workers_alive"] == 0
    assert service.client.get(f"/api/jobs/{job['id']}").json() == job
    is_problem(service.client.get(f"/api/jobs/{job['id']}/preview.jpg"), 404)
    assert service.client.post(f"/api/jobs/{job['id']}/cancel").json()["state"] == "cancelled"
    assert "cancelled" in is_problem(service.client.post(f"/api/jobs/{job['id']}/resume"), 409)
    assert service.client.post(f"/api/jobs/{job['id']}/retry").json()["state"] == "queued"


def test_a_job_tells_what_was_found_in_its_capture(service: Service) -> None:
    job = submit(service, zipped({"transforms.json": b"{}"})).json()
    assert job["capture"] is None
    found = {"summary": "4 pictures.", "findings": [{"level": "warning", "sentence": "4 views are few.", "advice": "Take more."}]}
    with Session(service.context.engine) as session, session.begin():
        session.get_one(JobRow, job["id"]).capture_report = found
    assert service.client.get(f"/api/jobs/{job['id']}").json()["capture"] == found
    assert service.client.get("/api/jobs").json()["jobs"][0]["capture"] == found


def test_the_same_idempotency_key_gives_the_same_job(service: Service) -> None:
    body = zipped({"transforms.json": b"{}"})
    first, second = (
        service.client.post("/api/jobs", files={"file": ("a.zip", body)}, headers={"Idempotency-Key": "k1"}).json()["id"] for _ in range(2)
    )
    assert first == second and service.client.get("/api/jobs").json()["total"] == 1


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "data", "fields", "words"),
    [
        ("a.tar", b"x", {}, "ends in .zip"),
        ("a.zip", b"not a zip", {}, "damaged"),
        ("a.zip", zipped({"../../evil": b"1"}), {}, "does not name a place"),
        ("a.zip", zipped({"a": b"1"}), {"preset": "ultra"}, "preset"),
        ("a.zip", zipped({"a": b"1"}), {"seed": "-3"}, "seed"),
    ],
)
def test_wrong_uploads_are_refused_and_leave_nothing(lasting_service: Service, name: str, data: bytes, fields: dict, words: str) -> None:
    assert words in is_problem(submit(lasting_service, data, name, **fields), 422)
    assert left_on_disk(lasting_service) == [] and lasting_service.client.get("/api/jobs").json()["total"] == 0


@pytest.mark.slow
@pytest.mark.parametrize("body", [b"", b"{", b"[]", b'{"dataset": 3}', b'{"dataset": "sample", "shell": "rm"}', b"\xff"])
def test_wrong_bodies_are_refused(lasting_service: Service, body: bytes) -> None:
    is_problem(lasting_service.client.post("/api/jobs", content=body, headers={"content-type": "application/json"}), 422)


def test_a_folder_below_an_allowed_root_is_taken(tmp_path: Path) -> None:
    (tmp_path / "captures" / "mug").mkdir(parents=True)
    (tmp_path / "captures" / "way-out").symlink_to(tmp_path)
    service = Service(tmp_path, capture_roots=(tmp_path / "captures",))
    with service.client:
        assert service.client.post("/api/jobs", json={"dataset": str(tmp_path / "captures/mug")}).json()["name"] == "mug"
        is_problem(service.client.post("/api/jobs", json={"dataset": str(tmp_path / "captures/way-out")}), 403)
        is_problem(service.client.post("/api/jobs", json={"dataset": str(tmp_path / "captures/none")}), 404)


def test_an_asset_is_listed_read_and_deleted(service: Service) -> None:
    asset = service.add_asset()
    assert service.client.get("/api/assets").json()["assets"][0]["id"] == asset
    assert service.client.get(f"/api/assets/{asset}").json()["has_thumbnail"] is False
    response = service.client.get(f"/api/assets/{asset}/mesh.glb")
    assert response.content == b"glTF" and response.headers["content-type"] == "model/gltf-binary"
    assert service.client.get(f"/api/assets/{asset}/mesh.glb", headers={"Range": "bytes=1-2"}).content == b"lT"
    is_problem(service.client.get(f"/api/assets/{asset}/thumb.jpg"), 404)


def test_a_deleted_asset_can_be_brought_back_until_it_is_removed_for_good(service: Service) -> None:
    asset = service.add_asset()
    session = service.client.post("/api/sessions", json={"asset": asset}).json()["id"]
    for _ in range(2):
        assert service.client.delete(f"/api/assets/{asset}").status_code == 204
        is_problem(service.client.get(f"/api/assets/{asset}"), 404)
        is_problem(service.client.get(f"/api/sessions/{session}"), 404)
        is_problem(service.client.post("/api/sessions", json={"asset": asset}), 404)
        assert service.client.get("/api/assets").json()["total"] == 0
        assert service.client.get("/api/assets?deleted=true").json()["assets"][0]["id"] == asset
        assert remove_deleted_assets(service.context) == 0
        assert service.client.post(f"/api/assets/{asset}/undelete").json()["deleted_at"] is None
        assert service.client.get(f"/api/sessions/{session}").json()["asset"] == asset
    service.client.delete(f"/api/assets/{asset}")
    with Session(service.context.engine) as database, database.begin():
        database.get_one(AssetRow, asset).deleted_at = now() - service.settings.limits.undo_delete_seconds - 1
    assert remove_deleted_assets(service.context) == 1
    assert not service.context.directory.asset(asset).exists()
    is_problem(service.client.post(f"/api/assets/{asset}/undelete"), 404)


def test_assets_are_found_by_part_of_their_name(service: Service) -> None:
    for number, name in enumerate(("Blue 100%", "blue mug", "Red_mug")):
        service.add_asset(f"{number}" * 32, name)
    found = {
        query: [asset["name"] for asset in service.client.get("/api/assets", params={"search": query}).json()["assets"]]
        for query in ("BLUE", "%", "_", "x")
    }
    assert found == {"BLUE": ["blue mug", "Blue 100%"], "%": ["Blue 100%"], "_": ["Red_mug"], "x": []}


def exr(height: int, width: int) -> bytes:
    stream = io.BytesIO()
    channels = {key: np.full((height, width), 0.5, np.float32) for key in "RGB"}
    OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}, channels).write(stream)
    return stream.getvalue()


def uploaded_environments(service: Service) -> list[str]:
    """Names, without those that every service computes."""
    listed = [found["name"] for found in service.client.get("/api/environments").json()["environments"]]
    return [name for name in listed if not is_made(name)]


@pytest.mark.slow
def test_computed_environments_are_listed_by_every_service_and_made_when_asked_for(service: Service) -> None:
    folder = service.context.directory.environments
    listed = {found["name"]: found for found in service.client.get("/api/environments").json()["environments"]}
    assert listed["sun-and-sky.exr"]["title"] == "Sun and sky" and "three-point-lights.exr" in listed
    assert list(folder.iterdir()) == []
    for name in (*listed, "sun-and-sky-12.exr"):
        assert service.client.get(f"/api/environments/{name}/thumb.jpg").content.startswith(b"\xff\xd8")
        made = decode_environment(service.client.get(f"/api/environments/{name}").content)
        assert made.shape == (SIZE[1], SIZE[0], 3)
    assert len(list(folder.glob("*.exr"))) == 3
    # Of one sky's many heights the list holds the usual one.
    assert uploaded_environments(service) == [] and len(service.client.get("/api/environments").json()["environments"]) == 2
    is_problem(service.client.get("/api/environments/sun-and-sky-89.exr"), 404)
    # An upload never takes the name of what is computed.
    response = service.client.post("/api/environments", files={"file": ("sun and sky.exr", exr(8, 16))})
    assert response.json()["name"] == "my-sun-and-sky.exr"


def test_an_environment_is_uploaded_listed_and_shown(service: Service) -> None:
    for wanted in ("my-sky.exr", "my-sky-2.exr"):
        response = service.client.post("/api/environments", files={"file": ("../../My sky.exr", exr(8, 16))}, data={"name": "my sky"})
        assert response.status_code == 201, response.text
        assert response.json() == {"name": wanted, "title": wanted[:-4].replace("-", " ").capitalize(), "width": 16, "height": 8}
    assert uploaded_environments(service) == ["my-sky-2.exr", "my-sky.exr"]
    assert service.client.get("/api/environments/my-sky.exr/thumb.jpg").content.startswith(b"\xff\xd8")
    assert service.client.get("/api/environments/my-sky.exr").content[:4] == b"\x76\x2f\x31\x01"


@pytest.mark.slow
def test_a_wrong_environment_is_refused_by_name(service: Service) -> None:
    sentence = is_problem(service.client.post("/api/environments", files={"file": ("sky.exr", exr(8, 8))}), 422)
    assert "twice as wide" in sentence and str(service.context.directory.root) not in sentence
    is_problem(service.client.post("/api/environments", files={"file": ("sky.exr", b"\x80\x04pickle")}), 422)
    assert left_on_disk(service) == [] and uploaded_environments(service) == []


@pytest.mark.slow
def test_a_wrong_asset_is_refused(service: Service) -> None:
    sentence = is_problem(service.client.post("/api/assets", files={"file": ("a.obj", b"v 0 0 nan\nf 1 1 1\n")}), 422)
    assert str(service.context.directory.root) not in sentence
    is_problem(service.client.post("/api/assets", files={"file": ("a.zip", zipped({"asset.json": json.dumps({"a": 1}).encode()}))}), 422)
    assert left_on_disk(service) == [] and service.client.get("/api/assets").json()["total"] == 0


def test_a_folder_without_counts_is_no_asset(tmp_path: Path) -> None:
    (tmp_path / "asset.json").write_text("[]")
    with pytest.raises(ValueError, match="counts"):
        count_asset_folder(tmp_path)


@pytest.mark.parametrize("query", ["limit=0", "limit=100000", "offset=-1", "limit=x"])
def test_pages_have_bounds(lasting_service: Service, query: str) -> None:
    is_problem(lasting_service.client.get(f"/api/jobs?{query}"), 422)


def test_unknown_calls_and_methods_are_problems(service: Service) -> None:
    is_problem(service.client.get("/api/none"), 404)
    is_problem(service.client.put("/api/jobs"), 405)
    assert "/api/jobs" in service.client.get("/api/docs").text
    assert "/api/sessions/{session_id}/edits" in service.client.get("/api/openapi.json").json()["paths"]
