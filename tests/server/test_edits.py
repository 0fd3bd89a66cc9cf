"""The edit log: ordered, undoable, on disk before it is acknowledged, and the same after a replay."""

import asyncio
import random
import threading
import time
from pathlib import Path

import pytest
from conftest import Service
from hypothesis import given, settings
from hypothesis import strategies as st

from drgs.scene.edits import Edit, parse_edits
from drgs_server.live import sessions
from drgs_server.live.edit_log import ChangeQueue, ChangeRequest, EditLog, EventKind, NothingToDo, Splice
from tests.count_calls import count_calls


def material(roughness: float) -> dict:
    return {"op": "material", "select": {"all": True}, "set": {"roughness": roughness}, "mode": "absolute"}


EDITS = parse_edits([material(k / 10) for k in range(10)])


def test_undo_takes_the_last_edit_away_and_redo_brings_it_back() -> None:
    log = EditLog().after("edit", EDITS[0]).after("edit", EDITS[1])
    undone = log.after("undo")
    assert undone.done == (EDITS[0],) and undone.revision == 3
    assert undone.after("redo").done == log.done


def test_a_new_edit_forgets_what_was_undone() -> None:
    log = EditLog().after("edit", EDITS[0]).after("undo").after("edit", EDITS[1])
    assert log.done == (EDITS[1],)
    with pytest.raises(NothingToDo, match="nothing to redo"):
        log.after("redo")


@pytest.mark.slow
@given(st.lists(st.sampled_from(["edit", "replace", "undo", "redo"]), max_size=40))
@settings(max_examples=60, deadline=None)
def test_the_log_behaves_like_two_stacks(kinds: list[str]) -> None:
    log, done, undone, count = EditLog(), [], [], 0
    for kind in kinds:
        edit = EDITS[count % 10]
        try:
            log = log.after(kind, edit if kind in ("edit", "replace") else None)  # type: ignore[arg-type]
        except NothingToDo:
            assert not (done if kind in ("undo", "replace") else undone)
            continue
        count += 1
        if kind == "edit":
            done.append(edit)
            undone.clear()
        elif kind == "replace":
            done[-1] = edit
            undone.clear()
        elif kind == "undo":
            undone.append(done.pop())
        else:
            done.append(undone.pop())
        assert (log.done, log.undone, log.revision) == (tuple(done), tuple(undone), count)


def test_a_change_of_a_long_log_takes_as_many_steps_as_that_of_a_short_one() -> None:
    def change(log: EditLog, kind: EventKind, edit: Edit | None = None) -> None:
        after = log.after(kind, edit)
        after.change_since(log).model_dump_json()

    taken: dict[str, list[int]] = {}
    for length in (64, 2000):
        log = EditLog()
        for number in range(length):
            log = log.after("edit", EDITS[number % 10])
        half = log
        for _ in range(length // 2):
            half = half.after("undo")
        for name, start, kind, edit in (
            ("edit", log, "edit", EDITS[3]), ("undo", log, "undo", None), ("replace", log, "replace", EDITS[4]),
            ("undo again", half, "undo", None), ("redo", half, "redo", None), ("edit instead", half, "edit", EDITS[3]),
        ):  # fmt: skip
            taken.setdefault(name, []).append(count_calls(lambda start=start, kind=kind, edit=edit: change(start, kind, edit)))
    # Where lists part is found by halving: a few steps more, not as many as there are edits.
    assert all(long < 2 * short for short, long in taken.values()), taken


@pytest.mark.slow
def test_edits_over_rest_are_numbered_and_undone(service: Service) -> None:
    url = f"/api/sessions/{service.open_session()}"
    for k in (1, 2, 3):
        answer = service.client.post(f"{url}/edits", json={"edit": material(k / 10)}).json()
        assert answer["revision"] == k and len(answer["edits"]) == k
    answer = service.client.post(f"{url}/undo").json()
    assert (answer["revision"], len(answer["edits"]), answer["can_redo"]) == (4, 2, True)
    assert service.client.post(f"{url}/redo").json()["edits"][2]["set"]["roughness"] == 0.3
    for _ in range(3):
        service.client.post(f"{url}/undo")
    response = service.client.post(f"{url}/undo")
    assert response.status_code == 409 and response.json()["detail"] == "There is nothing to undo."


def test_an_edit_that_cannot_be_applied_leaves_the_log_alone(service: Service) -> None:
    url = f"/api/sessions/{service.open_session()}"
    service.client.post(f"{url}/edits", json={"edit": material(0.5)})
    response = service.client.post(f"{url}/edits", json={"edit": {"op": "deform", "map": {"type": "twist", "rate": 1}}})
    assert response.status_code == 422 and response.json()["detail"] == "This asset is made of stone."
    bad = service.client.post(f"{url}/edits", json={"edit": material(7.0)})
    assert bad.status_code == 422 and "0..1" in bad.json()["detail"]
    assert service.client.get(url).json()["revision"] == 1


def test_a_session_comes_back_from_its_log_in_another_process(service: Service) -> None:
    session = service.open_session()
    url = f"/api/sessions/{session}"
    chooser = random.Random(4)
    for k in range(30):
        kind = chooser.choice(["edits", "edits", "undo", "redo"])
        service.client.post(f"{url}/{kind}", json={"edit": material(k / 30)} if kind == "edits" else None)
    before = service.client.get(url).json()
    live = service.context.sessions._live[session].log
    service.context.sessions._live.clear()  # as after a crash: only the database is left
    assert service.client.get(url).json() == before
    assert service.context.sessions._live[session].log == live


def test_edits_of_one_drag_are_one_step(service: Service) -> None:
    session_id = service.open_session()
    sessions = service.context.sessions

    async def drag() -> None:
        session = await sessions.get(session_id)
        for edit in EDITS[:5]:
            await sessions.apply(session, ChangeRequest("edit", edit, gesture="roughness"))
        assert session.log.done == (EDITS[4],) and session.log.revision == 5
        await sessions.apply(session, ChangeRequest("edit", EDITS[5], gesture="metallic"))
        assert session.log.done == (EDITS[4], EDITS[5])
        await sessions.apply(session, ChangeRequest("undo"))
        await sessions.apply(session, ChangeRequest("edit", EDITS[6], gesture="metallic"))
        assert session.log.done == (EDITS[4], EDITS[6])

    service.client.portal.call(drag)


def test_concurrent_edits_get_one_order(service: Service) -> None:
    session_id = service.open_session()
    sessions = service.context.sessions

    async def crowd() -> list[int]:
        session = await sessions.get(session_id)
        answers = await asyncio.gather(*(sessions.apply(session, ChangeRequest("edit", edit)) for edit in EDITS))
        assert [len(answer.log.edits) for answer in answers] == [answer.revision for answer in answers]
        return [answer.revision for answer in answers]

    assert sorted(service.client.portal.call(crowd)) == list(range(1, 11))


def roughnesses(answer: dict) -> list[float]:
    return [edit["set"]["roughness"] for edit in answer["edits"]]


def test_a_change_sent_again_under_its_key_is_applied_once(service: Service) -> None:
    url = f"/api/sessions/{service.open_session()}"

    def send(call: str, key: str, body: dict | None = None) -> dict:
        response = service.client.post(f"{url}/{call}", json=body, headers={"Idempotency-Key": key})
        assert response.status_code == 200, response.text
        return response.json()

    for _ in range(3):
        assert send("edits", "first", {"edit": material(0.1)})["revision"] == 1
    assert len(send("edits", "second", {"edit": material(0.2)})["edits"]) == 2
    for _ in range(2):
        assert send("undo", "third")["revision"] == 3
    service.context.sessions._live.clear()  # keys are known after a crash, too
    assert send("edits", "first", {"edit": material(0.1)})["revision"] == 3
    assert roughnesses(service.client.get(url).json()) == [0.1]


def test_a_snapshot_is_restored_as_one_step_of_undo_and_survives_a_crash(service: Service) -> None:
    url = f"/api/sessions/{service.open_session()}"
    for value in (0.1, 0.2):
        service.client.post(f"{url}/edits", json={"edit": material(value)})
    taken = service.client.put(f"{url}/snapshots/two rough").json()
    assert (taken["name"], taken["revision"], roughnesses(taken)) == ("two rough", 2, [0.1, 0.2])
    service.client.post(f"{url}/edits", json={"edit": material(0.3)})
    service.context.sessions._live.clear()
    restored = service.client.post(f"{url}/snapshots/two rough/restore").json()
    assert (restored["revision"], restored["edits"]) == (4, taken["edits"])
    service.client.post(f"{url}/edits", json={"edit": material(0.4)})
    service.context.sessions._live.clear()
    assert service.client.post(f"{url}/undo").json()["edits"] == taken["edits"]
    assert roughnesses(service.client.post(f"{url}/undo").json()) == [0.1, 0.2, 0.3]
    assert service.client.post(f"{url}/redo").json()["edits"] == taken["edits"]
    assert [found["name"] for found in service.client.get(f"{url}/snapshots").json()["snapshots"]] == ["two rough"]
    assert service.client.delete(f"{url}/snapshots/two rough").status_code == 204
    missing = service.client.post(f"{url}/snapshots/two rough/restore")
    assert missing.status_code == 404 and "no snapshot" in missing.json()["detail"]


@pytest.mark.slow
def test_many_edits_undone_and_redone_end_as_their_replay_does(service: Service) -> None:
    session_id, sessions, chooser = service.open_session(), service.context.sessions, random.Random(7)

    async def soak() -> None:
        session = await sessions.get(session_id)
        for _ in range(600):
            kind = chooser.choices(["edit", "undo", "redo"], [6, 3, 1])[0]
            usable = {"undo": session.log.entries, "redo": session.log.undone}.get(kind, True)
            takes_edit = kind == "edit" or not usable
            request = ChangeRequest("edit", chooser.choice(EDITS)) if takes_edit else ChangeRequest(kind)  # type: ignore[arg-type]
            await sessions.apply(session, request)
        assert session.log.revision == 600
        assert sessions._store.read(session_id).log == session.log

    service.client.portal.call(soak)


def test_a_server_with_assets_prepares_its_renderer(tmp_path: Path) -> None:
    first = Service(tmp_path)
    with first.client:
        first.add_asset()
    again = Service(tmp_path)
    with again.client:
        pass
    assert (first.painter.prepared, again.painter.prepared) == (0, 1)


def test_what_brings_an_asset_prepares_the_renderer_once(service: Service) -> None:
    for _ in range(2):
        service.client.post("/api/assets", files={"file": ("a.obj", b"v")})
    assert service.painter.prepared == 1


def test_a_build_that_waits_prepares_the_renderer(service: Service) -> None:
    assert service.client.post("/api/jobs", json={"kind": "build", "dataset": "sample"}).status_code == 202
    assert service.painter.prepared == 1


@pytest.mark.slow
def test_a_long_pose_of_one_session_does_not_hold_up_the_pictures_of_another(service: Service) -> None:
    slow = service.open_session()
    quick = service.client.post("/api/sessions", json={"asset": "a" * 32}).json()["id"]
    service.client.get(f"/api/sessions/{quick}/frame.png?width=16&height=16&spp=4")
    service.painter.pose_seconds = 1.0
    poser = threading.Thread(target=lambda: service.client.post(f"/api/sessions/{slow}/edits", json={"edit": material(0.2)}))
    poser.start()
    time.sleep(0.1)
    assert service.client.get(f"/api/sessions/{quick}/frame.png?width=16&height=16&spp=4").status_code == 200
    assert poser.is_alive()
    poser.join()
    assert service.client.get(f"/api/sessions/{slow}").json()["revision"] == 1


def test_a_session_that_another_server_changed_is_not_overwritten(tmp_path: Path) -> None:
    one, two = Service(tmp_path), Service(tmp_path)
    with one.client, two.client:
        url = f"/api/sessions/{one.open_session()}"
        two.client.get("/api/sessions")  # a list keeps nothing
        assert one.client.post(f"{url}/edits", json={"edit": material(0.1)}).json()["revision"] == 1
        assert two.client.post(f"{url}/edits", json={"edit": material(0.2)}).json()["revision"] == 2
        stale = one.client.post(f"{url}/edits", json={"edit": material(0.3)})
        assert stale.status_code == 409 and "open it again" in stale.json()["detail"]
        again = one.client.post(f"{url}/edits", json={"edit": material(0.4)}).json()
        assert again["revision"] == 3 and roughnesses(again) == [0.1, 0.2, 0.4]


def test_what_another_server_deleted_is_neither_edited_nor_shown_here(tmp_path: Path) -> None:
    one, two = Service(tmp_path), Service(tmp_path)
    with one.client, two.client:
        session = one.open_session()
        url = f"/api/sessions/{session}"
        assert one.client.post(f"{url}/edits", json={"edit": material(0.1)}).status_code == 200
        assert two.client.delete(f"/api/assets/{'a' * 32}").status_code == 204
        refused = one.client.post(f"{url}/edits", json={"edit": material(0.2)})
        assert refused.status_code == 404 and "was deleted" in refused.json()["detail"]
        assert one.client.get(url).status_code == 404
        two.client.post(f"/api/assets/{'a' * 32}/undelete")
        assert roughnesses(one.client.get(url).json()) == [0.1]
        two.client.delete(f"/api/assets/{'a' * 32}")
        live = one.context.sessions._live[session]
        one.client.portal.call(one.context.sessions.forget_deleted)
        assert live.gone.is_set() and one.client.get(f"{url}/frame.png?width=16&height=16&spp=4").status_code == 404


def test_a_splice_is_one_step_of_undo_and_says_what_undo_and_redo_take_one_by_one() -> None:
    a, b, c, d, e, *_ = EDITS
    log = EditLog()
    for edit in (a, b, c):
        log = log.after("edit", edit)
    assert log.appended == 3
    spliced = log.after("splice", Splice(1, 1, (d, e)))
    assert spliced.done == (a, d, e, c) and spliced.appended == 0
    again = spliced.after("replace", Splice(1, 2, ()))
    assert again.done == (a, c) and again.after("undo").done == (a, b, c)
    longer = again.after("edit", b)
    assert longer.done == (a, c, b) and longer.appended == 1
    back = longer.after("undo")
    assert back.message().undone == [b]
    assert back.after("undo").message().undone == [], "redo would bring a splice back, which appends nothing"
    with pytest.raises(ValueError, match="up to number 4, but 3 are in force"):
        log.after("splice", Splice(2, 2, ()))


def test_edits_put_in_place_of_others_come_back_after_a_crash_and_not_over_newer_ones(service: Service) -> None:
    session = service.open_session()
    first = service.client.post(f"/api/sessions/{session}/edits", json={"edit": material(0.1)}).json()
    wanted = {"edits": [material(0.2), material(0.3)], "revision": first["revision"]}
    put = service.client.put(f"/api/sessions/{session}/edits", json=wanted)
    assert roughnesses(put.json()) == [0.2, 0.3] and put.json()["appended"] == 0
    late = service.client.put(f"/api/sessions/{session}/edits", json=wanted)
    assert late.status_code == 409 and "changed meanwhile" in late.json()["detail"]
    service.context.sessions._live.clear()  # as after a crash: only the database is left
    replayed = service.client.get(f"/api/sessions/{session}").json()
    assert roughnesses(replayed) == [0.2, 0.3] and replayed["revision"] == 2


def test_a_change_replaces_the_newest_of_its_gesture_in_the_log_and_no_other() -> None:
    drag = [ChangeRequest("edit", edit, gesture="drag") for edit in EDITS[:3]]
    log = EditLog().with_request(drag[0]).with_request(drag[1])
    assert (log.done, log.revision, log.event_of(drag[2])) == ((EDITS[1],), 2, "replace")
    for between in (ChangeRequest("edit", EDITS[5]), ChangeRequest("edit", EDITS[5], gesture="other"), ChangeRequest("undo")):
        assert log.with_request(between).event_of(drag[2]) == "edit"
    splice = ChangeRequest("splice", Splice(0, 1, (EDITS[4],)), gesture="drag")
    assert log.event_of(splice) == "splice", "a splice is a step of its own beside an edit"
    assert log.with_request(splice).event_of(splice) == "replace"
    assert EditLog().after("edit", EDITS[0]).event_of(drag[1]) == "edit", "a gesture ends with the process"


def test_a_change_that_waits_gives_its_place_to_the_next_of_its_gesture_and_both_are_answered() -> None:
    def edit(number: int, gesture: str | None = None, key: str | None = None) -> ChangeRequest:
        return ChangeRequest("edit", EDITS[number], gesture, key)

    async def walk() -> None:
        queue = ChangeQueue(room=6)
        splices = [ChangeRequest("splice", Splice(0, 0, ()), "film", revision=revision) for revision in (3, 4)]
        requests = [edit(0, "a"), edit(1, "a"), edit(2, "b", "kept"), edit(3, "b"), edit(4), ChangeRequest("undo"), *splices[:1]]
        for number, request in enumerate(requests):
            await queue.put(request, number)
        late = asyncio.create_task(queue.put(splices[1], 7))
        await asyncio.sleep(0)
        assert not late.done(), "there is room for six"
        taken = [await queue.take() for _ in range(6)]
        await late
        taken.append(await queue.take())
        await queue.close()
        assert [(waiting.message_ids, waiting.request) for waiting in taken if waiting] == [
            ((0, 1), requests[1]), ((2,), requests[2]), ((3,), requests[3]), ((4,), requests[4]), ((5,), requests[5]), ((6,), splices[0]),
            ((7,), splices[1]),
        ]  # fmt: skip
        assert await queue.take() is None

    asyncio.run(walk())


def test_a_long_log_is_opened_from_what_was_kept_of_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sessions, "LONG_LOG", 8)
    monkeypatch.setattr(sessions, "KEEP_EVERY", 4)
    service = Service(tmp_path)
    with service.client:
        session = service.open_session()
        for _ in range(10):
            assert service.client.post(f"/api/sessions/{session}/edits", json={"edit": material(0.5)}).status_code == 200
    again = Service(tmp_path)
    with again.client:
        assert again.client.get(f"/api/sessions/{session}/frame.png?width=16&height=16&spp=4").status_code == 200
        assert again.painter.recalled == [8], "the newest multiple of four"
        assert again.client.delete(f"/api/sessions/{session}").status_code == 204
        assert not list(again.context.directory.poses.iterdir())
