"""The stream protocol, spoken by a test client to a server that paints."""

import asyncio
import io
import json
import os
import queue
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

import numpy as np
import pytest
from anyio import ClosedResourceError, EndOfStream
from conftest import Service
from painter import Painter, Painting
from PIL import Image
from sqlalchemy.orm import Session as Database
from starlette.websockets import WebSocketDisconnect

from drgs_server.live import messages, pace, stream
from drgs_server.live.frame_header import FLAG_ALPHA, FLAG_CONVERGED, FLAG_MOVING, FrameHeader, unpack_frame
from drgs_server.live.messages import CLOSE_TRY_AGAIN
from drgs_server.render import thread
from drgs_server.render.thread import MODESTY, give_way
from drgs_worker.store.database import AssetRow, now
from tests.patience import PATIENCE_SECONDS

IDENTITY = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 5], [0, 0, 0, 1]]


def camera(number: int = 0, x: float = 0.0, width: int = 64, height: int = 48) -> dict:
    matrix = [row[:] for row in IDENTITY]
    matrix[0][3] = x
    return {"type": "camera", "number": number, "world_from_camera": matrix, "fov_y_degrees": 40, "width": width, "height": height}


def material(roughness: float) -> dict:
    return {"op": "material", "select": {"all": True}, "set": {"roughness": roughness}}


class Talk:
    """One connection; frames are acknowledged as they come unless told otherwise."""

    def __init__(self, socket, acknowledge: bool = True) -> None:
        self.socket = socket
        self.acknowledge = acknowledge
        self.frames: list[tuple[FrameHeader, bytes]] = []
        self.texts: list[dict] = []
        self._received: queue.Queue = queue.Queue()
        threading.Thread(target=self._listen, daemon=True).start()

    def _listen(self) -> None:
        """The test client's own receive waits for ever; a test should not."""
        with suppress(ClosedResourceError, EndOfStream):
            while True:
                self._received.put(self.socket.receive())

    def send(self, **message: object) -> None:
        self.socket.send_json(message)

    def next(self) -> FrameHeader | dict:
        raw = self._received.get(timeout=PATIENCE_SECONDS)
        if raw["type"] == "websocket.close":
            raise WebSocketDisconnect(raw["code"], raw.get("reason"))
        if raw.get("bytes") is not None:
            header, picture = unpack_frame(raw["bytes"])
            self.frames.append((header, picture))
            if self.acknowledge:
                self.send(type="ack", frame_id=header.frame_id)
            return header
        self.texts.append(json.loads(raw["text"]))
        return self.texts[-1]

    def until(self, wanted: Callable[[FrameHeader | dict], bool]) -> FrameHeader | dict:
        start = time.monotonic()
        while time.monotonic() - start < PATIENCE_SECONDS:
            found = self.next()
            if wanted(found):
                return found
        raise AssertionError("waited too long")

    def text(self, kind: str) -> dict:
        return self.until(lambda found: isinstance(found, dict) and found["type"] == kind)  # type: ignore[return-value]

    def frame(self, flag: int = 0) -> FrameHeader:
        return self.until(lambda found: isinstance(found, FrameHeader) and (found.flags & flag or not flag))  # type: ignore[return-value]

    def pixels(self) -> np.ndarray:
        return np.asarray(Image.open(io.BytesIO(self.frames[-1][1])))


@contextmanager
def talk(service: Service, session: str, hello: dict | None = None, **options: bool) -> Iterator[Talk]:
    with service.client.websocket_connect(f"/api/sessions/{session}/stream", headers={"Host": "127.0.0.1:8000"}) as socket:
        conversation = Talk(socket, **options)
        conversation.send(type="hello", **{"v": 1, **(hello or {})})
        yield conversation


def test_a_page_that_takes_long_to_speak_may_come_again(service: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stream, "HELLO_SECONDS", 0.05)
    session = service.open_session()
    with service.client.websocket_connect(f"/api/sessions/{session}/stream", headers={"Host": "127.0.0.1:8000"}) as socket:
        with pytest.raises(WebSocketDisconnect) as closed:
            socket.receive_json()
        assert closed.value.code == CLOSE_TRY_AGAIN, "and no fatal error before it, after which a page gives up"


def test_hello_is_answered_with_all_that_a_client_needs(service: Service) -> None:
    session = service.open_session()
    with talk(service, session) as client:
        assert client.next()["phase"] == "loading"
        hello = messages.ServerHello.model_validate(client.text("hello"))
    assert (hello.session, hello.minimum, hello.maximum, hello.log.revision) == (session, (-1, -1, -1), (1, 1, 1), 0)
    assert hello.max_in_flight == 2


def test_another_version_is_told_so_and_let_go(service: Service) -> None:
    with talk(service, service.open_session(), {"v": 99}) as client:
        error = client.text("error")
        assert error["fatal"] and "99" in error["message"]
        with pytest.raises(WebSocketDisconnect) as closed:
            client.next()
    assert closed.value.code == 1002


def test_an_unknown_session_is_refused_with_a_sentence(service: Service) -> None:
    with talk(service, "0" * 32) as client:
        assert "No session" in client.text("error")["message"]


def test_the_picture_moves_then_refines_then_converges_and_then_nothing_is_sent(service: Service) -> None:
    with talk(service, service.open_session()) as client:
        client.send(type="settings", settings={"spp_target": 40})
        client.socket.send_json(camera(number=0x1FE))
        last = client.frame(FLAG_CONVERGED)
        first = client.frames[0][0]
        assert first.flags & FLAG_MOVING and first.spp == 4
        assert (last.spp, last.spp_target, last.width, last.height) == (40, 40, 64, 48)
        assert last.codec == 1 and last.flags >> 8 == 0xFE and last.render_us > 0
        assert [header.frame_id for header, _ in client.frames] == list(range(1, len(client.frames) + 1))
        samples = [header.spp for header, _ in client.frames]
        assert samples == sorted(samples)
        assert client.text("status")["phase"] in ("moving", "still", "converged")
        # The same camera again changes nothing, so the next thing that comes is the answer to the pick.
        client.socket.send_json(camera(number=0x1FE))
        time.sleep(0.5)
        count = len(client.frames)
        client.send(type="pick", id=5, x=0.25, y=0.5)
        picked = client.text("picked")
        assert picked["id"] == 5 and picked["hit"] and picked["position"][0] == 0.25
        assert len(client.frames) == count
        client.send(type="pick", id=6, x=0.75, y=0.5)
        assert not client.text("picked")["hit"]


def test_a_new_number_of_the_camera_marks_the_frames_that_show_new_settings(service: Service) -> None:
    with talk(service, service.open_session()) as client:
        client.send(type="settings", settings={"spp_target": 8})
        client.socket.send_json(camera(number=1))
        client.frame(FLAG_CONVERGED)
        # Even settings that change nothing: the frame that says so must come.
        client.send(type="settings", settings={"spp_target": 8})
        client.socket.send_json(camera(number=2))
        before = len(client.frames)
        last = client.frame(FLAG_CONVERGED)
        assert last.flags >> 8 == 2
        assert [header.flags >> 8 for header, _ in client.frames[before:]] == [2] * (len(client.frames) - before)


@pytest.mark.skipif(sys.platform != "linux", reason="threads have a priority of their own on Linux only")
def test_rendering_gives_way_to_what_answers(service: Service) -> None:
    def priority() -> int:
        return os.getpriority(os.PRIO_PROCESS, threading.get_native_id())

    assert service.context.render_thread.call(priority).result(10) == min(19, priority() + MODESTY)


def test_rendering_goes_on_where_priorities_are_forbidden(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    def refuse(*_: int) -> None:
        raise PermissionError("not in this sandbox")

    monkeypatch.setattr("drgs_server.render.thread.sys.platform", "linux")
    monkeypatch.setattr("drgs_server.render.thread.os.setpriority", refuse, raising=False)
    give_way()
    assert "keeps the priority" in caplog.text


def test_rendering_runs_on_the_render_thread_only(service: Service) -> None:
    with talk(service, service.open_session()) as client:
        client.socket.send_json(camera())
        client.frame()
    assert service.painter.threads == {"render"}


def test_edits_are_answered_in_order_and_shown_with_their_revision(service: Service) -> None:
    with talk(service, service.open_session(), {"codecs": ["jpeg", "png"]}) as client:
        client.socket.send_json(camera())
        client.frame()
        for k in range(1, 21):
            client.send(type="edit", id=100 + k, edit=material(k / 20))
        client.send(type="undo", id=200)
        client.until(lambda found: isinstance(found, dict) and found.get("id") == 200)
        answers = [text for text in client.texts if text["type"] == "accepted"]
        assert [(text["id"], text["revision"]) for text in answers] == [*((100 + k, k) for k in range(1, 21)), (200, 21)]
        client.until(lambda found: isinstance(found, FrameHeader) and found.state_rev == 21 and bool(found.flags & FLAG_CONVERGED))
        assert client.pixels()[0, 0, 0] == 19  # the painter's red is the number of edits in force
        revisions = [header.state_rev for header, _ in client.frames]
        assert revisions == sorted(revisions)
        assert client.texts[-1]["type"] == "status" or client.texts


def test_a_wrong_edit_is_rejected_with_a_reason_and_the_rest_goes_on(service: Service) -> None:
    with talk(service, service.open_session()) as client:
        client.send(type="edit", id=1, edit={"op": "deform", "map": {"type": "stretch", "factor": 2}})
        assert client.text("rejected") == {"type": "rejected", "id": 1, "reason": "This asset is made of stone.", "overtaken": False}
        client.send(type="edit", id=2, edit={"op": "environment", "file": "../token"})
        assert "No environment" in client.text("rejected")["reason"]
        client.send(type="edit", id=3, edit=material(0.5))
        assert client.text("accepted")["revision"] == 1
        client.send(type="redo", id=4)
        assert client.text("rejected")["reason"] == "There is nothing to redo."


def test_nonsense_is_complained_about_and_finally_ends_the_connection(service: Service) -> None:
    with talk(service, service.open_session()) as client:
        client.text("hello")
        for nonsense in ("{", "[]", '{"type": "camera"}', '{"type": "launch"}', '{"type":"ack","frame_id":-1}', "null", "\x00"):
            client.socket.send_text(nonsense)
            assert client.text("error")["message"]
        broken = camera()
        broken["world_from_camera"][0][0] = 7
        client.socket.send_json(broken)
        assert "orthonormal" in client.text("error")["message"]
        client.socket.send_text('{"type":"settings","settings":{"exposure_stops":NaN}}')
        assert not client.text("error")["fatal"]
        for _ in range(60):
            client.socket.send_text("?")
        client.until(lambda found: isinstance(found, dict) and found.get("fatal", False))


def test_a_client_that_never_acknowledges_gets_two_frames(service: Service) -> None:
    session = service.open_session()
    with talk(service, session, acknowledge=False) as silent, talk(service, session) as quick:
        silent.socket.send_json(camera())
        for k in range(10):
            silent.socket.send_json(camera(k, x=k))
            quick.socket.send_json(camera(k, x=k))
            quick.frame()
        quick.frame(FLAG_CONVERGED)
        silent.send(type="pick", id=1, x=0, y=0)
        silent.text("picked")
        assert [header.frame_id for header, _ in silent.frames] == [1, 2]
        silent.send(type="ack", frame_id=2)
        silent.acknowledge = True
        assert silent.frame(FLAG_CONVERGED).flags >> 8 == 9  # the newest camera; those between were never rendered for it


def test_viewers_share_edits_but_not_cameras_or_settings(service: Service) -> None:
    session = service.open_session()
    with talk(service, session) as one, talk(service, session) as two:
        one.socket.send_json(camera(width=64, height=64))
        two.socket.send_json(camera(width=32, height=96))
        two.send(type="settings", settings={"exposure_stops": 2, "spp_target": 8})
        assert (one.frame(FLAG_CONVERGED).width, two.frame(FLAG_CONVERGED).width) == (64, 32)
        one.send(type="edit", id=1, edit=material(0.1))
        assert two.text("state")["log"]["revision"] == 1
        two.until(lambda found: isinstance(found, FrameHeader) and found.state_rev == 1 and bool(found.flags & FLAG_CONVERGED))
        assert two.pixels()[0, 0].tolist() == [1, 148, 8]
        one.until(lambda found: isinstance(found, FrameHeader) and found.state_rev == 1 and bool(found.flags & FLAG_CONVERGED))
        assert one.pixels()[0, 0].tolist() == [1, 128, 255]
        assert service.painter.loads == 1


def test_a_hidden_page_gets_no_frames(service: Service) -> None:
    with talk(service, service.open_session()) as client:
        client.socket.send_json(camera())
        client.frame(FLAG_CONVERGED)
        client.send(type="visibility", visible=False)
        client.until(lambda found: isinstance(found, dict) and found.get("phase") == "paused")
        count = len(client.frames)
        client.socket.send_json(camera(1, x=1))
        time.sleep(0.3)
        client.send(type="pick", id=1, x=0, y=0)
        client.text("picked")
        assert len(client.frames) == count
        client.send(type="visibility", visible=True)
        client.frame(FLAG_CONVERGED)


def test_transparency_arrives_as_png_with_alpha(service: Service) -> None:
    with talk(service, service.open_session()) as client:
        client.send(type="settings", settings={"background": "transparent", "spp_target": 8})
        client.socket.send_json(camera())
        header = client.frame(FLAG_CONVERGED)
        assert header.flags & FLAG_ALPHA and client.pixels().shape == (48, 64, 4)


def test_a_client_without_png_gets_jpeg_only(service: Service) -> None:
    with talk(service, service.open_session(), {"codecs": ["jpeg"]}) as client:
        client.socket.send_json(camera())
        client.frame(FLAG_CONVERGED)
        assert {header.codec for header, _ in client.frames} == {0}


def test_a_slow_machine_sends_smaller_pictures_while_moving_and_full_ones_when_still(tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:
    # Six times as long as in truth: what other tests take of the cores, some tenths of a second, must not make a picture look half slower than it is.
    monkeypatch.setattr(pace, "TARGET_SECONDS", 6 * pace.TARGET_SECONDS)
    service = Service(tmp_path, Painter(pass_seconds=0.85))
    with service.client, talk(service, service.open_session()) as client:
        client.send(type="settings", settings={"spp_target": 4})
        client.socket.send_json(camera(width=640, height=512))
        client.frame(FLAG_CONVERGED)
        widths = []
        for k in range(1, 4):
            client.socket.send_json(camera(k, x=k, width=640, height=512))
            widths.append(client.frame(FLAG_MOVING).width)
        assert widths == [384, 320, 320], "as long as the first, for the painter's time is not one of pixels"
        last = client.frame(FLAG_CONVERGED)
        assert (last.width, last.height) == (640, 512)
        reduced = [text for text in client.texts if text["type"] == "status" and text["scale"] < 1]
        assert reduced and "50%" in reduced[-1]["notes"][-1]


def test_one_picture_over_rest(service: Service) -> None:
    url = f"/api/sessions/{service.open_session()}"
    service.client.post(f"{url}/edits", json={"edit": material(0.3)})
    response = service.client.get(f"{url}/frame.png?width=40&height=30&spp=16&exposure_stops=1")
    assert response.headers["content-type"] == "image/png" and response.headers["x-drgs-revision"] == "1"
    picture = np.asarray(Image.open(io.BytesIO(response.content)))
    assert picture.shape == (30, 40, 3) and picture[0, 0].tolist() == [1, 138, 16]
    service.client.post(f"{url}/edits", json={"edit": {"op": "environment", "rotation": 30}})
    as_captured = service.client.get(f"{url}/frame.png?width=40&height=30&spp=16&captured=true")
    # The light is an edit too, and stays.
    assert np.asarray(Image.open(io.BytesIO(as_captured.content)))[0, 0, 0] == 1
    assert service.client.get(f"{url}/frame.jpg").headers["content-type"] == "image/jpeg"
    bad = service.client.get(f"{url}/frame.png?world_from_camera=1,2")
    assert bad.status_code == 422 and "16 numbers" in bad.json()["detail"]
    assert service.client.get(f"{url}/frame.png?width=100000").status_code == 422
    assert service.client.get(f"{url}/frame.png?width=4096&height=4096&spp=60000").status_code == 422


def test_a_client_hears_what_its_picture_cost_and_what_was_left_out(service: Service) -> None:
    with talk(service, service.open_session()) as client:
        client.send(type="explain", id=1)
        assert client.text("explained")["revision"] is None
        client.send(type="settings", settings={"spp_target": 8})
        client.socket.send_json(camera())
        client.frame(FLAG_CONVERGED)
        client.send(type="explain", id=2)
        said = client.text("explained")
        assert (said["id"], said["revision"], said["samples"], said["seconds"]) == (2, 0, 8, {"paint": 0.25})
        assert said["skipped"] == [{"what": "shadows", "why": "painters do not know them", "bound": "none"}]
        assert said["frames_sent"] == len(client.frames) and said["frames_in_flight"] == 0
        assert 0 < said["round_trip_ms"] < 1e4


def test_an_edit_sent_again_after_the_connection_was_lost_is_applied_once(service: Service) -> None:
    session = service.open_session()
    for _ in range(2):
        with talk(service, session) as client:
            client.send(type="edit", id=7, edit=material(0.5), key="once")
            assert client.text("accepted")["revision"] == 1
    assert service.client.get(f"/api/sessions/{session}").json()["revision"] == 1


def test_a_drag_that_is_faster_than_its_poses_is_one_step_of_undo_and_every_message_is_answered(service: Service) -> None:
    session = service.open_session()
    service.painter.pose_seconds = 0.1
    with talk(service, session) as client:
        for number in range(1, 21):
            client.send(type="edit", id=number, edit=material(number / 20), coalesce="drag")
        answered = {client.text("accepted")["id"]: client.texts[-1]["revision"] for _ in range(20)}
    log = service.client.get(f"/api/sessions/{session}").json()
    assert sorted(answered) == list(range(1, 21)) and answered[20] == log["revision"] < 10
    assert [edit["set"]["roughness"] for edit in log["edits"]] == [1.0] and log["can_undo"]
    assert service.client.post(f"/api/sessions/{session}/undo").json()["edits"] == []


def test_a_splice_over_the_stream_is_applied_once_coalesced_and_never_to_a_log_it_was_not_meant_for(service: Service) -> None:
    session = service.open_session()
    with talk(service, session) as client:
        for number in (1, 2):
            client.send(type="edit", id=number, edit=material(number / 10))
            client.text("accepted")
        splice = {"type": "splice", "start": 0, "remove": 1, "coalesce": "drag"}
        for key in ("one", "one"):
            client.send(**splice, id=3, revision=2, edits=[material(0.5)], key=key)
            assert client.text("accepted")["revision"] == 3
        client.send(**splice, id=4, revision=3, edits=[material(0.6)], key="two")
        assert client.text("accepted")["revision"] == 4
        client.send(**splice, id=5, revision=3, edits=[material(0.7)], key="three")
        late = client.text("rejected")
        assert late["id"] == 5 and late["overtaken"] and "changed meanwhile" in late["reason"]
        client.send(type="splice", id=6, revision=4, start=1, remove=2, edits=[])
        assert not client.text("rejected")["overtaken"]
        client.send(type="undo", id=7)
        client.text("accepted")
    log = service.client.get(f"/api/sessions/{session}").json()
    assert [edit["set"]["roughness"] for edit in log["edits"]] == [0.1, 0.2], "two splices of one drag are one step"


def test_a_picture_that_cannot_be_made_is_said_to_its_viewer_and_tried_again(service: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(thread, "PAUSE_AFTER_ERROR_SECONDS", 0.05)
    session, refine = service.open_session(), Painting.refine

    def fail_at_first(painting: Painting) -> None:
        monkeypatch.setattr(Painting, "refine", refine)
        raise RuntimeError("the paint is dry")

    monkeypatch.setattr(Painting, "refine", fail_at_first)
    with talk(service, session) as client:
        client.socket.send_json(camera())
        told = client.text("error")
        assert told["message"] == "This picture could not be rendered: RuntimeError: the paint is dry" and not told["fatal"]
        client.frame()


def test_a_client_that_vanishes_while_its_picture_is_made_leaves_nothing_behind(tmp_path) -> None:
    service = Service(tmp_path, Painter(pass_seconds=0.3))
    with service.client:
        session = service.open_session()
        for _ in range(3):
            with talk(service, session) as client:
                client.text("hello")
                client.socket.send_json(camera())
        start = time.monotonic()
        while service.context.sessions.viewer_count() or service.context.render_thread._viewers:
            assert time.monotonic() - start < PATIENCE_SECONDS
            time.sleep(0.02)
        with talk(service, session) as client:
            client.socket.send_json(camera())
            client.frame()


def test_a_client_that_asks_for_changes_is_sent_those_and_can_tell_that_it_missed_one(service: Service) -> None:
    session = service.open_session()
    with talk(service, session, {"changes": True}) as client:
        log = client.text("hello")["log"]
        for number in range(1, 31):
            client.send(type="edit", id=number, edit=material(number / 31))
        client.send(type="undo", id=31)
        client.send(type="splice", id=32, revision=31, start=1, remove=2, edits=[material(0.5)])
        sizes = []
        for _ in range(32):
            change = client.text("change")
            sizes.append(len(json.dumps(change)))
            assert change["before"] == log["digest"]
            for name in ("edits", "undone"):
                part = change[name]
                log[name][part["start"] : part["start"] + part["remove"]] = part["edits"]
            log |= {name: change[name] for name in ("digest", "revision", "can_undo", "can_redo", "appended")}
        info = service.client.get(f"/api/sessions/{session}").json()
        assert {name: info[name] for name in ("revision", "edits", "undone", "can_undo", "can_redo", "appended")} == {
            name: log[name] for name in ("revision", "edits", "undone", "can_undo", "can_redo", "appended")
        }
        assert (log["revision"], len(log["edits"])) == (32, 28)
        assert max(sizes) < 2 * min(sizes), "a change of a long log is as short as one of a short log"
        client.send(type="log")
        assert client.text("state")["log"] == log
    digests = [text["digest"] for text in client.texts if text["type"] == "change"]
    assert len(set(digests)) == len(digests)


def test_a_log_that_is_replayed_has_the_digest_it_had(service: Service, tmp_path) -> None:
    session = service.open_session()
    url = f"/api/sessions/{session}"
    service.client.post(f"{url}/edits", json={"edit": material(0.1)})
    service.client.put(f"{url}/edits", json={"edits": [material(0.2), {"op": "environment", "rotation": 1e-7}]})
    digest = service.client.post(f"{url}/undo").json()["digest"]
    again = Service(tmp_path, service.painter)
    with again.client, talk(again, session) as client:
        assert client.text("hello")["log"]["digest"] == digest


def test_a_client_that_takes_nothing_is_let_go_and_leaves_nothing_behind(service: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stream, "WRITE_SECONDS", 0.2)
    monkeypatch.setattr(stream, "CLOSE_SECONDS", 0.1)
    session, blocked = service.open_session(), threading.Event()
    send = stream.WebSocket.send

    async def send_unless_blocked(socket: stream.WebSocket, message: dict) -> None:
        if blocked.is_set():
            await asyncio.sleep(PATIENCE_SECONDS)
        await send(socket, message)

    monkeypatch.setattr(stream.WebSocket, "send", send_unless_blocked)
    with talk(service, session, {"changes": True}) as client:
        client.text("hello")
        blocked.set()
        for _ in range(3):
            service.client.post(f"/api/sessions/{session}/edits", json={"edit": material(0.5)})
        start = time.monotonic()
        while service.context.sessions.viewer_count():
            assert time.monotonic() - start < PATIENCE_SECONDS
            time.sleep(0.02)
        assert not service.context.render_thread._viewers


def test_who_looks_at_an_asset_that_was_deleted_elsewhere_is_told(service: Service) -> None:
    session = service.open_session()
    with talk(service, session) as conversation:
        conversation.text("hello")
        with Database(service.context.engine) as database, database.begin():
            database.get_one(AssetRow, "a" * 32).deleted_at = now()
        service.client.portal.call(service.context.sessions.forget_deleted)
        error = conversation.text("error")
        assert error["fatal"] and "was deleted" in error["message"]
        with pytest.raises(WebSocketDisconnect) as closed:
            conversation.text("never")
        assert closed.value.code == messages.CLOSE_POLICY
