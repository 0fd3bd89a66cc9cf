"""Strokes over pictures of an uploaded capture: its pictures to draw on, the masks that strokes give, and a build that is told them."""

import io
from pathlib import Path

import pytest
from conftest import Service
from PIL import Image
from sqlalchemy.orm import Session
from test_rest import is_problem
from test_uploads import uploaded

from drgs_server import client_upload
from drgs_server.api.routes.captures import KEPT_MASKS
from drgs_worker.store.database import JobRow
from tests.reconstruct.tiny_capture import HEIGHT, WIDTH, sphere_views, write_nerf_synthetic


def strokes_over(name: str) -> list[dict]:
    """The ball is near the middle of each picture."""
    return [
        {"picture": name, "shows": "object", "radius": 0.02, "points": [[0.45, 0.5], [0.55, 0.5]]},
        {"picture": name, "shows": "background", "radius": 0.02, "points": [[0.05, 0.05], [0.95, 0.05], [0.95, 0.95]]},
    ]


@pytest.mark.slow
def test_strokes_give_a_sheet_of_masks_and_go_into_a_build(service: Service, tmp_path: Path) -> None:
    folder = write_nerf_synthetic(tmp_path / "ball", sphere_views(8, square=True))
    with client_upload.as_zip(folder) as file:
        capture = uploaded(service, file.read())
    service.client.post("/api/captures", json={"upload": capture})
    picture = service.client.get(f"/api/captures/{capture}/pictures/3.jpg")
    assert picture.status_code == 200 and Image.open(io.BytesIO(picture.content)).size == (WIDTH, HEIGHT)
    is_problem(service.client.get(f"/api/captures/{capture}/pictures/8.jpg"), 404)
    strokes = [*strokes_over("r_000"), *strokes_over("r_003")]
    masks = service.client.post(f"/api/captures/{capture}/masks", json={"strokes": strokes})
    assert masks.status_code == 200, masks.text
    version, layout = masks.json()["version"], masks.json()["sheet"]
    assert layout["count"] == 8
    sheet = service.client.get(f"/api/captures/{capture}/masks/{version}.jpg")
    assert sheet.headers["content-type"] == "image/jpeg" and sheet.content.startswith(b"\xff\xd8")
    kept = service.context.directory.look(capture) / "masks" / version
    made_at = kept.stat().st_mtime_ns
    again = service.client.post(f"/api/captures/{capture}/masks", json={"strokes": strokes})
    assert again.json() == masks.json() and kept.stat().st_mtime_ns == made_at, "what is kept is not made again"
    foreign = service.client.post(f"/api/captures/{capture}/masks", json={"strokes": strokes_over("IMG_1")})
    assert "no picture of the capture is called 'IMG_1'" in is_problem(foreign, 422)
    assert "expected at least one that shows 'background'" in is_problem(
        service.client.post(f"/api/captures/{capture}/masks", json={"strokes": strokes[:1]}), 422
    )
    is_problem(service.client.get(f"/api/captures/{capture}/masks/{'0' * 32}.jpg"), 404)
    is_problem(service.client.get(f"/api/captures/{capture}/masks/..%2F..%2Fsheet.jpg"), 404)
    assert service.context.admission.running("file") == 0 and KEPT_MASKS > 0
    job = service.client.post("/api/jobs", json={"dataset": f"capture:{capture}", "strokes": strokes}).json()
    with Session(service.context.engine) as session:
        row = session.get(JobRow, job["id"])
        assert row is not None and row.parameters["strokes"] == strokes
    service.client.delete(f"/api/captures/{capture}")


@pytest.mark.parametrize(
    ("strokes", "where"),
    [
        ([{"picture": "a", "shows": "object", "points": [[0, 1.5]]}], "points"),
        ([{"picture": "a", "shows": "object", "points": [[0, 0.5]] * 1001}], "points"),
        ([{"picture": "a", "shows": "object", "points": [[0, 0.5]]}] * 201, "strokes"),
    ],
)
def test_strokes_beyond_their_bounds_are_refused(service: Service, strokes: list[dict], where: str) -> None:
    assert where in is_problem(service.client.post(f"/api/captures/{'0' * 32}/masks", json={"strokes": strokes}), 422)
    assert where in is_problem(service.client.post("/api/jobs", json={"dataset": "sample", "strokes": strokes}), 422)
