"""The viewer in a real browser on a real server: what the user does shows in pixels and in the server's state.

The tests run in this order on one page; each undoes its edits.
"""

import io
import math
import re
from pathlib import Path

import numpy as np
from PIL import Image
from playwright.sync_api import expect

from tests.patience import PATIENCE_SECONDS
from tests.web.browser import RunningServer
from tests.web.conftest import FEW_SAMPLES, Viewer, wait_until

TOO_SMALL_TO_SEE = 6.0
"""Euclidean difference of mean sRGB colours that noise between two pictures of the same thing stays below."""


DRAG = """async (slider, values) => {
  for (const value of values) {
    slider.value = value;
    slider.dispatchEvent(new Event('input', { bubbles: true }));
    await new Promise((resolve) => setTimeout(resolve, 50));
  }
  slider.dispatchEvent(new Event('change', { bubbles: true }));
}"""
"""What a pointer does to a range input."""


COUNT_DRAWN = """([samples, patience]) => {
  const stage = document.querySelector('.stage');
  const count = () => ({ traced: Number(stage.dataset.tracedFrames), local: Number(stage.dataset.localFrames) });
  window.drawnWhileRefined = new Promise((resolve, reject) => {
    setTimeout(() => reject(new Error(`not seen to get ${samples} samples: ${JSON.stringify(stage.dataset)}`)), patience);
    let moved = false, from = null;
    const look = new MutationObserver(() => {
      const { moving, fresh, samples: summed } = stage.dataset;
      moved ||= moving === 'true';
      if (moved && moving === 'false' && fresh === 'true') from ??= count();
      if (!from || Number(summed) < samples) return;
      look.disconnect();
      resolve({ traced: count().traced - from.traced, local: count().local - from.local });
    });
    look.observe(stage, { attributes: true });
  });
}"""
"""From the first traced picture after the next movement: pictures of both kinds until the traced one has all its samples, which is soon: a driver may
only hear of the last one."""


def difference(a: tuple[float, ...], b: tuple[float, ...]) -> float:
    return math.dist(a, b)


def test_the_token_leaves_the_address_bar_and_a_chosen_mesh_opens(viewer: Viewer, ball_file: Path) -> None:
    # Which of the two it says depends on what other modules' tests left in the library.
    expect(viewer.page.get_by_role("heading", name=re.compile("No asset is open|Open an asset from the library"))).to_be_visible()
    assert "token" not in viewer.page.url
    viewer.page.get_by_label("Capture or mesh").set_input_files(ball_file)
    expect(viewer.page.get_by_role("heading", name="ball", exact=True)).to_be_visible()
    color = viewer.settled_color()
    assert color[0] > 1.5 * color[2], "the ball's red side faces the first camera"
    assert "asset=" in viewer.page.url


def test_the_local_picture_agrees_with_the_traced_one(viewer: Viewer) -> None:
    traced = viewer.settled_color()
    box = viewer.page.evaluate(
        "(() => { const s = document.querySelector('.stage'); const a = 0.2 * s.clientHeight;"
        " return { x: (s.clientWidth - a) / 2, y: (s.clientHeight - a) / 2, width: a, height: a }; })()"
    )
    local = tuple(local_picture(viewer, box).mean((0, 1)))
    assert difference(local, traced) < 12, f"local {local}, traced {traced}"


def test_the_local_picture_agrees_under_another_tone_curve_and_before_a_blurred_sky(viewer: Viewer) -> None:
    standard = viewer.settled_color()
    viewer.open_tab("Light")
    viewer.page.get_by_role("radio", name="Sun and sky").check()
    viewer.wait_for_edits(1)
    viewer.page.get_by_role("radio", name="Blurred").check()
    viewer.page.get_by_label("Exposure, exact value").fill("0.5")
    viewer.page.get_by_label("Exposure, exact value").press("Enter")
    stage = viewer.page.evaluate(
        "(() => { const s = document.querySelector('.stage'); return { x: 0, y: 0, width: s.clientWidth, height: s.clientHeight }; })()"
    )
    seen = [standard]
    for curve in ("Filmic", "AgX", "Neutral"):
        viewer.page.get_by_role("radio", name=curve).check()
        seen.append(viewer.settled_color())
        assert min(difference(seen[-1], other) for other in seen[:-1]) > TOO_SMALL_TO_SEE, "each curve looks different"
        traced = screenshot(viewer, stage)
        apart = np.abs(local_picture(viewer, stage) - traced).mean((0, 1))
        assert apart.max() < 5, f"{curve}: object and background differ by {apart} of 255"
    viewer.page.get_by_role("radio", name="Standard").check()
    viewer.page.get_by_role("button", name="Reset exposure").click()
    viewer.page.get_by_role("radio", name="Light", exact=True).check()
    # A lower sun is another environment, which the server computes, and the same tile of the gallery.
    day = viewer.settled_color()
    viewer.page.get_by_label("Elevation, exact value").fill("3")
    viewer.page.get_by_label("Elevation, exact value").press("Enter")
    wait_until(lambda: viewer.edits()[-1]["file"] == "sun-and-sky-3.exr", "the edit in the server's log")
    expect(viewer.page.get_by_role("radio", name="Sun and sky")).to_be_checked()
    wait_until(lambda: sum(viewer.settled_color()) < 0.7 * sum(day), "an evening")
    viewer.page.get_by_role("button", name="As captured").click()
    viewer.wait_for_edits(0)
    wait_until(lambda: difference(viewer.settled_color(), standard) < TOO_SMALL_TO_SEE, "the first picture again")
    viewer.open_tab("Material")


def test_orbiting_changes_the_picture_and_reset_brings_it_back(viewer: Viewer) -> None:
    before = viewer.settled_color()
    choose_samples(viewer, 64)
    viewer.page.mouse.move(380, 150)
    viewer.page.mouse.down()
    viewer.page.evaluate(COUNT_DRAWN, [64, 1000 * PATIENCE_SECONDS])
    viewer.page.mouse.move(290, 150, steps=4)
    viewer.page.mouse.up()
    assert difference(viewer.settled_color(), before) > 5 * TOO_SMALL_TO_SEE
    drawn = viewer.page.evaluate("window.drawnWhileRefined")
    assert drawn["traced"] > 1 and drawn["local"] == 0, "the local picture, which nobody sees, is not drawn with each traced one"
    choose_samples(viewer, FEW_SAMPLES)
    viewer.page.keyboard.press("Shift+F")
    wait_until(lambda: difference(viewer.settled_color(), before) < TOO_SMALL_TO_SEE, "the first view")


def test_a_color_edit_reaches_pixels_and_log_and_undo_restores_both(viewer: Viewer) -> None:
    before = viewer.settled_color()
    field = viewer.page.get_by_label("Colour, sRGB hex")
    field.fill("#2050e0")
    field.press("Enter")
    (edit,) = viewer.wait_for_edits(1)
    assert edit["op"] == "material" and edit["select"]["all"]
    assert [round(value, 3) for value in edit["set"]["albedo"]] == [0.014, 0.08, 0.745]
    # The log is written before the picture is drawn: what is settled a moment later may still be the old one.
    wait_until(lambda: (color := viewer.settled_color())[2] > 1.5 * color[0], "a blue picture")
    viewer.page.get_by_role("button", name="Undo", exact=True).click()
    viewer.wait_for_edits(0)
    wait_until(lambda: difference(viewer.settled_color(), before) < TOO_SMALL_TO_SEE, "the first picture again")


def test_a_slider_drag_is_one_undo_step(viewer: Viewer) -> None:
    # Driven inside the page: on a busy machine a driver's own pauses would be longer than the half second that ends a step.
    viewer.page.get_by_label("Roughness", exact=True).evaluate(DRAG, [0.5, 0.4, 0.3, 0.2])
    viewer.wait_for_edits(1)
    wait_until(lambda: viewer.edits()[0]["set"]["roughness"] < 0.3, "the end of the drag")
    viewer.undo()
    assert viewer.wait_for_edits(0) == []
    viewer.redo()
    (again,) = viewer.wait_for_edits(1)
    assert again["set"]["roughness"] < 0.3
    expect(viewer.page.get_by_role("button", name="Redo", exact=True)).to_be_disabled()
    viewer.undo()
    viewer.wait_for_edits(0)


def test_light_is_chosen_from_the_gallery_and_turned_by_alt_drag(viewer: Viewer) -> None:
    before = viewer.settled_color()
    viewer.open_tab("Light")
    viewer.page.get_by_role("radio", name="Studio").check()
    (chosen,) = viewer.wait_for_edits(1)
    assert chosen["op"] == "environment" and chosen["file"].endswith(".exr")
    wait_until(lambda: difference(viewer.settled_color(), before) > TOO_SMALL_TO_SEE, "a picture in another light")
    viewer.page.keyboard.down("Alt")
    viewer.page.mouse.move(380, 150)
    viewer.page.mouse.down()
    viewer.page.mouse.move(480, 150, steps=3)
    viewer.page.mouse.up()
    viewer.page.keyboard.up("Alt")
    _, turned = viewer.wait_for_edits(2)
    wait_until(lambda: viewer.edits()[1]["rotation"] == 40.0, "a turn by 100 pixels, 0.4 degrees each")
    assert turned["file"] == chosen["file"]
    # The light that was captured is in the gallery like any other, and its turn stays.
    viewer.page.get_by_role("radio", name="Captured").check()
    (again,) = viewer.wait_for_edits(1)
    assert again.get("file") is None and again["rotation"] == 40.0
    viewer.page.get_by_role("button", name="As captured").click()
    viewer.wait_for_edits(0)
    viewer.open_tab("Material")


def test_channels_show_what_they_name(viewer: Viewer) -> None:
    viewer.page.keyboard.press("2")
    albedo = wait_until(lambda: (color := viewer.settled_color())[0] > 200 and color, "the albedo picture")
    # sRGB of the linear albedo (0.8, 0.1, 0.1)
    assert difference(albedo, (231, 89, 89)) < 12
    viewer.page.keyboard.press("1")
    wait_until(lambda: difference(viewer.settled_color(), albedo) > TOO_SMALL_TO_SEE, "the final picture")


def test_help_lists_the_shortcut_table(viewer: Viewer) -> None:
    viewer.page.keyboard.press("?")
    table = Path(__file__).resolve().parents[2].joinpath("web/src/ui/shortcuts.ts").read_text()
    texts = re.findall(r"text: '([^']+)'", table)
    assert len(texts) > 15
    for text in texts:
        expect(viewer.page.locator("dialog.help dd", has_text=text).first).to_be_visible()
    viewer.page.keyboard.press("Escape")
    expect(viewer.page.locator("dialog.help")).to_be_hidden()


def test_edits_and_the_number_of_samples_survive_a_reload_and_the_page_logged_no_errors(viewer: Viewer) -> None:
    number = viewer.page.get_by_label("Metallic, exact value")
    number.fill("1")
    number.press("Enter")
    wait_until(lambda: viewer.edits() and viewer.edits()[-1]["set"]["metallic"] == 1.0, "the edit in the server's log")
    choose_samples(viewer, 64)
    viewer.page.reload()
    expect(viewer.page.get_by_label("Metallic, exact value")).to_have_value("1.00")
    wait_until(lambda: viewer.stage().get("samples") == "64", "as many samples as were chosen")
    viewer.settled_color()
    assert viewer.complaints == []


def test_the_page_comes_back_after_a_server_restart_with_its_edits(viewer: Viewer, server: RunningServer) -> None:
    before = viewer.edits()  # one, or two where the machine was too slow to join typing and Enter into one step
    assert before
    server.stop()
    expect(viewer.page.locator(".hud")).to_contain_text("Reconnecting…")
    server.start()
    expect(viewer.page.locator(".hud")).not_to_contain_text("Reconnecting…")
    assert viewer.edits() == before
    viewer.settled_color()
    viewer.undo()
    viewer.wait_for_edits(len(before) - 1)


def choose_samples(viewer: Viewer, count: int) -> None:
    """A pixel."""
    viewer.open_tab("View")
    viewer.page.get_by_role("radio", name=str(count), exact=True).check()
    viewer.open_tab("Material")


def local_picture(viewer: Viewer, clip: dict) -> np.ndarray:
    """(height, width, 3) sRGB 0..255 of a part of what the page shows without the traced picture.

    A WebGL canvas may be read only within the frame in which it was drawn: a screenshot reads what is shown.
    """
    viewer.page.evaluate("document.querySelector('canvas.traced').style.visibility = 'hidden'")
    picture = screenshot(viewer, clip)
    viewer.page.evaluate("document.querySelector('canvas.traced').style.visibility = ''")
    return picture


def screenshot(viewer: Viewer, clip: dict) -> np.ndarray:
    """What has begun to fade in counts as faded in."""
    return np.asarray(Image.open(io.BytesIO(viewer.page.screenshot(clip=clip, animations="disabled"))).convert("RGB"), float)
