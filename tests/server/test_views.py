"""Training views over REST: cameras and photographs of an asset that came zipped, of its versions, and of one that has none."""

import io
import json
import math
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import Service
from PIL import Image
from test_rest import is_problem

from drgs.convert.import_mesh import import_mesh
from drgs.exchange.photographs import encode_photographs
from drgs.scene.asset import load_photographs, save_asset
from drgs.scene.camera import camera_from_opengl
from drgs_worker.jobs.file_tool import make_asset

TETRAHEDRON = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
POSE = torch.tensor([[1.0, 0, 0, 0.5], [0, 0, -1, -4], [0, 1, 0, 0.25], [0, 0, 0, 1]], dtype=torch.float64)
FRAME = {"file_path": "a", "w": 4, "h": 4, "fl_x": 4.0, "fl_y": 4.0, "cx": 2.0, "cy": 2.0, "transform_matrix": POSE.tolist()}
PHOTOGRAPHS = encode_photographs([np.full((30, 40, 3), 90, np.uint8), np.full((30, 40, 4), 200, np.uint8)])


def zipped_asset(folder: Path, photographs: bytes | None = PHOTOGRAPHS) -> bytes:
    """Two cameras whose axes do not go through the middle of their pictures."""
    (folder / "four.obj").write_text(TETRAHEDRON)
    intrinsics = torch.tensor([[50.0, 0, 15], [0, 25, 10], [0, 0, 1]])
    cameras = tuple(camera_from_opengl(POSE, intrinsics, 40, 30, name) for name in ("front", "back"))
    save_asset(replace(import_mesh(folder / "four.obj"), cameras=cameras), folder / "four.zip", None, photographs)
    return (folder / "four.zip").read_bytes()


@pytest.mark.slow
def test_an_uploaded_asset_brings_its_views_and_photographs_and_hands_them_on(service: Service, tmp_path: Path) -> None:
    asset = service.client.post("/api/assets", files={"file": ("four.zip", zipped_asset(tmp_path))}).json()["id"]
    listed = service.client.get(f"/api/assets/{asset}/views").json()
    assert listed["has_photographs"] and [view["name"] for view in listed["views"]] == ["front", "back"]
    view = listed["views"][0]
    assert (view["width"], view["height"]) == (40, 30)
    assert np.allclose(view["world_from_camera"], POSE, atol=1e-6)
    edges = [view[key] for key in ("left", "right", "bottom", "top")]
    assert np.allclose(edges, [-15 / 50, 25 / 50, -20 / 25, 10 / 25])

    answer = service.client.get(f"/api/assets/{asset}/views/1/photograph.webp")
    assert answer.headers["content-type"] == "image/webp" and "max-age" in answer.headers["cache-control"]
    assert Image.open(io.BytesIO(answer.content)).size == (40, 30)
    assert "photograph 2" in is_problem(service.client.get(f"/api/assets/{asset}/views/2/photograph.webp"), 404)

    session = service.client.post("/api/sessions", json={"asset": asset}).json()["id"]
    saved = service.client.post(f"/api/sessions/{session}/save").json()["id"]
    assert load_photographs(service.context.directory.asset(saved)) == PHOTOGRAPHS
    whole = service.client.get(f"/api/assets/{saved}/export", params={"format": "zip"}).content
    assert zipfile.ZipFile(io.BytesIO(whole)).read("photographs.zip") == PHOTOGRAPHS


def test_an_imported_mesh_has_no_views_and_an_asset_from_before_has_no_photographs(service: Service) -> None:
    asset = service.add_asset()
    assert service.client.get(f"/api/assets/{asset}/views").json() == {"views": [], "has_photographs": False}
    is_problem(service.client.get(f"/api/assets/{asset}/views/0/photograph.webp"), 404)
    (service.context.directory.asset(asset) / "cameras.json").write_text(json.dumps({"frames": [FRAME]}))
    listed = service.client.get(f"/api/assets/{asset}/views").json()
    assert len(listed["views"]) == 1 and not listed["has_photographs"]


def test_an_asset_whose_photographs_are_none_is_refused(tmp_path: Path) -> None:
    zipped_asset(tmp_path, b"<script>")
    with pytest.raises(ValueError, match=r"photographs\.zip is no zip"):
        make_asset(tmp_path / "four.zip", tmp_path / "out")


@pytest.mark.parametrize("change", [{"fl_x": 0.0}, {"fl_x": math.nan}, {"transform_matrix": [[1]]}, {"w": "wide"}])
def test_damaged_cameras_are_said_to_be_so(service: Service, change: dict) -> None:
    asset = service.add_asset()
    (service.context.directory.asset(asset) / "cameras.json").write_text(json.dumps({"frames": [FRAME | change]}))
    assert "cameras.json" in is_problem(service.client.get(f"/api/assets/{asset}/views"), 422)
