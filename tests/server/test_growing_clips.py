"""A simulation plays while a worker of this machine bakes it; what needs all of it waits for its end."""

from conftest import Service
from test_rest import is_problem

from drgs.deform.clip import growing_clip

JOB = "c" * 32


def test_edits_may_name_a_clip_in_the_making_and_renders_may_not(service: Service) -> None:
    session, directory = service.open_session(), service.context.directory
    assert directory.growing_clip(JOB) == growing_clip(directory.clip(JOB))
    pose = {"edit": {"op": "pose", "clip": f"clips/{JOB}", "time": 0.4}}
    assert "clips/ID" in is_problem(service.client.post(f"/api/sessions/{session}/edits", json=pose), 422)
    folder = directory.growing_clip(JOB)
    folder.mkdir(parents=True)
    (folder / "clip.json").write_text("{}")
    assert service.client.post(f"/api/sessions/{session}/edits", json=pose).status_code == 200
    asset = service.client.get(f"/api/sessions/{session}").json()["asset"]
    render = {"kind": "render", "asset": asset, "turntable": {"frames": 3}, "clip": f"clips/{JOB}"}
    assert "There is no clip" in is_problem(service.client.post("/api/jobs", json=render), 422)
