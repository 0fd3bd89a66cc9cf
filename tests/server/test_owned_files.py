"""What sessions refer to is theirs: it is not deleted under them, and where it is gone all the same, only its edit is lost."""

import json
import shutil
import uuid
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import pytest
from conftest import Service
from painter import PaintedAsset, PaintedPose, Painter
from sqlalchemy import text
from sqlalchemy.orm import Session
from test_edits import material
from test_rest import is_problem
from test_stream import talk

from drgs.scene.edits import Edit, EnvironmentEdit, PoseEdit, UnreadableEdit, parse_edits
from drgs_server.api.problems import ProblemError
from drgs_server.api.routes import assets
from drgs_server.live.pose_edits import pose_edits
from drgs_server.render.interface import AbstractPose
from drgs_worker.store.database import JobRow, now


class Reader(Painter):
    """Needs the files that edits name."""

    def load(self, folder: Path, environments: Path) -> "ReadAsset":
        return ReadAsset(self, environments)


class ReadAsset(PaintedAsset):
    def __init__(self, painter: Painter, files: Path) -> None:
        super().__init__(painter)
        self.files = files

    def pose(self, edits: Sequence[Edit], previous: AbstractPose | None, go_on: Callable[[], None] | None = None) -> PaintedPose:
        for edit in edits:
            if isinstance(edit, UnreadableEdit):
                raise ValueError("an edit that is none")
            name = edit.clip if isinstance(edit, PoseEdit) else edit.file if isinstance(edit, EnvironmentEdit) else None
            if name is not None and not (self.files / name).exists():
                raise ValueError(f"{name}: does not exist")
        return super().pose(edits, previous, go_on)


@pytest.fixture
def service(tmp_path: Path) -> Iterator[Service]:
    service = Service(tmp_path, Reader())
    with service.client:
        yield service


def simulated(service: Service) -> str:
    """The id of a simulate job that is over, and made a clip."""
    job_id = uuid.uuid4().hex
    folder = service.context.directory.clip(job_id)
    folder.mkdir(parents=True)
    (folder / "clip.json").write_text("{}")
    with Session(service.context.engine) as session, session.begin():
        session.add(JobRow(id=job_id, kind="simulate", name="jelly", dataset="", preset="", seed=0, created_at=now(), finished_at=now()))
    return job_id


def pose(job_id: str, time: float = 0.0) -> dict:
    return {"op": "pose", "clip": f"clips/{job_id}", "time": time}


def test_a_clip_is_not_deleted_while_a_session_may_show_it(service: Service) -> None:
    job = simulated(service)
    session = service.open_session()
    url = f"/api/sessions/{session}"
    service.client.post(f"{url}/edits", json={"edit": pose(job)})
    for change in ("undo", "redo", "undo"):
        assert session in is_problem(service.client.delete(f"/api/jobs/{job}"), 409)
        assert service.client.post(f"{url}/{change}").status_code == 200
    service.context.sessions._live.clear()  # who owns what is in the database
    assert session in is_problem(service.client.delete(f"/api/jobs/{job}"), 409)
    assert service.client.post(f"{url}/edits", json={"edit": material(0.5)}).status_code == 200  # nothing brings the clip back now
    service.client.post(f"{url}/edits", json={"edit": pose(job)})
    assert service.client.put(f"{url}/snapshots/moving").status_code == 200
    service.client.post(f"{url}/undo")
    service.client.post(f"{url}/edits", json={"edit": material(0.6)})
    assert session in is_problem(service.client.delete(f"/api/jobs/{job}"), 409)
    assert service.client.delete(f"{url}/snapshots/moving").status_code == 204
    assert service.client.delete(f"/api/jobs/{job}").status_code == 204
    assert service.client.get(url).json()["revision"] == 8


def test_what_a_waiting_job_needs_is_not_deleted(service: Service) -> None:
    job, asset = simulated(service), service.add_asset()
    for body in ({"clip": f"clips/{job}"}, {"variants": [{"name": "moved", "edits": [pose(job)]}]}):
        waiting = service.client.post("/api/jobs", json={"kind": "render", "asset": asset, **body}).json()["id"]
        assert waiting in is_problem(service.client.delete(f"/api/jobs/{job}"), 409)
        service.client.post(f"/api/jobs/{waiting}/cancel")
    assert service.client.delete(f"/api/jobs/{job}").status_code == 204


def lose_clip(service: Service) -> tuple[str, dict]:
    """A session whose second edit of three has lost its file, as it is after a crash."""
    job = simulated(service)
    session = service.open_session()
    for edit in (material(0.1), pose(job), material(0.3)):
        assert service.client.post(f"/api/sessions/{session}/edits", json={"edit": edit}).status_code == 200
    assert service.client.put(f"/api/sessions/{session}/snapshots/all").status_code == 200
    shutil.rmtree(service.context.directory.clip(job))
    service.context.sessions._live.clear()
    return session, pose(job)


def test_an_edit_whose_file_is_gone_is_skipped_and_taken_out_like_any_other(service: Service) -> None:
    session, lost = lose_clip(service)
    url = f"/api/sessions/{session}"
    assert service.client.get(f"{url}/frame.png?width=16&height=16&spp=4").status_code == 200
    with talk(service, session) as stream:
        (broken,) = stream.text("hello")["log"]["broken"]
    assert broken["index"] == 1 and "There is no clip" in broken["reason"]
    answer = service.client.post(f"{url}/edits", json={"edit": material(0.4)}).json()
    assert [found["index"] for found in answer["broken"]] == [1] and len(answer["edits"]) == 4
    is_problem(service.client.post(f"{url}/edits", json={"edit": pose("0" * 32)}), 422)
    assert service.client.post(f"{url}/undo").json()["broken"] == answer["broken"]
    without_first = service.client.put(f"{url}/edits", json={"edits": [lost, material(0.3)]}).json()
    assert [found["index"] for found in without_first["broken"]] == [0]
    assert service.client.put(f"{url}/edits", json={"edits": [material(0.3)]}).json()["broken"] == []
    restored = service.client.post(f"{url}/snapshots/all/restore").json()
    assert len(restored["edits"]) == 3 and [found["index"] for found in restored["broken"]] == [1]
    assert service.client.get(url).json()["broken"] == restored["broken"]
    assert service.client.put(f"{url}/edits", json={"edits": []}).json()["edits"] == []


def test_exports_and_versions_leave_broken_edits_out(service: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    session, _ = lose_clip(service)
    written: list[list[dict]] = []

    async def tool(_: object, __: object, ___: object, kind: str, source: str, out: str, *rest: str) -> None:
        written.append(json.loads(Path(rest[0] if kind == "version" else rest[2]).read_text()))
        if kind == "version":
            shutil.copytree(source, out)
        else:
            Path(out).write_bytes(b"glTF")

    monkeypatch.setattr(assets, "_run_tool", tool)
    assert service.client.get(f"/api/sessions/{session}/export?format=glb").content == b"glTF"
    service.context.sessions._live.clear()
    saved = service.client.post(f"/api/sessions/{session}/save").json()
    assert [[edit["set"]["roughness"] for edit in edits] for edits in (*written, saved["edits"])] == [[0.1, 0.3]] * 3


def test_a_live_session_survives_the_loss_of_a_file(service: Service) -> None:
    job = simulated(service)
    url = f"/api/sessions/{service.open_session()}"
    service.client.post(f"{url}/edits", json={"edit": pose(job)})
    shutil.rmtree(service.context.directory.clip(job))
    answer = service.client.post(f"{url}/edits", json={"edit": material(0.5)})
    assert answer.status_code == 200 and [found["index"] for found in answer.json()["broken"]] == [0]
    assert service.client.post(f"{url}/undo").status_code == 200


class Choosy:
    """Refuses materials of some roughness, as another version of the program may."""

    def __init__(self, refused: set[float]) -> None:
        self.refused, self.poses = refused, 0

    def pose(self, edits: Sequence[Edit]) -> PaintedPose:
        self.poses += 1
        for edit in edits:
            if edit.set.roughness in self.refused:  # type: ignore[union-attr]
                raise ValueError(f"roughness {edit.set.roughness} is not for this object")  # type: ignore[union-attr]
        return PaintedPose(Painter(), len(edits))


def test_all_edits_that_fail_are_found_by_halving_and_a_new_one_is_refused() -> None:
    edits = parse_edits([material(k / 1000) for k in range(200)])
    asset = Choosy({0.0, 0.077, 0.199})
    posed = pose_edits(asset.pose, edits, lambda _: False, lambda _: None)
    assert posed.broken == {k: f"roughness {k / 1000} is not for this object." for k in (0, 77, 199)}
    assert posed.pose.edit_count == 197 and asset.poses < 40  # type: ignore[attr-defined]
    with pytest.raises(ValueError, match=r"0\.199"):
        pose_edits(asset.pose, edits, lambda edit: edit is edits[199], lambda _: None)


@pytest.mark.parametrize("status", [429, 503])
def test_what_passes_breaks_no_edit(status: int) -> None:
    def pose(edits: Sequence[Edit]) -> PaintedPose:
        raise ProblemError(status, "Try again in a moment.")

    with pytest.raises(ProblemError, match="again"):
        pose_edits(pose, parse_edits([material(0.1)]), lambda _: False, lambda _: None)


def spoil(service: Service, table: str, column: str, value: str, where: str) -> None:
    """As another version, or a slip of somebody's, may have left it."""
    with service.context.engine.begin() as connection:
        connection.execute(text(f"UPDATE {table} SET {column} = :value WHERE {where}"), {"value": value})
    service.context.sessions._live.clear()


UNREAD = ["5", "null", "[1, 2]", '{"op": "explode"}', '{"op": "material", "select": {"all": true}, "set": {"roughness": 7}}', '"x"']


@pytest.mark.parametrize("value", UNREAD)
def test_an_edit_that_this_version_does_not_read_is_skipped_and_taken_out_like_any_other(service: Service, value: str) -> None:
    session = service.open_session()
    url = f"/api/sessions/{session}"
    for roughness in (0.1, 0.2, 0.3):
        service.client.post(f"{url}/edits", json={"edit": material(roughness)})
    spoil(service, "session_events", "edit", value, f"session_id = '{session}' AND revision = 2")
    assert [found["id"] for found in service.client.get("/api/sessions").json()["sessions"]] == [session]
    assert service.client.get(f"{url}/frame.png?width=16&height=16&spp=4").status_code == 200
    found = service.client.get(url).json()
    assert [edit["op"] for edit in found["edits"]] == ["material", "unreadable", "material"] and found["revision"] == 3
    assert [broken["index"] for broken in found["broken"]] == [1] and "does not read it" in found["broken"][0]["reason"]
    assert service.client.put(f"{url}/snapshots/odd").status_code == 200
    taken_out = service.client.put(f"{url}/edits", json={"edits": [found["edits"][0], found["edits"][2]]}).json()
    assert taken_out["broken"] == [] and len(taken_out["edits"]) == 2
    assert [broken["index"] for broken in service.client.post(f"{url}/snapshots/odd/restore").json()["broken"]] == [1]
    is_problem(service.client.post(f"{url}/edits", json={"edit": found["edits"][1] | {"found": "{}"}}), 422)
    assert service.client.delete(url).status_code == 204


def test_a_log_that_is_none_hides_no_other_and_can_be_deleted(service: Service) -> None:
    whole = service.open_session()
    asset = service.client.get(f"/api/sessions/{whole}").json()["asset"]
    damaged = service.client.post("/api/sessions", json={"asset": asset}).json()["id"]
    for session in (whole, damaged):
        service.client.post(f"/api/sessions/{session}/edits", json={"edit": material(0.1)})
    for kind, value in (("redo", "null"), ("splice", '{"start": 5, "remove": 1, "edits": []}'), ("splice", "5"), ("edit", "no JSON")):
        spoil(service, "session_events", "edit", value, f"session_id = '{damaged}'")
        spoil(service, "session_events", "kind", kind, f"session_id = '{damaged}'")
        assert "delete it" in is_problem(service.client.get(f"/api/sessions/{damaged}"), 409)
        assert [found["id"] for found in service.client.get("/api/sessions").json()["sessions"]] == [whole]
    assert service.client.delete(f"/api/sessions/{damaged}").status_code == 204
    is_problem(service.client.delete(f"/api/sessions/{damaged}"), 404)


def test_what_was_done_to_an_asset_or_kept_in_a_snapshot_may_be_unreadable(service: Service) -> None:
    session = service.open_session()
    service.client.put(f"/api/sessions/{session}/snapshots/a")
    spoil(service, "session_snapshots", "edits", '[{"op": "explode"}]', "name = 'a'")
    spoil(service, "assets", "edits", '{"op": "explode"}', "1 = 1")
    (asset,) = service.client.get("/api/assets").json()["assets"]
    (snapshot,) = service.client.get(f"/api/sessions/{session}/snapshots").json()["snapshots"]
    assert [edit["op"] for edit in asset["edits"] + snapshot["edits"]] == ["unreadable"] * 2
    restored = service.client.post(f"/api/sessions/{session}/snapshots/a/restore").json()
    assert [broken["index"] for broken in restored["broken"]] == [0]
