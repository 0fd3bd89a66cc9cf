"""What somebody meets who follows the tutorial for the first time: an asset from the command line, its first picture, and the pages of the inspector."""

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Browser, WebSocketRoute, expect

from drgs.convert.import_mesh import import_mesh
from drgs.scene.asset import save_asset
from tests.web.browser import RunningServer
from tests.web.conftest import Viewer, shown_page, wait_until
from tests.web.test_dropped_photos import drop_folder


@pytest.fixture
def page(server: RunningServer, browser: Browser) -> Iterator[Viewer]:
    """A page of one test alone, on which nothing is open."""
    with shown_page(server, browser) as shown:
        yield shown


def test_the_folder_of_an_asset_that_a_command_wrote_opens_when_dropped(page: Viewer, ball_file: Path, tmp_path: Path) -> None:
    save_asset(import_mesh(ball_file), tmp_path / "teal ball")
    drop_folder(page, tmp_path / "teal ball")
    expect(page.page.get_by_role("heading", name="teal ball", exact=True)).to_be_visible()
    page.settle()


def test_the_mesh_is_not_drawn_before_the_camera_has_its_place(page: Viewer, ball_asset: str) -> None:
    held: list[tuple[WebSocketRoute, str | bytes]] = []
    holds = True

    def hold(socket: WebSocketRoute) -> None:
        """A server that takes its time over the asset, while the mesh comes quickly."""
        socket.connect_to_server().on_message(lambda message: held.append((socket, message)) if holds else socket.send(message))

    page.page.route_web_socket("**/*", hold)
    page.page.goto("about:blank")
    page.page.goto(f"{page.server.address}/#token={page.server.token}&asset={ball_asset}")
    wait_until(lambda: "overlay" in page.stage() and held, "mesh and light in the browser")
    for _ in range(2):
        page.page.keyboard.press("p")  # the local picture off and on: the page looks anew at what it may show
    assert "picture" not in page.stage()
    holds = False
    for socket, message in held:
        socket.send(message)
    wait_until(lambda: page.stage().get("picture") in ("stale", "fresh"), "a picture")
    page.settle()


PHONE, LAPTOP = {"width": 390, "height": 844}, {"width": 1280, "height": 800}


def test_on_a_phone_the_panels_leave_the_page_to_an_asset_that_was_opened(page: Viewer, ball_asset: str) -> None:
    """The fixture's page is that of no other test, so what it keeps of open panels is nobody's."""
    shown = page.page
    library, inspector = shown.get_by_role("complementary", name="Library"), shown.get_by_role("complementary", name="Inspector")
    to_library, to_inspector = (shown.get_by_role("button", name=name, exact=True) for name in ("Library", "Inspector"))
    shown.set_viewport_size(PHONE)  # type: ignore[arg-type]
    first = library.get_by_role("button", name=re.compile("^ball")).first
    first.click()
    expect(shown.get_by_role("heading", name="ball", exact=True)).to_be_visible()
    expect(library).to_have_count(0)
    expect(inspector).to_have_count(0)
    page.settle()

    to_library.click()
    expect(library).to_be_visible()
    expect(inspector).to_have_count(0)
    first.click()  # it is open already: the way back to it
    expect(library).to_have_count(0)

    to_library.click()
    to_inspector.click()
    expect(inspector).to_be_visible()
    expect(library).to_have_count(0)
    expect(to_inspector).to_have_attribute("aria-pressed", "true")
    to_library.click()
    expect(library).to_be_visible()
    expect(to_inspector).to_have_attribute("aria-pressed", "false")
    to_library.click()
    to_inspector.click()
    expect(inspector).to_have_count(0)

    # The object keeps its size and moves as what is free does; the line below the picture is whole.
    line = shown.locator(".hud")
    assert line.evaluate("line => line.scrollWidth <= line.clientWidth")
    low, height = rows_of_the_ball(page)
    to_inspector.click()
    higher = (line.bounding_box()["y"] - inspector.bounding_box()["y"]) / 2
    assert higher > 100
    wait_until(
        lambda: abs(low - rows_of_the_ball(page)[0] - higher) < NEARLY,
        lambda: f"the ball above: {low}, {higher}, {rows_of_the_ball(page)}",
        30,
    )
    assert abs(rows_of_the_ball(page)[1] - height) < NEARLY
    to_inspector.click()
    wait_until(lambda: abs(rows_of_the_ball(page)[0] - low) < NEARLY, lambda: f"the ball where it was: {low}, {rows_of_the_ball(page)}", 30)


NEARLY = 16.0
"""CSS pixels of the phone's 844."""


def rows_of_the_ball(viewer: Viewer) -> tuple[float, float]:
    """Where its colours begin, and how far down they go [CSS pixels]."""
    picture = viewer.settled_picture()
    rows = np.flatnonzero(((picture.max(-1) - picture.min(-1)) > 60).any(1)) * (PHONE["height"] / len(picture))
    return float(rows[0]), float(rows[-1] - rows[0])


def test_on_a_larger_screen_panels_stay_beside_an_asset_that_was_opened(page: Viewer, ball_asset: str) -> None:
    page.page.set_viewport_size(LAPTOP)  # type: ignore[arg-type]
    page.page.get_by_role("complementary", name="Library").get_by_role("button", name=re.compile("^ball")).first.click()
    expect(page.page.get_by_role("heading", name="ball", exact=True)).to_be_visible()
    expect(page.page.get_by_role("complementary", name="Library")).to_be_visible()
    expect(page.page.get_by_role("complementary", name="Inspector")).to_be_visible()
