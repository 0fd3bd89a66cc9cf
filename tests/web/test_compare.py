"""Comparing in the browser: photographs from their own cameras, whatever the window's shape, and the object as captured beside the present one.

The photographs are pictures that our own renderer took of the ball, so that they must agree with what the page shows of it.
"""

import base64
import io
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import httpx
import numpy as np
import pytest
import torch
from PIL import Image
from playwright.sync_api import Browser, expect

from drgs.convert.import_mesh import import_mesh
from drgs.deform.pose_scene import pose_scene
from drgs.exchange.photographs import encode_photographs
from drgs.render.records import RenderSettings
from drgs.render.render_frame import render_frame
from drgs.scene.asset import Asset, save_asset
from drgs.scene.camera import Camera, camera_from_opengl
from tests.patience import PATIENCE_SECONDS
from tests.web.browser import RunningServer
from tests.web.conftest import Viewer, frame_alone, shown_page, wait_until

WIDTH, HEIGHT = 120, 90
INTRINSICS = torch.tensor([[150.0, 0, 42], [0, 150, 55], [0, 0, 1]])
"""The axis is well off the picture's middle."""


def camera_at(azimuth_degrees: float, roll_degrees: float, name: str) -> Camera:
    azimuth, roll = np.radians([azimuth_degrees, roll_degrees])
    backward = np.array([np.cos(azimuth), np.sin(azimuth), 0.4]) / np.hypot(1, 0.4)
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0])
    up = np.cross(backward, right)
    pose = np.eye(4)
    pose[:3, 0], pose[:3, 1] = np.cos(roll) * right + np.sin(roll) * up, np.cos(roll) * up - np.sin(roll) * right
    pose[:3, 2], pose[:3, 3] = backward, 2.2 * backward
    return camera_from_opengl(torch.tensor(pose), INTRINSICS, WIDTH, HEIGHT, name)


def photograph(asset: Asset, camera: Camera) -> np.ndarray:
    """(height, width, 3) uint8 over the asset's own white sky."""
    settings = RenderSettings(samples_per_pixel=128, background="environment")
    rgba = render_frame(pose_scene(asset, []), camera, settings).rgba_srgb
    return (rgba[..., :3].clamp(0, 1) * 255 + 0.5).to(torch.uint8).numpy()


@pytest.fixture(scope="module")
def photographs() -> list[np.ndarray]:
    return []


@pytest.fixture(scope="module")
def captured(
    server: RunningServer, browser: Browser, ball_file: Path, photographs: list[np.ndarray], tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Viewer]:
    """The page with the ball open as if it had been built from three photographs, one of them taken with a tilted camera."""
    cameras = (camera_at(-60, 0, "front"), camera_at(60, 25, "tilted"), camera_at(180, 0, "back"))
    asset = replace(import_mesh(ball_file), cameras=cameras)
    photographs += [photograph(asset, camera) for camera in cameras]
    path = tmp_path_factory.mktemp("captured") / "captured.zip"
    save_asset(asset, path, None, encode_photographs(photographs))
    answer = httpx.post(
        f"{server.address}/api/assets",
        files={"file": ("captured.zip", path.read_bytes())},
        headers={"Authorization": f"Bearer {server.token}"},
        timeout=PATIENCE_SECONDS,
    )
    assert answer.status_code == 201, answer.text
    with shown_page(server, browser, answer.json()["id"]) as viewer:
        expect(viewer.page.get_by_role("heading", name="captured", exact=True)).to_be_visible()
        frame_alone(viewer)
        viewer.open_tab("View")
        yield viewer


def shown_where_the_photograph_lies(viewer: Viewer) -> np.ndarray:
    """(HEIGHT, WIDTH, 3) of the traced picture, where the page lays the photograph over it."""
    viewer.page.wait_for_selector(".photograph[data-shown=true]")
    viewer.settle()
    box = viewer.page.evaluate(
        "(({ x, y, width, height }) => [x, y, width, height])(document.querySelector('.photograph').getBoundingClientRect())"
    )
    data = viewer.page.evaluate("document.querySelector('canvas.traced').toDataURL('image/png')")
    picture = Image.open(io.BytesIO(base64.b64decode(data.partition(",")[2]))).convert("RGB")
    scale = picture.width / viewer.page.evaluate("innerWidth")
    x, y, width, height = (scale * value for value in box)
    return np.asarray(picture.resize((WIDTH, HEIGHT), Image.Resampling.BILINEAR, (x, y, x + width, y + height)), float)


def difference(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.abs(a - b).mean())


def shift(picture: np.ndarray) -> np.ndarray:
    return np.roll(picture, 4, 1)


def test_photographs_lie_exactly_over_what_the_page_shows_from_their_cameras(captured: Viewer, photographs: list[np.ndarray]) -> None:
    before = captured.settled_picture()
    captured.page.locator(".stage").focus()
    captured.page.keyboard.press("c")
    expect(captured.page.locator(".view-bar")).to_contain_text("front · 1 of 3")  # nearest to the first view
    for name, picture in zip(("front", "tilted", "back"), photographs, strict=True):
        expect(captured.page.locator(".view-bar")).to_contain_text(name)
        taken = picture.astype(float)
        wait_until(lambda taken=taken: difference(shown_where_the_photograph_lies(captured), taken) < 7, f"{name} as photographed")
        shown = shown_where_the_photograph_lies(captured)
        assert difference(shown, taken) < 0.5 * difference(shown, shift(taken)), f"{name} is out of place"
        captured.page.keyboard.press("ArrowRight")
    expect(captured.page.locator(".view-bar")).to_contain_text("front")
    captured.page.keyboard.press("ArrowLeft")
    expect(captured.page.locator(".view-bar")).to_contain_text("back")
    captured.page.keyboard.press("Escape")
    expect(captured.page.locator(".view-bar")).to_have_count(0)
    wait_until(lambda: np.abs(captured.settled_picture() - before).mean() < 2, "the camera where it was")


def test_on_a_phone_a_photograph_has_the_page_to_itself_below_the_bar_of_views(captured: Viewer) -> None:
    page = captured.page
    window = page.viewport_size
    page.set_viewport_size({"width": 390, "height": 844})
    page.get_by_role("switch", name="Photographs, from their own cameras").click()  # which is gone then
    page.wait_for_selector(".photograph[data-shown=true]")

    def places() -> list[dict[str, float]]:
        return [page.locator(which).bounding_box() for which in (".view-bar", ".photograph", ".hud")]

    def apart() -> bool:
        bar, picture, line = places()
        return bar["y"] >= 44 and bar["y"] + bar["height"] <= picture["y"] + 1 and picture["y"] + picture["height"] <= line["y"] + 1

    try:
        expect(page.locator(".panel")).to_have_count(0)
        wait_until(apart, lambda: f"bar, photograph and state one below the other: {places()}", 20)
        assert places()[1]["width"] > 0.6 * 390
        page.get_by_role("button", name="Leave the view").click()
    finally:
        page.set_viewport_size(window)
        page.get_by_role("button", name="Inspector", exact=True).click()


def test_a_photograph_fits_between_the_panels_and_fades_by_its_slider(captured: Viewer, photographs: list[np.ndarray]) -> None:
    captured.page.get_by_role("switch", name="Photographs, from their own cameras").check()
    captured.page.wait_for_selector(".photograph[data-shown=true]")
    picture, panel = (captured.page.locator(which).bounding_box() for which in (".photograph", ".inspector"))
    assert picture["x"] + picture["width"] <= panel["x"] + 1 and picture["x"] >= 0 and picture["y"] >= 43
    for percent in ("0", "100"):
        captured.page.get_by_label("Photograph, exact value").fill(percent)
        captured.page.get_by_label("Photograph, exact value").press("Enter")
        assert captured.page.evaluate("getComputedStyle(document.querySelector('.photograph')).opacity") == str(int(percent) // 100)
    captured.page.get_by_role("switch", name="Photographs, from their own cameras").uncheck()
    expect(captured.page.locator(".photograph")).to_have_count(0)


def halves(viewer: Viewer) -> tuple[np.ndarray, np.ndarray]:
    """Mean colours of the ball just left and just right of the window's middle, as the screen shows them."""
    screen = np.asarray(Image.open(io.BytesIO(viewer.page.screenshot())).convert("RGB"), float)
    line = viewer.page.locator(".divider").bounding_box()
    scale = screen.shape[1] / viewer.page.evaluate("innerWidth")
    x, y = scale * (line["x"] + line["width"] / 2), screen.shape[0] // 2 + 22
    left, right = slice(int(x) - 26, int(x) - 10), slice(int(x) + 10, int(x) + 26)
    return screen[y - 30 : y - 10, left].mean((0, 1)), screen[y - 30 : y - 10, right].mean((0, 1))


def test_the_split_shows_the_object_as_captured_beside_the_present_one(captured: Viewer) -> None:
    captured.append_edit({"op": "material", "select": {"all": True}, "set": {"albedo": [0.0, 0.0, 0.0]}})
    captured.settle()
    captured.page.keyboard.press("Shift+B")
    divider = captured.page.get_by_role("slider", name="Split between before and now")
    wait_until(lambda: captured.stage()["split"] == "true", "a split window")
    first = int(divider.get_attribute("aria-valuenow"))
    assert 28 < first < 34, "the middle of what the inspector leaves free"
    divider.focus()
    captured.page.keyboard.press("Shift+ArrowRight")
    expect(divider).to_have_attribute("aria-valuenow", str(first + 10))
    captured.page.keyboard.press("Shift+ArrowLeft")

    def is_black_on_the_right_only() -> bool:
        captured.settle()
        left, right = halves(captured)
        return left.max() > 100 and right.max() < 90

    wait_until(is_black_on_the_right_only, lambda: f"colours left and right of the divider: {halves(captured)}")
    # Traced as well, once the camera has been still for a while.
    expect(captured.page.locator(".captured-still")).to_be_visible()
    wait_until(is_black_on_the_right_only, lambda: f"colours beside the divider: {halves(captured)}")
    box = divider.bounding_box()
    captured.page.mouse.move(box["x"] + 12, 150)
    captured.page.mouse.down()
    captured.page.mouse.move(box["x"] + 12 + 76, 150, steps=3)
    captured.page.mouse.up()
    expect(divider).to_have_attribute("aria-valuenow", str(first + 10))
    captured.page.keyboard.press("Shift+B")
    expect(divider).to_have_count(0)
    captured.undo()
    captured.wait_for_edits(0)


def middle(viewer: Viewer) -> np.ndarray:
    """Mean colour of the ball's middle, which is that of what the inspector leaves of the window."""
    picture = viewer.settled_picture()
    share = viewer.page.locator(".inspector").bounding_box()["x"] / 2 / viewer.page.evaluate("innerWidth")
    x, y = int(share * picture.shape[1]), picture.shape[0] // 2
    return picture[y - 12 : y + 12, x - 12 : x + 12].mean((0, 1))


def test_number_keys_show_what_lies_behind_the_picture_with_a_legend(captured: Viewer) -> None:
    shown = captured.page.get_by_role("group", name="Show")
    captured.page.keyboard.press("7")
    expect(shown.get_by_role("radio", name="Open sky")).to_be_checked()
    expect(captured.hint("White sees all of the sky")).to_be_visible()
    wait_until(lambda: middle(captured).min() > 250, "a ball that sees all of the sky")
    captured.page.keyboard.press("8")
    wait_until(lambda: middle(captured).max() < 4, "a ball without indirect light")
    captured.page.keyboard.press("9")
    expect(captured.page.locator(".legend .scale.heat")).to_be_visible()
    # From the dark blue of the scale's beginning on; the ball's own red is not on it.
    wait_until(lambda: (color := middle(captured))[2] > color[0] and color.max() > 8, "blue for little noise")
    captured.page.keyboard.press("0")
    expect(captured.hint("it has no surfels to show")).to_be_visible()
    wait_until(lambda: middle(captured).max() < 4, "nothing")
    captured.page.keyboard.press("1")
    wait_until(lambda: middle(captured)[0] > 100, "the final picture")


def orange_share(viewer: Viewer) -> float:
    """Share of the screen that has the colour of edges, a mixture with what lies under them."""
    red, green, blue = np.moveaxis(
        np.asarray(Image.open(io.BytesIO(viewer.page.screenshot())).convert("RGB"), float)[30:180, 20:210], -1, 0
    )
    return float(((red - green > 25) & (green - blue > 25)).mean())


def test_the_edges_of_the_mesh_lie_over_any_channel(captured: Viewer) -> None:
    captured.page.keyboard.press("7")
    wait_until(lambda: middle(captured).min() > 250, "a white ball")
    assert orange_share(captured) < 0.002
    captured.page.get_by_role("switch", name="Edges of the mesh").check()
    wait_until(lambda: orange_share(captured) > 0.05, "edges over the white ball")
    captured.page.keyboard.press("e")
    wait_until(lambda: orange_share(captured) < 0.002, "no edges")
    captured.page.keyboard.press("1")
    captured.settle()


def test_an_imported_mesh_says_that_it_has_no_photographs(captured: Viewer, ball_file: Path) -> None:
    captured.page.get_by_role("button", name="Library").click()
    captured.page.get_by_label("Capture or mesh").set_input_files(ball_file)
    expect(captured.page.get_by_role("heading", name="ball", exact=True)).to_be_visible()
    expect(captured.hint("no photographs to compare with: this asset was made from a mesh")).to_be_visible()
    assert captured.complaints == []
