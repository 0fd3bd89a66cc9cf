"""Where the edits of a session put the mesh's vertices, for whoever draws it while pictures are on their way."""

from pathlib import Path

import numpy as np
from conftest import Service
from test_rest import is_problem

from drgs.deform.pose_scene import pose_scene
from drgs.scene.asset import load_asset
from drgs.scene.edits import parse_edits
from drgs_server.render.drgs_renderer import DrgsRenderer
from tests.web.browser import write_ball

PULL = {
    "op": "deform",
    "handles": {"drag": [{"point": [0, 0, 0.5], "radius": 0.1, "target": [0, 0, 0.7]}], "pin": [{"point": [0, 0, -0.5], "radius": 0.2}]},
}


def test_the_vertices_are_those_of_the_posed_mesh_in_its_order(tmp_path: Path) -> None:
    write_ball(tmp_path / "ball.ply")
    service = Service(tmp_path, DrgsRenderer("cpu"))  # type: ignore[arg-type]
    with service.client:
        asset_id = service.add_mesh(tmp_path / "ball.ply")
        asset = load_asset(service.context.directory.asset(asset_id))
        session = service.client.post("/api/sessions", json={"asset": asset_id}).json()["id"]
        for edits in ([], [PULL]):
            for edit in edits:
                service.client.post(f"/api/sessions/{session}/edits", json={"edit": edit})
            answer = service.client.get(f"/api/sessions/{session}/vertices")
            assert answer.headers["x-drgs-revision"] == str(len(edits))
            found = np.frombuffer(answer.content, "<f4").reshape(-1, 3)
            np.testing.assert_array_equal(found, pose_scene(asset, parse_edits(edits)).mesh.vertices.numpy())
        assert found[:, 2].max() > 0.65


def test_there_are_none_of_a_session_that_is_not_there(service: Service) -> None:
    is_problem(service.client.get("/api/sessions/none/vertices"), 404)
