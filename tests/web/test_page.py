"""An exported page, opened from a folder without a network: it shows the object, relights it, and asks nobody for anything."""

import io
import itertools
import json
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from playwright.sync_api import Browser, ConsoleMessage, Page, expect

from benchmarks.convert.page import camera_of
from drgs.convert.export_asset import export_asset
from drgs.convert.import_mesh import import_mesh
from drgs.deform.pose_scene import pose_scene
from drgs.render.records import RenderSettings
from drgs.render.render_frame import render_frame
from drgs.scene.asset import Asset
from drgs.scene.edits import parse_edits
from drgs.scene.environment import Environment
from drgs.scene.three_point_lights import paint_three_point_lights
from tests.patience import PATIENCE_SECONDS
from tests.web.browser import ROOT
from tests.web.conftest import wait_until

SIZE = {"width": 760, "height": 420}
DIFFERENCE = 4.0
"""Mean over pixels and channels inside the ball, sRGB 0..255: light is filtered instead of sampled, and shadows are nine numbers."""


GOLDEN_CAP = {
    "op": "material",
    "select": {"sphere": {"center": [0, 0, 0.5], "radius": 0.6}},
    "set": {"albedo": [1.0, 0.77, 0.34], "metallic": 1.0},
}
VARIANTS = {
    "Golden cap": parse_edits([GOLDEN_CAP]),
    "Clay": parse_edits([GOLDEN_CAP | {"set": {"roughness": 0.9}, "select": {"all": True}}]),
}
"""The second has the name of a preset."""


@dataclass
class OpenedPage:
    page: Page
    asset: Asset
    heard: list[str] = field(default_factory=list)
    """Requests beside the page itself, errors and warnings."""

    def pictures(self) -> int:
        return int(self.page.evaluate("document.querySelector('.stage')?.dataset.pictures ?? 0"))

    def picture(self) -> np.ndarray:
        """(height, width, 3) sRGB 0..255, once nothing moves any more."""
        seen = -1
        while seen != (seen := self.pictures()):
            self.page.wait_for_timeout(400)
        data = self.page.screenshot()
        return np.asarray(Image.open(io.BytesIO(data)).convert("RGB"), float)


def open_page(browser: Browser, path: Path, asset: Asset, **options: object) -> OpenedPage:
    context = browser.new_context(offline=True, reduced_motion="reduce", color_scheme="dark", **options)  # type: ignore[arg-type]
    page = context.new_page()
    page.set_default_timeout(1000 * PATIENCE_SECONDS)
    opened = OpenedPage(page, asset)

    def hear(message: ConsoleMessage) -> None:
        # The driver's advice about this very test: it looks at pictures often.
        if message.type in ("error", "warning") and "ReadPixels" not in message.text:
            opened.heard.append(message.text)

    page.on("console", hear)
    page.on("pageerror", lambda error: opened.heard.append(str(error)))
    page.on("request", lambda request: opened.heard.append(request.url))
    page.goto(path.as_uri())
    wait_until(lambda: opened.pictures() or page.get_by_role("alert").count(), "the page to draw")
    opened.heard.remove(path.as_uri())
    return opened


@pytest.fixture(scope="module")
def ball_page(built: None, ball_file: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Asset]:
    imported = import_mesh(ball_file)
    light = Environment(torch.from_numpy(paint_three_point_lights(128)))
    asset = Asset(None, imported.mesh, None, light, provenance={"dataset": "painted_ball"})
    path = tmp_path_factory.mktemp("page") / "ball with blanks.html"
    assert export_asset(asset, path, "html", variants=VARIANTS) == ""
    return path, asset


@pytest.fixture(scope="module")
def opened(browser: Browser, ball_page: tuple[Path, Asset]) -> Iterator[OpenedPage]:
    opened = open_page(browser, *ball_page, viewport=SIZE)
    yield opened
    opened.page.context.close()


@pytest.fixture(autouse=True)
def nothing_was_asked_for(opened: OpenedPage) -> Iterator[None]:
    yield
    data = [url for url in opened.heard if url.startswith("data:")]  # pictures that the page has drawn itself
    assert [said for said in opened.heard if said not in data] == []


def test_the_page_looks_as_the_object_is_rendered(opened: OpenedPage) -> None:
    page = opened.page
    assert page.title() == "painted ball" and page.get_by_role("heading", name="painted ball").is_visible()
    page.get_by_role("switch", name="Show the light").uncheck()
    page.get_by_role("button", name="Light and material").click()
    theirs = opened.picture()
    settings = RenderSettings(samples_per_pixel=64, denoise="svgf", primary="mesh")
    ours = render_frame(pose_scene(opened.asset, []), camera_of(page, SIZE["width"], SIZE["height"]), settings).rgba_srgb.numpy() * 255
    page.get_by_role("button", name="Light and material").click()
    inside = ours[..., 3] > 254
    assert 0.1 < inside.mean() < 0.7 and inside[50:].sum() == inside.sum(), "the ball stands below the title"
    difference = np.abs(theirs - ours[..., :3])[inside].mean()
    print(f"mean difference {difference:.2f} of 255")
    assert difference < DIFFERENCE
    outside = theirs[~inside & (np.arange(SIZE["height"]) > 60)[:, None]]
    assert np.median(outside) < 80, "the dark of the page around it"


def test_variants_are_put_on_as_an_asset_wears_them(opened: OpenedPage, browser: Browser, tmp_path: Path) -> None:
    """To the last bit: nothing of a ball stands in the way of its own light, so nothing else changes with its material."""
    page = opened.page
    page.get_by_role("switch", name="Show the light").uncheck()
    page.get_by_role("radio", name="Golden cap").check(force=True)
    worn = opened.picture()
    assert page.get_by_role("radio", name="Clay").count() == 1, "instead of the preset"
    asset = replace(opened.asset, mesh=pose_scene(opened.asset, VARIANTS["Golden cap"]).mesh)
    export_asset(asset, tmp_path / "worn.html", "html")
    other = open_page(browser, tmp_path / "worn.html", asset, viewport=SIZE)
    other.page.get_by_role("switch", name="Show the light").uncheck()
    np.testing.assert_array_equal(worn[60:, :400], other.picture()[60:, :400], "what the panel leaves of the picture")
    other.page.context.close()
    page.get_by_role("radio", name="Chrome").check(force=True)
    chrome = opened.picture()
    page.get_by_role("radio", name="Clay").check(force=True)
    clay = opened.picture()
    page.get_by_role("radio", name="As captured").last.check(force=True)
    captured = opened.picture()
    assert min(np.abs(a - b)[60:, :400].mean() for a, b in itertools.combinations((worn, chrome, clay, captured), 2)) > 0.5


def test_light_material_and_hand_change_the_picture(opened: OpenedPage) -> None:
    page = opened.page
    page.get_by_role("switch", name="Show the light").check()
    changes = (
        lambda: page.get_by_role("radio", name="Evening").check(),
        lambda: page.locator("#slider-turn").fill("120"),
        lambda: page.locator("#slider-exposure").fill("1"),
        lambda: page.get_by_role("radio", name="Chrome").check(force=True),
        lambda: page.locator("#slider-roughness").fill("0.9"),
        lambda: page.locator("#slider-metallic").fill("0"),
        lambda: page.locator("#tint").fill("#ff2010"),
        lambda: page.locator(".stage").press("ArrowRight"),
        lambda: (page.mouse.move(200, 250), page.mouse.wheel(0, 200)),
    )
    before = opened.picture()
    for change in changes:
        change()
        after = opened.picture()
        assert np.abs(after - before)[60:, :400].mean() > 0.5, "what the panel leaves of the picture"
        before = after
    page.get_by_role("radio", name="As captured").last.check(force=True)
    expect(page.get_by_label("Reset roughness")).to_be_disabled()


def test_the_object_turns_by_itself_until_it_is_told_to_stop(opened: OpenedPage) -> None:
    seen = opened.pictures()
    opened.page.get_by_role("button", name="Turn by itself").click()
    wait_until(lambda: opened.pictures() > seen + 3, "more pictures")
    opened.page.get_by_role("button", name="Turn by itself").click()
    opened.picture()
    seen = opened.pictures()
    opened.page.wait_for_timeout(300)
    assert opened.pictures() == seen, "nothing is drawn while nothing changes"


def test_a_phone_has_the_object_above_the_panel_and_everything_in_reach(browser: Browser, ball_page: tuple[Path, Asset]) -> None:
    phone = open_page(browser, *ball_page, viewport={"width": 390, "height": 844}, has_touch=True)
    page = phone.page
    page.get_by_role("button", name="Light and material").tap()
    panel = page.locator(".panel").bounding_box()
    assert panel is not None and panel["y"] > 380 and panel["y"] + panel["height"] <= 844
    center = json.loads(page.locator(".stage").get_attribute("data-camera") or "")["center"]
    assert center[1] == pytest.approx((44 + panel["y"]) / 2, abs=8)
    assert page.evaluate("document.documentElement.scrollWidth") == 390
    page.evaluate((ROOT / "web" / "node_modules" / "axe-core" / "axe.min.js").read_text())
    faults = page.evaluate("axe.run().then((found) => found.violations.map(({ id, nodes }) => `${id}: ${nodes[0].html}`))")
    assert faults == []
    page.context.close()


def test_a_page_that_was_cut_off_says_so(browser: Browser, ball_page: tuple[Path, Asset], tmp_path: Path) -> None:
    text = ball_page[0].read_text()
    start = text.index('type="text/plain">') + len('type="text/plain">')
    (tmp_path / "cut.html").write_text(text[: start + 1000])
    cut = open_page(browser, tmp_path / "cut.html", ball_page[1])
    expect(cut.page.get_by_role("alert")).to_contain_text("cannot be shown")
    cut.page.context.close()
