"""Painted weights go up as a file, and edits refer to it."""

import os
import time
from pathlib import Path

import numpy as np
from conftest import Service
from sqlalchemy.orm import Session
from test_rest import is_problem

from drgs.scene.edits import parse_edits
from drgs_worker.store.database import JobRow, now
from drgs_worker.store.remove_unused import UNUSED_SECONDS, remove_unused_poses, remove_unused_weights


def painted(file: str) -> dict:
    return {"op": "material", "select": {"weights_file": file}, "set": {"roughness": 0.5}}


def grow_old(place: Path) -> None:
    os.utime(place, (time.time() - 2 * UNUSED_SECONDS,) * 2)


def test_weights_are_a_file_by_their_content_that_edits_refer_to(service: Service) -> None:
    weights = np.linspace(0, 1, 300_000, dtype="<f4").tobytes()
    url = f"/api/sessions/{service.open_session()}"
    stored = service.client.post("/api/weights", content=weights)
    assert stored.status_code == 201 and stored.json()["vertices"] == 300_000
    file = stored.json()["file"]
    assert service.client.post("/api/weights", content=weights).json()["file"] == file
    assert service.client.get(f"/api/{file}").content == weights
    edit = {"op": "material", "select": {"weights_file": file}, "set": {"roughness": 0.5}}
    log = service.client.post(f"{url}/edits", json={"edit": edit}).json()
    assert log["edits"][0]["select"]["weights_file"] == file
    assert service.anonymous.post("/api/weights", content=weights).status_code == 401


def test_wrong_weights_are_refused_with_a_sentence(service: Service) -> None:
    url = f"/api/sessions/{service.open_session()}/edits"
    for content, words in (
        (b"", "0 bytes"),
        (b"abc", "no multiple of 4"),
        (np.float32([0, np.nan]).tobytes(), "0..1"),
        (np.float32([1.5]).tobytes(), "0..1"),
    ):
        assert words in is_problem(service.client.post("/api/weights", content=content), 422)
    assert not (service.context.directory.environments / "weights").exists()
    is_problem(service.client.get(f"/api/weights/{'0' * 32}.f32"), 404)
    for name in (f"weights/{'0' * 32}.f32", "../token", "weights/../../token", "studio.exr"):
        edit = {"op": "material", "select": {"weights_file": name}, "set": {"roughness": 0.5}}
        assert "There are no weights" in is_problem(service.client.post(url, json={"edit": edit}), 422)


def test_weights_are_removed_a_day_after_nobody_names_them_and_never_before(service: Service) -> None:
    context = service.context
    url, folder = f"/api/sessions/{service.open_session()}", context.directory.environments / "weights"
    files = {
        name: service.client.post("/api/weights", content=np.float32([k / 9]).tobytes()).json()["file"]
        for k, name in enumerate(("shown", "undone", "kept", "job", "sent again", "named again", "young", "unused"))
    }
    for name in ("shown", "undone"):
        assert service.client.post(f"{url}/edits", json={"edit": painted(files[name])}).status_code == 200
    service.client.post(f"{url}/undo")
    other = f"/api/sessions/{service.client.post('/api/sessions', json={'asset': 'a' * 32}).json()['id']}"
    service.client.post(f"{other}/edits", json={"edit": painted(files["kept"])})
    assert service.client.put(f"{other}/snapshots/painted").status_code == 200
    with Session(context.engine) as session, session.begin():
        session.add(
            JobRow(
                id="b" * 32,
                kind="render",
                name="",
                dataset="",
                preset="",
                seed=0,
                created_at=now(),
                parameters={"edits": [painted(files["job"])]},
            )
        )
    for name, file in files.items():
        if name != "young":
            grow_old(folder.parent / file)
    changed = (folder.parent / files["sent again"]).stat().st_mtime_ns
    service.client.post("/api/weights", content=np.float32([4 / 9]).tobytes())
    assert (folder.parent / files["sent again"]).stat().st_mtime_ns == changed, "poses go by it"
    assert context.sessions.references.missing(parse_edits([painted(files["named again"])])[0]) is None
    assert remove_unused_weights(context.directory, context.engine) == 1
    assert {name for name, file in files.items() if not (folder.parent / file).exists()} == {"unused"}
    assert service.client.delete(url).status_code == 204
    for file in files.values():
        if (folder.parent / file).exists():
            grow_old(folder.parent / file)
    assert remove_unused_weights(context.directory, context.engine) == 5
    assert {name for name, file in files.items() if (folder.parent / file).exists()} == {"kept", "job"}


def test_kept_poses_of_sessions_that_are_gone_are_removed(service: Service) -> None:
    session, poses = service.open_session(), service.context.directory.poses
    for name in (session, "0" * 32):
        (poses / f"{name}.safetensors").write_bytes(b"kept")
    assert remove_unused_poses(service.context.directory, service.context.engine) == 1
    assert [path.stem for path in poses.iterdir()] == [session]
