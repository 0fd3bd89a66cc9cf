"""Jobs of every kind as they are asked for: what is stored is what a worker can read, and wrong ones are refused with a sentence."""

import threading
from pathlib import Path

import pytest
from conftest import Service
from sqlalchemy.orm import Session
from test_rest import is_problem

from drgs_worker.jobs import workflows as jobs
from drgs_worker.jobs.builders import build_with_drgs
from drgs_worker.store.database import CaptureRow, now

ASSET = "a" * 32
RENDER = {"kind": "render", "asset": ASSET}


def test_every_kind_of_job_that_the_api_takes_can_be_begun_by_a_worker(service: Service, tmp_path: Path) -> None:
    service.add_asset(ASSET)
    built = service.client.post("/api/jobs", json={"dataset": "sample", "preset": "draft"}).json()
    context = jobs.WorkerContext(service.context.directory, service.context.engine, "w", build_with_drgs, "cpu", threading.Event())
    jobs.set_context(context)
    service.add_asset(built["id"], "built")
    requests = [
        {"kind": "redecouple", "asset": built["id"]},
        {"kind": "simulate", "asset": ASSET, "scene": {"particles": 100}, "name": "fall"},
        RENDER | {"turntable": {"frames": 2}, "video_fps": 10, "priority": 3},
        {"kind": "export", "asset": ASSET, "formats": ["glb", "ply"]},
        {"kind": "pose", "dataset": "sample", "seed": 7},
    ]
    found = [service.client.post("/api/jobs", json=request) for request in requests]
    assert [response.status_code for response in found] == [202] * 5, [response.text for response in found]
    infos = [built, *(response.json() for response in found)]
    assert [info["kind"] for info in infos] == ["build", "redecouple", "simulate", "render", "export", "pose"]
    assert [info["source_asset"] for info in infos] == [None, built["id"], ASSET, ASSET, ASSET, None]
    assert service.client.get("/api/jobs").json()["jobs"] == infos[::-1]
    assert (infos[2]["name"], infos[3]["name"], infos[3]["priority"]) == ("fall", "ball", 3)
    steps = {info["kind"]: jobs._RUNS[info["kind"]](jobs._job_context(info["id"])).steps for info in infos}
    assert steps["build"] == ("read", "fit", "mesh", "surface", "materials", "pack", "register")
    assert steps["redecouple"] == ("copy", *steps["build"])
    assert (steps["simulate"], steps["export"]) == (("simulate",), ("export glb", "export ply"))
    assert (steps["render"], steps["pose"]) == (("render asset ",), ("pose", "register"))
    posing = jobs._job_context(infos[5]["id"])
    assert (posing.dataset, posing.parameters["seed"]) == (service.settings.sample_capture.resolve(), 7)
    box = {"low": [-1, -1, 0], "high": [1, 1, 2]}
    meshed = service.client.post("/api/jobs", json={"dataset": "sample", "binding": "mesh", "box": box, "masks": "given"}).json()
    service.add_asset(meshed["id"], "meshed")
    again = service.client.post("/api/jobs", json={"kind": "redecouple", "asset": meshed["id"]}).json()
    found = [jobs._RUNS[info["kind"]](jobs._job_context(info["id"])).steps for info in (meshed, again)]
    assert found[0] == ("read", "fit", "mesh", "surface", "bind", "materials", "pack", "register") and found[1] == ("copy", *found[0])
    assert jobs._job_context(again["id"]).parameters["box"] == box, "what was cut off is not there to find materials of"
    asked = [jobs._RUNS[info["kind"]](jobs._job_context(info["id"]))._request() for info in (meshed, again, infos[1])]
    assert [request.box for request in asked] == [((-1, -1, 0), (1, 1, 2)), ((-1, -1, 0), (1, 1, 2)), None]
    assert [request.masks for request in asked] == ["given", "given", "auto"]
    assert [request.cameras for request in asked] == ["auto", "auto", "auto"]
    redecoupled = jobs._job_context(infos[1]["id"])
    assert redecoupled.parameters["built_preset"] == "draft" and redecoupled.dataset == service.settings.sample_capture.resolve()


@pytest.fixture(scope="module")
def with_asset(lasting_service: Service) -> Service:
    lasting_service.add_asset(ASSET)
    return lasting_service


CAMERA = {"name": "a", "world_from_camera": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}

VIEW = {"eye": [0, -3, 1], "target": [0, 0, 0]}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("request_", "status", "words"),
    [
        ({"kind": "launch"}, 422, "expected one of build"),
        ({"kind": ["build"]}, 422, "expected one of build"),
        (RENDER | {"asset": "b" * 32}, 404, "No asset"),
        ({"kind": "redecouple", "asset": ASSET}, 409, "built here"),
        ({"dataset": "sample", "binding": "glue"}, 422, "binding"),
        ({"dataset": "sample", "up": [0, 0, 0]}, 422, "expected a direction"),
        ({"dataset": "sample", "up": [0, 1]}, 422, "up"),
        ({"dataset": "sample", "box": {"low": [0, 0, 0], "high": [1, 0, 1]}}, 422, "below that of high"),
        ({"dataset": "sample", "box": [0, 0, 0, 1, 1, 1]}, 422, "box"),
        ({"dataset": "capture:" + "0" * 32}, 404, "No capture"),
        ({"kind": "pose", "dataset": "capture:" + "0" * 32}, 404, "No capture"),
        ({"kind": "pose", "dataset": "/etc"}, 403, "not below one"),
        ({"dataset": "capture:../token"}, 404, "No capture"),
        ({"kind": "simulate", "asset": ASSET, "scene": {"gravity": "much"}}, 422, "gravity"),
        ({"kind": "export", "asset": ASSET, "formats": ["glb", "glb"]}, 422, "once"),
        ({"kind": "export", "asset": ASSET, "formats": ["glb"], "faces": 3}, 422, "faces"),
        ({"kind": "export", "asset": ASSET, "formats": ["ply"], "variants": [{"name": "a", "edits": []}]}, 422, "expected glb, mesh, html"),
        ({"kind": "export", "asset": ASSET, "formats": ["glb"], "variants": [{"name": "a", "edits": []}] * 2}, 422, "the same name"),
        ({"kind": "export", "asset": ASSET, "formats": ["ply", "env"], "faces": 100}, 422, "no textures; expected glb, mesh, usdz, usd"),
        (RENDER | {"environments": ["none.exr"]}, 422, "No environment"),
        (RENDER | {"environments": ["../token"]}, 422, "environments"),
        (RENDER | {"cameras": [CAMERA], "turntable": {}}, 422, "found cameras and turntable"),
        (RENDER | {"path": {"keyframes": [VIEW, VIEW]}, "turntable": {}}, 422, "found turntable and path"),
        (RENDER | {"path": {"keyframes": [VIEW]}}, 422, "keyframes"),
        (RENDER | {"path": {"keyframes": [VIEW, VIEW | {"target": VIEW["eye"]}]}}, 422, "same point"),
        (RENDER | {"path": {"keyframes": [VIEW, *3 * [VIEW | {"seconds": 600}]]}, "video_fps": 24}, 422, "at most 20000"),
        (RENDER | {"cameras": [CAMERA, CAMERA | {"name": "A"}]}, 422, "same name"),
        (RENDER | {"cameras": [CAMERA | {"name": "../a"}]}, 422, "name"),
        (RENDER | {"width": 4096, "height": 4096, "spp": 60000}, 422, "fewer pixels"),
        (RENDER | {"clip": "clips/" + "0" * 32}, 422, "no clip"),
        (RENDER | {"variants": [{"name": "v", "edits": [{"op": "deform", "vertices": "/etc/passwd"}]}]}, 422, "vertices"),
        (RENDER | {"variants": [{"name": "v", "edits": [{"op": "pose", "clip": "../x", "time": 0}]}]}, 422, "no clip"),
        (RENDER | {"limits": {"memory_bytes": 1}}, 422, "memory_bytes"),
    ],
)
def test_a_wrong_request_is_refused(with_asset: Service, request_: dict, status: int, words: str) -> None:
    assert words in is_problem(with_asset.client.post("/api/jobs", json=request_), status)
    assert with_asset.client.get("/api/jobs").json()["total"] == 0


def test_results_are_listed_downloaded_in_ranges_and_deleted_with_their_job(service: Service) -> None:
    service.add_asset(ASSET)
    job = service.client.post("/api/jobs", json=RENDER).json()["id"]
    url, folder = f"/api/jobs/{job}", service.context.directory.job_files(job)
    assert service.client.get(f"{url}/files").json() == {"files": []} and service.client.get(f"{url}/log").text == ""
    folder.mkdir(parents=True)
    (folder / "a.png").write_bytes(b"0123456789")
    (folder / "b.part").write_bytes(b"half")
    assert service.client.get(f"{url}/files").json()["files"] == [{"name": "a.png", "bytes": 10, "media_type": "image/png"}]
    part = service.client.get(f"{url}/files/a.png", headers={"Range": "bytes=2-4"})
    assert (part.status_code, part.content) == (206, b"234") and "attachment" in part.headers["content-disposition"]
    for name in ("..%2F..%2Ftoken", "none.png", ".lock"):
        assert service.client.get(f"{url}/files/{name}").status_code == 404
    assert "cancel it first" in is_problem(service.client.delete(url), 409)
    service.client.post(f"{url}/cancel")
    assert service.client.delete(url).status_code == 204
    assert not folder.exists() and service.client.get(url).status_code == 404


TILTED = [[1, 0, 0, 0], [0, 1, 0.2, 0], [0, 0, 1, 3], [0, 0, 0, 1]]
MIRRORED = [[-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 3], [0, 0, 0, 1]]
TWICE = [[2, 0, 0, 0], [0, 2, 0, 0], [0, 0, 2, 3], [0, 0, 0, 1]]
FLAT = [[0] * 4] * 4
PROJECTIVE = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 3], [0, 0, 0.5, 1]]
FAR = [[1, 0, 0, 1e30], [0, 1, 0, 0], [0, 0, 1, 3], [0, 0, 0, 1]]


@pytest.mark.parametrize("matrix", [TILTED, MIRRORED, TWICE, FLAT, PROJECTIVE, FAR])
def test_a_render_refuses_cameras_that_are_not_rigid(matrix: list, with_asset: Service) -> None:
    response = with_asset.client.post("/api/jobs", json=RENDER | {"cameras": [{"name": "a", "world_from_camera": matrix}]})
    assert response.status_code == 422, response.text
    assert "world_from_camera" in response.json()["detail"] or "cameras" in response.json()["detail"]
    query = ",".join(str(number) for row in matrix for number in row)
    session = with_asset.client.post("/api/sessions", json={"asset": ASSET}).json()["id"]
    assert with_asset.client.get(f"/api/sessions/{session}/frame.jpg", params={"world_from_camera": query}).status_code == 422


def test_a_capture_that_a_job_made_outlives_the_job(service: Service) -> None:
    job = service.client.post("/api/jobs", json={"kind": "pose", "dataset": "sample"}).json()
    assert job["capture_id"] is None, "not before it is done"
    place = service.context.directory.uploads / job["id"]
    place.mkdir()
    (place / "transforms.json").write_text("{}")
    with Session(service.context.engine) as session, session.begin():
        session.add(CaptureRow(id=job["id"], name="Sample, posed", created_at=now(), folder=job["id"]))
    service.client.post(f"/api/jobs/{job['id']}/cancel")
    assert service.client.delete(f"/api/jobs/{job['id']}").status_code == 204
    assert service.client.get(f"/api/captures/{job['id']}").json()["name"] == "Sample, posed" and place.is_dir()
    # Of one whose capture came with it nothing stays.
    other = service.client.post("/api/jobs", json={"dataset": "sample"}).json()
    (service.context.directory.uploads / other["id"]).mkdir()
    service.client.post(f"/api/jobs/{other['id']}/cancel")
    service.client.delete(f"/api/jobs/{other['id']}")
    assert not (service.context.directory.uploads / other["id"]).exists()
