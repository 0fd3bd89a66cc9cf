"""A picture under another light than the session's: compared without changing anything."""

import io
from pathlib import Path

import numpy as np
import pytest
from conftest import Service
from test_rest import is_problem

from drgs.exchange.exr import decode_exr, encode_environment
from drgs_server.render.drgs_renderer import DrgsRenderer
from tests.web.browser import write_ball


@pytest.mark.slow
def test_a_picture_under_another_light_is_that_of_a_session_with_it_and_no_edit(tmp_path: Path) -> None:
    write_ball(tmp_path / "ball.ply")
    service = Service(tmp_path, DrgsRenderer("cpu"))  # type: ignore[arg-type]
    with service.client:
        asset_id = service.add_mesh(tmp_path / "ball.ply")
        sky = np.linspace(0, 2, 16, dtype=np.float32)[None, :, None] * np.ones((8, 16, 3), np.float32)
        name = service.client.post("/api/environments", files={"file": ("ramp.exr", io.BytesIO(encode_environment(sky)))}).json()["name"]
        one, other = (service.client.post("/api/sessions", json={"asset": asset_id}).json()["id"] for _ in range(2))

        def edit(session: str, change: dict) -> None:
            assert service.client.post(f"/api/sessions/{session}/edits", json={"edit": change}).status_code == 200

        def picture(session: str, **query: str) -> np.ndarray:
            parts = "&".join(f"{key}={value}" for key, value in query.items())
            answer = service.client.get(f"/api/sessions/{session}/frame.exr?width=24&height=16&spp=8&{parts}")
            assert answer.status_code == 200, answer.text
            return decode_exr(answer.content)["R"]

        paint = {"op": "material", "select": {"all": True}, "set": {"roughness": 0.2}}
        edit(one, paint)
        bare = picture(one)
        edit(one, {"op": "environment", "rotation": 90, "intensity": 2})
        edit(other, paint)
        edit(other, {"op": "environment", "file": name, "rotation": 90, "intensity": 2})
        np.testing.assert_array_equal(picture(one, environment=name), picture(other))
        np.testing.assert_array_equal(picture(other, environment="captured"), picture(one))
        np.testing.assert_array_equal(picture(one, environment=name, captured="true"), picture(other, captured="true"))
        assert np.abs(picture(one, environment=name) - picture(one)).mean() > 0.05 and np.abs(bare - picture(one)).mean() > 0.05
        log = service.client.get(f"/api/sessions/{one}").json()
        assert len(log["edits"]) == 2 and log["revision"] == 2


def test_a_light_that_is_not_there_is_a_sentence(service: Service) -> None:
    is_problem(service.client.get(f"/api/sessions/{service.open_session()}/frame.png?environment=moon.exr"), 422)
