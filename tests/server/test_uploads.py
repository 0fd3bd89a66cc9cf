"""Uploads in parts: each byte arrives once, in its place, whatever becomes of connections and servers; and no more of them than may be."""

import base64
import os
import socket
import threading
import time
from concurrent.futures import ThreadPoolExecutor, wait
from pathlib import Path

import httpx
import pytest
from conftest import Service
from sqlalchemy.orm import Session
from test_connections import listening
from test_rest import is_problem, left_on_disk, zipped
from test_service import ServeProcess, capture, running

from drgs_server import client_upload
from drgs_server.api.door import incoming
from drgs_server.client import Client, ServerError
from drgs_server.settings import Limits
from drgs_worker.store.database import CaptureRow, now
from drgs_worker.store.remove_unused import remove_unused_captures
from tests.patience import PATIENCE_SECONDS
from tests.reconstruct.tiny_capture import VIEWS, write_nerf_synthetic

__all__ = ["running"]

TUS = {"Tus-Resumable": "1.0.0"}
PART = TUS | {"Content-Type": "application/offset+octet-stream"}
LATER = 2 * 24 * 3600
"""[s], beyond what is kept."""


def announce(service: Service, length: int, name: str = "teapot.zip") -> httpx.Response:
    metadata = f"filename {base64.b64encode(name.encode()).decode()}"
    return service.client.post("/api/uploads", headers=TUS | {"Upload-Length": str(length), "Upload-Metadata": metadata})


def begin(service: Service, length: int) -> str:
    response = announce(service, length)
    assert response.status_code == 201, response.text
    return response.headers["Location"]


def send(service: Service, address: str, offset: int, data: bytes) -> httpx.Response:
    return service.client.patch(address, content=data, headers=PART | {"Upload-Offset": str(offset)})


def offset_of(service: Service, address: str) -> int:
    return int(service.client.head(address, headers=TUS).headers["Upload-Offset"])


def uploaded(service: Service, data: bytes) -> str:
    """Id of a complete upload."""
    address = begin(service, len(data))
    assert send(service, address, 0, data).status_code == 204
    return address.rpartition("/")[2]


def test_parts_become_a_capture_that_any_number_of_builds_read(service: Service) -> None:
    data = zipped({"teapot/transforms.json": b"{}", "teapot/a.png": os.urandom(5000)})
    address = begin(service, len(data))
    upload = address.rpartition("/")[2]
    assert send(service, address, 0, data[:3000]).headers["Upload-Offset"] == "3000"
    assert "3000 of" in is_problem(service.client.post("/api/captures", json={"upload": upload}), 409)
    found = service.client.head(address, headers=TUS)
    assert (found.headers["Upload-Offset"], found.headers["Upload-Length"], found.headers["Tus-Resumable"]) == (
        "3000",
        str(len(data)),
        "1.0.0",
    )
    assert send(service, address, 3000, data[3000:]).status_code == 204
    made = service.client.post("/api/captures", json={"upload": upload})
    assert made.status_code == 201 and (made.json()["id"], made.json()["name"]) == (upload, "teapot")
    assert service.client.post("/api/captures", json={"upload": upload}).json() == made.json(), "asked again, the same one"
    assert list(service.context.directory.incoming.iterdir()) == []
    is_problem(service.client.post("/api/captures", json={"upload": "0" * 32}), 404)
    jobs = [
        service.client.post("/api/jobs", json={"dataset": f"capture:{upload}", "preset": preset}).json() for preset in ("draft", "full")
    ]
    assert [(job["name"], job["preset"]) for job in jobs] == [("teapot", "draft"), ("teapot", "full")]
    assert sorted(service.client.get(f"/api/captures/{upload}").json()["jobs"]) == sorted(job["id"] for job in jobs)
    is_problem(service.client.delete(f"/api/captures/{upload}"), 409)
    for job in jobs:
        service.client.post(f"/api/jobs/{job['id']}/cancel")
        assert service.client.delete(f"/api/jobs/{job['id']}").status_code == 204
    assert service.client.get("/api/captures").json()["captures"][0]["jobs"] == []
    assert service.client.delete(f"/api/captures/{upload}").status_code == 204
    assert left_on_disk(service) == []
    is_problem(service.client.post("/api/jobs", json={"dataset": f"capture:{upload}"}), 404)


def test_a_part_at_another_place_is_refused_with_the_right_one(service: Service) -> None:
    address = begin(service, 10)
    assert send(service, address, 0, b"abc").status_code == 204
    for wrong in (0, 2, 4, 10):
        assert "at byte 3" in is_problem(send(service, address, wrong, b"x"), 409)
    assert offset_of(service, address) == 3


def test_no_more_comes_than_was_announced(service: Service) -> None:
    address = begin(service, 4)
    assert "announced with 4 bytes" in is_problem(send(service, address, 0, b"12345"), 413)
    assert offset_of(service, address) == 0 and send(service, address, 0, b"1234").status_code == 204


def test_what_is_announced_has_bounds(tmp_path: Path) -> None:
    service = Service(tmp_path, limits=Limits(upload_bytes=1000, incoming_uploads=3, incoming_bytes=1500))
    with service.client:
        is_problem(announce(service, 1001), 413)
        is_problem(announce(service, 0), 422)
        first, _ = begin(service, 1000), begin(service, 500)
        assert "1500 bytes" in is_problem(announce(service, 1), 429)
        assert service.client.delete(first, headers=TUS).status_code == 204
        begin(service, 1), begin(service, 1)
        assert "3 uploads" in is_problem(announce(service, 1), 429)
        assert service.client.options("/api/uploads").headers["Tus-Max-Size"] == "1000"


def test_uploads_are_only_for_who_knows_the_token_and_the_id(service: Service) -> None:
    address = begin(service, 3)
    for call in (
        service.anonymous.patch(address, content=b"abc", headers=PART | {"Upload-Offset": "0"}),
        service.anonymous.head(address, headers=TUS),
        service.anonymous.delete(address, headers=TUS),
    ):
        assert call.status_code == 401
    for guess in ("0" * 32, "..%2f..%2ftoken", "%2e%2e", address.rpartition("/")[2][:-1]):
        assert send(service, f"/api/uploads/{guess}", 0, b"abc").status_code == 404
    assert offset_of(service, address) == 0


def test_calls_that_are_not_of_the_protocol_are_told_so(service: Service) -> None:
    address = begin(service, 3)
    assert "1.0.0" in is_problem(service.client.post("/api/uploads", headers={"Upload-Length": "3"}), 412)
    is_problem(service.client.patch(address, content=b"abc", headers=TUS | {"Upload-Offset": "0"}), 415)
    is_problem(service.client.patch(address, content=b"abc", headers=PART), 422)
    is_problem(service.client.post("/api/uploads", headers=TUS | {"Upload-Length": "3", "Upload-Metadata": "filename ?"}), 422)


def test_what_is_no_capture_is_refused_and_forgotten(service: Service) -> None:
    upload = uploaded(service, zipped({"../../evil": b"1"}))
    assert "does not name a place" in is_problem(service.client.post("/api/captures", json={"upload": upload}), 422)
    assert left_on_disk(service) == [] and list(service.context.directory.incoming.iterdir()) == []


def test_what_nobody_goes_on_with_is_removed(service: Service) -> None:
    kept, left = begin(service, 10), begin(service, 10)
    for path in service.context.directory.incoming.glob(left.rpartition("/")[2] + "*"):
        os.utime(path, (now() - LATER, now() - LATER))
    service.context.incoming.remove_before(now() - LATER / 2)
    assert service.client.head(left, headers=TUS).status_code == 404 and offset_of(service, kept) == 0
    used, unused = (uploaded(service, zipped({"a/transforms.json": b"{}"})) for _ in range(2))
    for upload in (used, unused):
        assert service.client.post("/api/captures", json={"upload": upload}).status_code == 201
    service.client.post("/api/jobs", json={"dataset": f"capture:{used}"})
    with Session(service.context.engine) as session, session.begin():
        for upload in (used, unused):
            session.get_one(CaptureRow, upload).created_at -= LATER
    assert remove_unused_captures(service.context.directory, service.context.engine, LATER / 2) == 1
    assert [path.name for path in service.context.directory.uploads.iterdir()] == [used]


@pytest.mark.slow
def test_what_came_before_the_connection_was_cut_is_kept(tmp_path: Path) -> None:
    # Patient with bodies: a connection that it gives up on writes what it still held, and the upload is elsewhere then.
    with listening(tmp_path, body_seconds=PATIENCE_SECONDS) as server:
        headers = {"Authorization": f"Bearer {server.service.token}"} | TUS
        with httpx.Client(base_url=server.address, headers=headers, timeout=PATIENCE_SECONDS) as http:
            address = http.post("/api/uploads", headers={"Upload-Length": "4000000"}).headers["Location"]
            data = os.urandom(4_000_000)
            lines = [f"PATCH {address} HTTP/1.1", "Host: 127.0.0.1", "Content-Length: 4000000", "Upload-Offset: 0"]
            head = "\r\n".join([*lines, *(f"{name}: {value}" for name, value in (headers | PART).items()), "", ""])
            started = time.monotonic()

            def arrived(enough: int) -> int:
                while (offset := int(http.head(address).headers["Upload-Offset"])) < enough:
                    assert time.monotonic() - started < PATIENCE_SECONDS
                return offset

            cut = server.connect(head.encode() + data[:2_000_000])
            arrived(1 << 20)
            cut.shutdown(socket.SHUT_RDWR)
            cut.close()
            assert arrived(2_000_000) == 2_000_000
            # A connection that is dead without the server knowing is taken over from, once the server has begun with it.
            hanging = server.connect(head.replace("Upload-Offset: 0", "Upload-Offset: 2000000").encode() + data[2_000_000:3_500_000])
            offset = arrived(2_000_001)
            rest = http.patch(address, content=data[offset:], headers=PART | {"Upload-Offset": str(offset)})
            hanging.close()
            assert rest.status_code == 204 and rest.headers["Upload-Offset"] == "4000000", (rest.text, offset)
        upload = address.rpartition("/")[2]
        assert (server.service.context.directory.incoming / upload).read_bytes() == data


def test_where_an_upload_is_waits_for_what_is_being_written(service: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    address = begin(service, 6)
    half_written, go_on = threading.Event(), threading.Event()

    def write_in_two(path: Path, at: int, part: bytes) -> None:
        path.write_bytes(part[:3])
        half_written.set()
        assert go_on.wait(PATIENCE_SECONDS)
        path.write_bytes(part)

    monkeypatch.setattr(incoming, "_write", write_in_two)
    with ThreadPoolExecutor(2) as pool:
        sent = pool.submit(send, service, address, 0, b"abcdef")
        assert half_written.wait(PATIENCE_SECONDS)
        asked = pool.submit(offset_of, service, address)
        assert not wait([asked], timeout=0.2).done
        go_on.set()
        assert sent.result().status_code == 204 and asked.result() == 6


@pytest.mark.slow
def test_the_client_goes_on_after_the_server_was_killed_in_the_middle(running: ServeProcess, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(client_upload, "PART_BYTES", 100_000)
    client = running.start()
    photographs = capture(running.root)
    content = {f"{number}.jpg": os.urandom(300_000) for number in range(10)}
    for name, data in content.items():
        (photographs / name).write_bytes(data)
    assert running.process is not None
    reached, again = [], threading.Event()
    first = running.process

    def kill_at_a_third(share: float) -> None:
        reached.append(share)
        if share > 1 / 3 and not again.is_set():
            again.set()
            first.kill()
            first.wait(PATIENCE_SECONDS)
            threading.Thread(target=restart).start()

    def restart() -> None:
        port = int(client.address.rpartition(":")[2])
        running.start(port).close()

    made = client.upload_capture(photographs, "Ten", kill_at_a_third)
    assert again.is_set() and reached == sorted(reached) and reached[-1] == 1
    assert len(reached) < 45, "what had arrived was not sent again"
    kept = running.root / "data" / "uploads" / made.id
    assert {path.name: path.read_bytes() for path in kept.glob("*.jpg")} == content
    with pytest.raises(ServerError):
        client.delete_capture("0" * 32)
    client.close()


def test_the_client_gives_up_where_nothing_gets_through() -> None:
    with Client("http://127.0.0.1:9/#token=x") as client, Path(__file__).open("rb") as file, pytest.raises(httpx.ConnectError):
        client_upload.send_in_parts(client._http, file, "a.zip", patience_seconds=0.3)


@pytest.mark.slow
def test_a_capture_is_looked_at_once_before_anything_is_built(service: Service, tmp_path: Path) -> None:
    folder = write_nerf_synthetic(tmp_path / "ball")
    with client_upload.as_zip(folder) as file:
        upload = uploaded(service, file.read())
    service.client.post("/api/captures", json={"upload": upload})
    look = service.client.get(f"/api/captures/{upload}/look")
    assert look.status_code == 200, look.text
    assert look.json()["ok"] and look.json()["camera_count"] == VIEWS and look.json()["box_origin"] == "masks"
    kept = service.context.directory.look(upload)
    made_at = kept.stat().st_mtime_ns
    sheet = service.client.get(f"/api/captures/{upload}/sheet.jpg")
    assert sheet.headers["content-type"] == "image/jpeg" and sheet.content.startswith(b"\xff\xd8")
    assert kept.stat().st_mtime_ns == made_at, "what is kept is not made again"
    assert service.context.admission.running("file") == 0
    service.client.delete(f"/api/captures/{upload}")
    assert not kept.exists() and service.client.get(f"/api/captures/{upload}/look").status_code == 404


@pytest.mark.slow
def test_a_capture_that_cannot_be_read_is_told_without_a_place_on_this_machine(service: Service) -> None:
    upload = uploaded(service, zipped({"mug/transforms.json": b"{"}))
    service.client.post("/api/captures", json={"upload": upload})
    look = service.client.get(f"/api/captures/{upload}/look")
    assert not look.json()["ok"] and look.json()["findings"][0]["sentence"].startswith("transforms.json: ")
    assert str(service.context.directory.root) not in look.text
    is_problem(service.client.get(f"/api/captures/{upload}/sheet.jpg"), 404)
