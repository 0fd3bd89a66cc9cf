"""Painted weights go up as a file, and edits refer to it."""

import numpy as np
from conftest import Service
from test_rest import is_problem


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
