"""The edit log: ordered, undoable, on disk before it is acknowledged, and the same after a replay."""

import asyncio
import random

import pytest
from conftest import Service
from hypothesis import given, settings
from hypothesis import strategies as st

from drgs.scene.edits import parse_edits
from server.edit_log import EditLog, NothingToDo


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


def test_edits_of_one_drag_are_one_step(service: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("server.sessions.COALESCE_SECONDS", 60.0)  # a busy machine may need longer than half a second
    session_id = service.open_session()
    sessions = service.context.sessions

    async def drag() -> None:
        session = await sessions.get(session_id)
        for edit in EDITS[:5]:
            await sessions.apply(session, "edit", edit, coalesce="roughness")
        assert session.log.done == (EDITS[4],) and session.log.revision == 5
        await sessions.apply(session, "edit", EDITS[5], coalesce="metallic")
        assert session.log.done == (EDITS[4], EDITS[5])
        await sessions.apply(session, "undo")
        await sessions.apply(session, "edit", EDITS[6], coalesce="metallic")
        assert session.log.done == (EDITS[4], EDITS[6])

    service.client.portal.call(drag)


def test_concurrent_edits_get_one_order(service: Service) -> None:
    session_id = service.open_session()
    sessions = service.context.sessions

    async def crowd() -> list[int]:
        session = await sessions.get(session_id)
        answers = await asyncio.gather(*(sessions.apply(session, "edit", edit) for edit in EDITS))
        assert [len(answer.edits) for answer in answers] == [answer.revision for answer in answers]
        return [answer.revision for answer in answers]

    assert sorted(service.client.portal.call(crowd)) == list(range(1, 11))
