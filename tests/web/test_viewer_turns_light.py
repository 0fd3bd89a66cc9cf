"""An object from a turntable: its own light turns with the camera where that is switched on, in the traced picture and in the browser's own."""

import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from playwright.sync_api import Browser, expect

from drgs.scene.asset import Asset, save_asset
from drgs.scene.camera import camera_from_opengl
from drgs.scene.environment import Environment
from drgs_server.client import Client
from tests.render.closed_form_scenes import sphere_mesh
from tests.web.browser import RunningServer
from tests.web.conftest import Viewer, frame_alone, shown_page

SWITCH = "Turns with the camera"


@pytest.fixture(scope="module")
def turntable_ball(server: RunningServer, browser: Browser, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Viewer]:
    """The page with a grey ball that was photographed under a lamp that stood still with the camera."""
    path = tmp_path_factory.mktemp("turntable") / "ball.zip"
    sky = Environment(torch.full((32, 64, 3), 0.15))
    sky.radiance[6:14, 20:30] = torch.tensor([8.0, 5.0, 2.0])
    first = camera_from_opengl(torch.eye(4, dtype=torch.float64), torch.eye(3), 8, 8, "first")
    save_asset(Asset(None, sphere_mesh(subdivisions=4), None, sky, cameras=(first,), light_frame="camera"), path)
    with Client(server.address, token=server.token) as client:
        asset = client.upload_asset(path).id
    with shown_page(server, browser, asset) as viewer:
        expect(viewer.page.get_by_role("heading", name="ball", exact=True)).to_be_visible()
        frame_alone(viewer)
        yield viewer


def orbit(viewer: Viewer) -> None:
    page = viewer.page
    page.mouse.move(120, 330)
    page.mouse.down()
    page.mouse.move(300, 300, steps=4)
    page.mouse.up()


@pytest.mark.slow
def test_the_light_of_a_turntable_turns_with_the_camera_where_it_is_switched_on(turntable_ball: Viewer) -> None:
    viewer = turntable_ball
    viewer.open_tab("Light")
    switch = viewer.page.get_by_role("switch", name=SWITCH)
    expect(switch).not_to_be_checked()
    expect(viewer.hint("stood still with the camera")).to_be_visible()

    def moved_by(orbits: int = 1) -> float:
        before = np.array(viewer.settled_color())
        for _ in range(orbits):
            orbit(viewer)
        return float(np.abs(np.array(viewer.settled_color()) - before).max())

    still = moved_by()
    switch.check()
    viewer.settle()
    turning = moved_by()
    if folder := os.environ.get("DRGS_SCREENSHOTS"):
        viewer.page.screenshot(path=str(Path(folder) / "turning_light.png"))
    assert still > 15 and turning < 4, (still, turning)
    assert viewer.complaints == [] and viewer.refusals == []
