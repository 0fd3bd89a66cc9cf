"""Light, shape, camera, export: each panel and gesture shows in pixels or in the server's log. And all of it can be used without a mouse."""

import io
import json
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from PIL import Image
from playwright.sync_api import expect

from tests.web.browser import ROOT
from tests.web.conftest import Viewer, wait_until
from tests.web.test_viewer_turns_light import SWITCH

TOO_SMALL_TO_SEE = 6.0
AXE = ROOT / "web" / "node_modules" / "axe-core" / "axe.min.js"


@pytest.fixture(autouse=True)
def from_nothing(ball: Viewer) -> None:
    ball.page.keyboard.press("Escape")
    ball.page.get_by_role("button", name="As captured").click()
    ball.wait_for_edits(0)
    ball.settle()  # the log is ahead of the page, which would make what is pressed now out of edits that are gone
    ball.page.locator(".stage").focus()


def type_number(viewer: Viewer, label: str, value: str) -> None:
    field = viewer.page.get_by_label(f"{label}, exact value")
    field.fill(value)
    field.press("Enter")


def wait_for_change(viewer: Viewer, before: np.ndarray, what: str) -> None:
    wait_until(lambda: (now := viewer.settled_picture()).shape == before.shape and np.abs(now - before).mean() > 1, what)


def test_a_dropped_environment_joins_the_gallery_and_lights_the_object(ball: Viewer, tmp_path: Path) -> None:
    before = ball.settled_picture()
    red = np.zeros((16, 32, 3), np.float32)
    red[..., 0] = 2
    path = tmp_path / "red.exr"
    OpenEXR.File({"type": OpenEXR.scanlineimage}, {"RGB": red}).write(str(path))
    ball.open_tab("Light")
    ball.page.evaluate(
        """(bytes) => {
          const files = new DataTransfer();
          files.items.add(new File([new Uint8Array(bytes)], 'red.exr'));
          window.dispatchEvent(new DragEvent('drop', { dataTransfer: files, bubbles: true, cancelable: true }));
        }""",
        list(path.read_bytes()),
    )
    expect(ball.page.get_by_role("radio", name="Red", exact=True)).to_be_checked()
    (edit,) = ball.wait_for_edits(1)
    assert edit["file"] == "red.exr"
    wait_for_change(ball, before, "a picture in red light")
    color = ball.settled_color()
    assert color[0] > 4 * max(color[1:]), color


def test_exposure_and_background_change_the_picture_but_not_the_log(ball: Viewer) -> None:
    before = ball.settled_color()
    ball.open_tab("Light")
    type_number(ball, "Exposure", "-2")
    wait_until(lambda: sum(ball.settled_color()) < 0.7 * sum(before), "a darker picture")
    ball.page.get_by_role("button", name="Reset exposure").click()
    ball.page.get_by_role("radio", name="Colour", exact=True).check()
    wait_until(lambda: np.abs(ball.settled_picture()[4, 4] - 128).max() < 4, "a grey corner")
    ball.page.get_by_role("radio", name="Light", exact=True).check()
    assert ball.edits() == []


def test_a_twist_can_be_changed_in_place_and_undone_to_the_value_before(ball: Viewer) -> None:
    before = ball.settled_picture()
    ball.open_tab("Shape")
    type_number(ball, "Twist", "90")
    (edit,) = ball.wait_for_edits(1)
    assert edit["map"]["type"] == "twist" and edit["map"]["rate"] == pytest.approx(np.pi / 2, rel=0.01)
    wait_for_change(ball, before, "a twisted ball")
    type_number(ball, "Twist", "180")
    wait_until(lambda: [round(edit["map"]["rate"], 2) for edit in ball.edits()] == [3.14], "the new twist in place of the old one")
    ball.page.keyboard.press("Escape")
    ball.undo()
    wait_until(lambda: [round(edit["map"]["rate"], 2) for edit in ball.edits()] == [1.57], "the twist before")
    ball.redo()
    wait_until(lambda: [round(edit["map"]["rate"], 2) for edit in ball.edits()] == [3.14], "the twist again")


def test_the_local_picture_follows_a_stretch_while_the_slider_is_held(ball: Viewer) -> None:
    ball.settle()
    ball.open_tab("Shape")
    frames = int(ball.stage()["localFrames"])
    ball.page.get_by_label("Stretch", exact=True).evaluate(
        "(slider) => { slider.value = 1.6; slider.dispatchEvent(new Event('input', { bubbles: true })); }"
    )
    wait_until(lambda: int(ball.stage()["localFrames"]) > frames and ball.stage()["picture"] == "stale", "a local picture of the stretch")
    assert ball.edits() == []
    ball.page.get_by_label("Stretch", exact=True).evaluate("(slider) => slider.dispatchEvent(new Event('change', { bubbles: true }))")
    (edit,) = ball.wait_for_edits(1)
    assert edit["map"] == {"type": "stretch", "factor": 1.6}


def test_matter_falls_and_its_time_can_be_set(ball: Viewer) -> None:
    ball.open_tab("Shape")
    type_number(ball, "Length", "0.25")
    before = ball.settled_picture()
    ball.page.get_by_role("button", name="Let it go").click()
    wait_until(lambda: any(edit.get("time", 0) > 0 for edit in ball.edits()), "a simulation that plays", 60)
    ball.page.get_by_role("button", name="Pause").click()
    type_number(ball, "Time", "0.2")
    wait_until(lambda: [edit.get("time") for edit in ball.edits()][-1:] == [0.2], "the moment that was typed", 60)
    wait_for_change(ball, before, "the ball lower down")
    ball.page.get_by_role("button", name="Remove").click()
    assert [edit["scene"]["duration"] for edit in ball.wait_for_edits(1)] == [0.25]
    ball.page.get_by_role("button", name="As captured").click()
    ball.wait_for_edits(0)


def test_a_variant_is_kept_named_and_put_in_force_by_the_strip(ball: Viewer) -> None:
    page = ball.page
    captured = ball.settled_color()
    ball.open_tab("Material")
    page.locator(".preset").get_by_role("button", name="Gold", exact=True).click()
    ball.wait_for_edits(1)
    gold = ball.settled_color()
    page.get_by_role("button", name="Add what is shown").click()
    ball.wait_for_edits(2)
    expect(page.get_by_role("button", name="Add what is shown")).to_be_disabled()
    name = page.get_by_label("Name of Variant 1")
    name.fill("Gilt")
    name.press("Enter")
    wait_until(lambda: [edit["name"] for edit in ball.edits() if edit["op"] == "variant"] == ["Gilt"], "the new name")
    expect(page.locator(".variants img")).to_have_count(2)
    plain, gilt = (
        np.asarray(Image.open(io.BytesIO(picture.screenshot())).convert("RGB"), float) for picture in page.locator(".variants img").all()
    )
    assert np.abs(plain - gilt).mean((0, 1)).max() > 8
    # The object itself: its red and its green third are there as captured, and all of it is gold.
    red, green = ([(picture[..., one] > picture[..., other] + 40).mean() for picture in (plain, gilt)] for one, other in ((0, 1), (1, 0)))
    assert red[0] > 0.1 and green[0] > 0.01 and green[1] == 0, (red, green)
    page.get_by_role("button", name="Apply captured materials").click()
    assert [edit["op"] for edit in ball.wait_for_edits(1)] == ["variant"]
    assert np.abs(np.subtract(ball.settled_color(), captured)).max() < TOO_SMALL_TO_SEE
    page.get_by_role("button", name="Apply Gilt").click()
    assert [edit["op"] for edit in ball.wait_for_edits(2)] == ["variant", "material"]
    expect(page.get_by_role("button", name="Apply Gilt")).to_have_attribute("aria-pressed", "true")
    assert np.abs(np.subtract(ball.settled_color(), gold)).max() < TOO_SMALL_TO_SEE
    page.get_by_role("button", name="Remove Gilt").click()
    assert [edit["op"] for edit in ball.wait_for_edits(1)] == ["material"]
    page.locator(".stage").focus()
    ball.undo()
    assert [edit["op"] for edit in ball.wait_for_edits(2)] == ["variant", "material"]


def test_four_lights_are_compared_and_one_is_put_in_force(ball: Viewer) -> None:
    page = ball.page
    ball.open_tab("Light")
    page.get_by_role("button", name="Compare lights").click()
    dialog = page.get_by_role("dialog", name="Lights compared")
    expect(dialog.get_by_role("img")).to_have_count(4)
    names = dialog.get_by_role("combobox").evaluate_all("(all) => all.map((one) => one.value)")
    assert names[0] == "captured" and len(set(names)) == 4
    means = [
        np.asarray(Image.open(io.BytesIO(picture.screenshot())).convert("RGB"), float).mean((0, 1))
        for picture in dialog.get_by_role("img").all()
    ]
    assert all(np.abs(a - b).max() > 4 for k, a in enumerate(means) for b in means[:k]), f"four lights, four pictures; found means {means}"
    assert ball.edits() == []
    dialog.get_by_label("Light 2").select_option(names[3])
    expect(dialog.get_by_role("img")).to_have_count(4)
    dialog.get_by_role("button", name="Use").nth(1).click()
    (edit,) = ball.wait_for_edits(1)
    assert edit["file"] == names[3]
    expect(dialog).not_to_be_visible()
    ball.undo()
    ball.wait_for_edits(0)


def test_flying_moves_the_camera_with_the_keys_and_v_ends_it(ball: Viewer) -> None:
    before = ball.settled_picture()
    ball.page.keyboard.press("v")
    expect(ball.page.locator(".stage[data-flying=true]")).to_be_visible()
    frames = int(ball.stage()["localFrames"])
    ball.page.keyboard.down("KeyW")
    wait_until(lambda: int(ball.stage()["localFrames"]) > frames + 8, "a camera on its way")
    ball.page.keyboard.up("KeyW")
    wait_for_change(ball, before, "a picture from nearer by")
    ball.page.keyboard.press("v")
    ball.page.keyboard.press("Shift+F")
    expect(ball.page.locator(".stage[data-flying=false]")).to_be_visible()
    wait_until(lambda: np.abs(ball.settled_picture() - before).mean() < 2, "the first view")


def test_a_double_click_puts_the_focus_on_the_surface(ball: Viewer) -> None:
    before = ball.settled_picture()
    ball.page.mouse.dblclick(200, 170)
    wait_for_change(ball, before, "a picture round another point")
    ball.page.keyboard.press("Shift+F")
    wait_until(lambda: np.abs(ball.settled_picture() - before).mean() < 2, "the first view")


def test_history_goes_back_and_forth_by_a_click(ball: Viewer) -> None:
    ball.open_tab("Material")
    ball.page.get_by_role("button", name="Gold").click()
    ball.wait_for_edits(1)
    ball.page.wait_for_timeout(600)  # longer than what makes one undo step of two edits
    ball.page.get_by_role("button", name="Copper").click()
    ball.wait_for_edits(2)
    history = ball.page.get_by_role("list", name="Edits in force")
    history.get_by_role("button", name="Gold").click()
    ball.wait_for_edits(1)
    expect(history.get_by_role("button", name="Copper")).to_be_visible()
    history.get_by_role("button", name="Copper").click()
    ball.wait_for_edits(2)


def test_a_still_has_the_size_and_transparency_that_were_chosen(ball: Viewer) -> None:
    ball.open_tab("Export")
    ball.page.get_by_role("radio", name="1024²").check()
    ball.page.get_by_role("radio", name="32", exact=True).check()
    ball.page.get_by_role("switch", name="Transparent background").check()
    with ball.page.expect_download() as download:
        ball.page.get_by_role("button", name="Render PNG").click()
    picture = Image.open(download.value.path())
    assert picture.size == (1024, 1024) and picture.mode == "RGBA"
    alpha = np.asarray(picture)[..., 3]
    assert alpha[0, 0] == 0 and alpha.max() == 255


def test_scripts_hold_the_edits_and_the_camera(ball: Viewer) -> None:
    ball.page.context.grant_permissions(["clipboard-read", "clipboard-write"])
    ball.open_tab("Material")
    ball.page.get_by_role("button", name="Rubber").click()
    ball.wait_for_edits(1)
    expect(ball.page.get_by_role("list", name="Edits in force").get_by_role("button", name="Rubber")).to_be_visible()
    ball.open_tab("Export")
    ball.page.get_by_role("button", name="Copy as Python").click()
    expect(ball.page.get_by_role("log").get_by_text("Python for this picture is on the clipboard.")).to_be_visible()
    script = ball.page.evaluate("navigator.clipboard.readText()")
    compile(script, "script", "exec")
    assert '"roughness": 0.85' in script and "world_from_camera=camera" in script


def test_each_page_of_the_inspector_begins_at_its_top(ball: Viewer) -> None:
    ball.open_tab("Material")
    for name, first in (("Light", "Captured"), ("Shape", "Twist"), ("Export", "Width"), ("Material", "Region")):
        panel = ball.page.get_by_role("tabpanel")
        panel.evaluate("panel => { panel.scrollTop = panel.scrollHeight; }")
        assert panel.evaluate("panel => panel.scrollTop") > 0
        ball.open_tab(name)
        expect(ball.page.get_by_role("tabpanel", name=name)).to_be_visible()
        assert ball.page.get_by_role("tabpanel").evaluate("panel => panel.scrollTop") == 0, f"{name}, where {first} is on top"


def test_an_object_whose_light_stands_still_has_no_switch_that_turns_it(ball: Viewer) -> None:
    ball.open_tab("Light")
    expect(ball.page.get_by_role("slider", name="Intensity")).to_be_visible()
    expect(ball.page.get_by_role("switch", name=SWITCH)).to_have_count(0)


@pytest.mark.parametrize("theme", ["dark", "light"])
def test_no_panel_has_a_serious_accessibility_fault(ball: Viewer, theme: str) -> None:
    if ball.page.evaluate("document.documentElement.dataset.theme") != theme:
        ball.page.keyboard.press("t")
    ball.page.evaluate(AXE.read_text())
    ball.open_tab("Material")
    ball.page.locator(".preset").get_by_role("button", name="Gold", exact=True).click()
    ball.page.get_by_role("button", name="Add what is shown").click()
    ball.wait_for_edits(2)
    faults = {}
    for tab in ("Material", "Light", "Shape", "View", "Export"):
        ball.open_tab(tab)
        found = ball.page.evaluate(
            "() => axe.run(document, { resultTypes: ['violations'] }).then(({ violations }) => violations"
            ".filter(({ impact }) => impact === 'serious' || impact === 'critical').map(({ id, nodes }) => [id, nodes.slice(0, 2).map((node) => node.html)]))"
        )
        if found:
            faults[tab] = found
    assert not faults, json.dumps(faults, indent=1)


def test_the_page_logged_no_errors(ball: Viewer) -> None:
    assert ball.complaints == []
