"""`python -m benchmarks gltf`: three.js' picture of our GLB beside ours, and what lies between them."""

from pathlib import Path

import pytest
import torch
from PIL import Image
from playwright.sync_api import Browser

from benchmarks.convert._shade_open import shade_open
from benchmarks.convert.gltf import LIGHTS, measure
from drgs.convert.import_mesh import import_mesh
from drgs.deform.pose_scene import pose_scene
from drgs.scene.asset import Asset
from drgs.scene.camera import camera_from_opengl
from drgs_worker.jobs.start_view import turntable_view
from tests.scene.grey_cube import grey_cube

PARTS = ("difference", "without_occlusion", "unsaid", "held", "brdf", "drawn")


@pytest.fixture(scope="module")
def ball(ball_file: Path) -> Asset:
    return import_mesh(ball_file)


@pytest.mark.slow
def test_a_ball_has_nothing_that_a_file_cannot_say(browser: Browser, ball: Asset, tmp_path: Path) -> None:
    """Nothing of it is in the way of light: what is left is how three.js filters it, and the pictures are there to look at."""
    overcast = LIGHTS[0]
    found = measure(browser, ball, tmp_path, 600, [overcast], 1, 64, 64)
    part = found[overcast.stem]
    assert isinstance(part, dict)
    assert {name for name in part if not name.endswith("_brighter")} == {*PARTS, "noise"}
    assert part["unsaid"] < 0.5 + 2 * part["noise"], part
    assert part["brdf"] < 2 and part["drawn"] < 2 and part["held"] < 2 and part["difference"] < 2, part
    assert abs(part["difference"] - part["without_occlusion"]) < 0.2, "nothing to be dark in"
    assert Image.open(tmp_path / "overcast-0.png").size == (6 * 64, 64)


@pytest.mark.slow
def test_under_an_even_light_a_file_sends_back_as_much_as_the_object(tmp_path: Path) -> None:
    """A cube under a white sky of 1: our picture of it alone is its albedo and the little that its surface reflects; glTF's is as bright."""
    scene = pose_scene(grey_cube(), [])
    view = torch.from_numpy(turntable_view((-0.5, -0.5, -0.5), (0.5, 0.5, 0.5), 30, 25))
    alone = shade_open(scene, camera_from_opengl(view, torch.tensor([[60.0, 0, 24], [0, 60.0, 24], [0, 0, 1]]), 48, 48), 128)
    seen = alone.ours[..., 0] > 0.4
    assert seen.sum() > 300
    assert 0.53 < float(alone.ours[seen].mean()) < 0.6
    assert abs(float((alone.gltf - alone.ours)[seen].mean())) < 0.01
