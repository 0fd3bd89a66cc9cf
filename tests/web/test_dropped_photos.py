"""What is dropped on the page is one capture of the service, bit for bit; it is shown before anything is built of it, and its upload outlives the connection.

    DRGS_SCREENSHOTS=FOLDER python -m pytest tests/web/test_dropped_photos.py

keeps pictures of what is shown in FOLDER; otherwise they lie in pytest's folder of temporary files.
"""

import base64
import io
import json
import os
import shutil
import sqlite3
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from playwright.sync_api import Locator, Route, expect

from tests.web.browser import ROOT
from tests.web.conftest import Viewer, wait_until
from tests.web.test_screenshots import FIND_FAULTS

SAMPLE = ROOT / "examples" / "sample_capture"
LAPTOP, PHONE = (1280, 720), (390, 844)
DROP = """(photographs) => {
  const files = new DataTransfer();
  for (const [name, base64] of photographs) {
    const bytes = Uint8Array.from(atob(base64), (letter) => letter.charCodeAt(0));
    files.items.add(new File([bytes], name, { type: 'image/jpeg' }));
  }
  for (const type of ['dragenter', 'dragover', 'drop'])
    document.body.dispatchEvent(new DragEvent(type, { dataTransfer: files, bubbles: true, cancelable: true }));
}"""
IS_LOADED = "(image) => image.complete && image.naturalWidth > 0"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    named = os.environ.get("DRGS_SCREENSHOTS")
    chosen = Path(named) if named else tmp_path_factory.mktemp("screenshots")
    chosen.mkdir(parents=True, exist_ok=True)
    return chosen


def jpeg(seed: int) -> bytes:
    file = io.BytesIO()
    Image.fromarray(np.random.default_rng(seed).integers(0, 255, (24, 32, 3), np.uint8)).save(file, "JPEG")
    return file.getvalue()


def captures(viewer: Viewer, name: str) -> list[dict]:
    return [capture for capture in viewer.server.ask("/api/captures")["captures"] if capture["name"] == name]


def drop_folder(viewer: Viewer, dropped: Path) -> None:
    """As the browser itself hands a folder over that is dropped from another program."""
    session = viewer.page.context.new_cdp_session(viewer.page)
    for kind in ("dragEnter", "dragOver", "drop"):
        data = {"items": [], "files": [str(dropped)], "dragOperationsMask": 1}
        session.send("Input.dispatchDragEvent", {"type": kind, "x": 400, "y": 200, "data": data})


def drawn_share(canvas: Locator) -> float:
    """Of the pixels of a canvas, those that are of another colour than most. A canvas of WebGL shows its pixels to nobody but the screen."""
    with Image.open(io.BytesIO(canvas.screenshot())) as picture:
        pixels = np.asarray(picture.convert("RGB"), int)
    return float((np.abs(pixels - np.median(pixels, axis=(0, 1))).max(-1) > 30).mean())


def look(viewer: Viewer, shown: Locator, folder: Path, name: str, size: tuple[int, int]) -> list[str]:
    viewer.page.set_viewport_size(dict(zip(("width", "height"), size, strict=True)))
    wait_until(lambda: drawn_share(shown.locator("canvas")) > 0.02, "a picture of the cameras")
    viewer.page.screenshot(path=folder / f"{name}.png")
    faults = [f"{name}: {fault}" for fault in viewer.page.evaluate(FIND_FAULTS)]
    shown.evaluate("(dialog) => dialog.scrollTo(0, dialog.scrollHeight)")
    viewer.page.screenshot(path=folder / f"{name}-end.png")
    expect(shown.get_by_role("heading")).to_be_in_viewport()
    expect(shown.get_by_role("button", name="Close")).to_be_in_viewport()
    shown.evaluate("(dialog) => dialog.scrollTo(0, 0)")
    return faults


def parameters_of(viewer: Viewer, name: str) -> dict:
    """What was asked of the one job of that name."""
    with sqlite3.connect(viewer.server.data / "app.sqlite") as database:
        ((parameters,),) = database.execute("SELECT parameters FROM jobs WHERE name = ?", (name,)).fetchall()
    return json.loads(parameters)


def numbers(shown: Locator, label: str) -> list[float]:
    return [float(shown.get_by_role("spinbutton", name=f"{label} {axis}").input_value()) for axis in "xyz"]


def drag(viewer: Viewer, grip: Locator, right: float, down: float) -> None:
    grip.hover()  # once it stands still, and if nothing lies over it
    place = grip.bounding_box()
    assert place is not None
    x, y = place["x"] + place["width"] / 2, place["y"] + place["height"] / 2
    viewer.page.mouse.down()
    viewer.page.mouse.move(x + right, y + down, steps=4)
    viewer.page.mouse.up()


def move_sides(viewer: Viewer, shown: Locator, folder: Path) -> tuple[list[float], list[float]]:
    """By mouse, by keys and by numbers, and back to the found ones; the box that is left."""
    low, high = numbers(shown, "Box from"), numbers(shown, "Box to")
    back, top = shown.get_by_role("button", name="As found"), shown.get_by_role("slider", name="Side +z of the box")
    expect(back).to_be_disabled()
    drag(viewer, top, 0, 25)
    wait_until(lambda: numbers(shown, "Box to")[2] < high[2] - 0.05, "a lower top")
    assert numbers(shown, "Box to")[:2] == high[:2] and numbers(shown, "Box from") == low
    lowered = numbers(shown, "Box to")[2]
    top.press("Shift+ArrowUp")
    wait_until(lambda: numbers(shown, "Box to")[2] > lowered + 0.05, "a higher top")
    viewer.page.screenshot(path=folder / "capture-box.png")
    back.click()
    wait_until(lambda: numbers(shown, "Box to") == high, "the box as it was found")
    shown.get_by_role("spinbutton", name="Box from z").fill("9")
    shown.get_by_role("spinbutton", name="Box from z").press("Enter")
    wait_until(lambda: high[2] - 0.1 < numbers(shown, "Box from")[2] < high[2], "a bottom just below the top")
    shown.get_by_role("spinbutton", name="Box from z").fill(str(round((low[2] + high[2]) / 2, 3)))
    shown.get_by_role("spinbutton", name="Box from z").press("Enter")
    expect(back).to_be_enabled()
    return numbers(shown, "Box from"), numbers(shown, "Box to")


def open_strokes(viewer: Viewer, shown: Locator, folder: Path) -> list[str]:
    """The brush on a telephone and on a laptop, and away again; faults of how it lies there."""
    summary, brush = shown.get_by_text("Mark the object by strokes"), shown.locator(".brush img")
    summary.click()
    faults = []
    for name, size in (("strokes-phone", PHONE), ("strokes-laptop", LAPTOP), ("strokes-phone", PHONE)):
        viewer.page.set_viewport_size(dict(zip(("width", "height"), size, strict=True)))
        wait_until(lambda: brush.evaluate(IS_LOADED), "the picture to draw on")
        shown.get_by_role("button", name="Undo stroke").scroll_into_view_if_needed()
        viewer.page.screenshot(path=folder / f"{name}.png")
        faults += [f"{name}: {fault}" for fault in viewer.page.evaluate(FIND_FAULTS)]
    summary.click()
    expect(brush).to_have_count(0)
    return faults


def turn_up(viewer: Viewer, shown: Locator) -> None:
    """By mouse and by keys, and back to what was proposed."""
    proposed = numbers(shown, "Direction")
    auto, arrow = shown.get_by_role("button", name="Auto"), shown.get_by_role("slider", name="Direction that points up")
    expect(auto).to_be_disabled()
    for turn in (lambda: drag(viewer, arrow, 60, 10), lambda: arrow.press("Shift+ArrowLeft")):
        turn()
        wait_until(lambda: np.linalg.norm(np.subtract(numbers(shown, "Direction"), proposed)) > 0.1, "another up")
        assert np.linalg.norm(numbers(shown, "Direction")) == pytest.approx(1, abs=2e-3)
        auto.click()
        wait_until(lambda: numbers(shown, "Direction") == proposed, "up as it was proposed")


def test_loose_pictures_are_one_capture(viewer: Viewer) -> None:
    pictures = {f"IMG_{number}.JPG": jpeg(number) for number in range(5)}
    viewer.page.evaluate(DROP, [[name, base64.b64encode(data).decode()] for name, data in pictures.items()])
    shown = viewer.page.get_by_role("dialog", name="photographs")
    expect(shown).to_be_visible()
    (made,) = wait_until(lambda: captures(viewer, "photographs"), "the capture")
    kept = viewer.server.data / "uploads" / made["id"]
    assert {path.name: path.read_bytes() for path in kept.iterdir()} == pictures
    # Five are too few: it says so, shows them all the same, and builds nothing.
    expect(shown.get_by_text("5 pictures, expected at least 8")).to_be_visible()
    expect(shown.get_by_role("button", name="Build")).to_be_disabled()
    sheet = shown.get_by_role("img", name="All pictures of photographs")
    wait_until(lambda: sheet.evaluate(IS_LOADED), "the sheet")
    shown.get_by_role("button", name="Close").click()
    viewer.page.get_by_role("button", name="Remove photographs").click()
    wait_until(lambda: captures(viewer, "photographs") == [] and not kept.exists(), "its removal")
    assert viewer.server.ask("/api/jobs")["jobs"] == []


@pytest.mark.slow
def test_a_dropped_folder_is_shown_with_its_cameras_and_its_pictures_before_a_build(viewer: Viewer, folder: Path, tmp_path: Path) -> None:
    mug = tmp_path / "Teal mug"
    shutil.copytree(SAMPLE, mug, ignore=shutil.ignore_patterns("test", "env", "*.py"))
    lost = 0

    def lose(route: Route) -> None:
        """Two parts in a row get nowhere, as in a tunnel."""
        nonlocal lost
        lost += route.request.method == "PATCH"
        if route.request.method == "PATCH" and lost <= 2:
            route.abort("connectionreset")
        else:
            route.continue_()

    viewer.page.route("**/api/uploads/**", lose)
    drop_folder(viewer, mug)
    expect(viewer.page.get_by_text("Teal mug.zip goes on by itself")).to_be_visible()
    shown = viewer.page.get_by_role("dialog", name="Teal mug")
    expect(shown).to_be_visible()
    assert lost > 2
    viewer.page.unroute("**/api/uploads/**")
    (made,) = captures(viewer, "Teal mug")
    kept = viewer.server.data / "uploads" / made["id"] / "Teal mug"
    sent, came = ({path.relative_to(top): path.read_bytes() for path in top.rglob("*") if path.is_file()} for top in (mug, kept))
    assert sent == came
    cameras = shown.get_by_role("img", name="56 cameras around the object")
    expect(cameras).to_have_attribute("data-cameras", "56")
    expect(shown.get_by_text("56 pictures of 256x256 with masks")).to_be_visible()
    sheet = shown.get_by_role("img", name="All pictures of Teal mug")
    wait_until(lambda: sheet.evaluate(IS_LOADED), "the sheet")
    faults = look(viewer, shown, folder, "capture-laptop", LAPTOP)
    before = cameras.screenshot()
    place = cameras.bounding_box()
    assert place is not None
    viewer.page.mouse.move(place["x"] + 100, place["y"] + 100)
    viewer.page.mouse.down()
    viewer.page.mouse.move(place["x"] + 200, place["y"] + 120, steps=4)
    viewer.page.mouse.up()
    wait_until(lambda: cameras.screenshot() != before, "another view of the cameras")
    tiles = shown.get_by_role("list", name="Pictures of Teal mug")
    expect(tiles).to_be_hidden()
    faults += look(viewer, shown, folder, "capture-phone", PHONE)
    faults += open_strokes(viewer, shown, folder)
    assert faults == []
    expect(sheet).to_be_hidden()
    expect(tiles.get_by_role("listitem")).to_have_count(56)
    first = tiles.get_by_role("listitem").first
    size = first.bounding_box()
    assert size is not None and 100 < size["width"] < 150, "three beside each other"
    first.scroll_into_view_if_needed()
    assert drawn_share(first) > 0.2
    viewer.page.set_viewport_size(dict(zip(("width", "height"), LAPTOP, strict=True)))
    low, high = move_sides(viewer, shown, folder)
    shown.get_by_role("radio", name="Draft").check()
    viewer.page.set_viewport_size({"width": 760, "height": 420})
    shown.get_by_role("button", name="Build").click()
    expect(shown).to_be_hidden()
    card = viewer.page.get_by_role("listitem", name="Build Teal mug")
    expect(card).to_be_visible()
    (job,) = viewer.server.ask("/api/jobs")["jobs"]
    assert (job["name"], job["preset"]) == ("Teal mug", "draft") and captures(viewer, "Teal mug")[0]["jobs"] == [job["id"]]
    box = parameters_of(viewer, "Teal mug")["box"]
    assert (box["low"], box["high"]) == (pytest.approx(low, abs=0.01), pytest.approx(high, abs=0.01)), "what was seen is what is built"
    card.get_by_role("button", name="Cancel").click()
    card.get_by_role("button", name="Remove").click()
    expect(card).to_have_count(0)
    viewer.page.get_by_role("button", name="Remove Teal mug").click()
    wait_until(lambda: captures(viewer, "Teal mug") == [] and not kept.exists(), "its removal")


@pytest.mark.slow
def test_a_capture_that_lies_on_its_side_is_shown_upright_and_built_so(viewer: Viewer, folder: Path, tmp_path: Path) -> None:
    vase = tmp_path / "Vase"
    (vase / "train").mkdir(parents=True)
    document = json.loads((SAMPLE / "transforms_train.json").read_text())
    document["frames"] = document["frames"][::4]
    y_up = np.array([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
    for frame in document["frames"]:
        frame["transform_matrix"] = (y_up @ np.array(frame["transform_matrix"])).tolist()
        shutil.copy(SAMPLE / f"{frame['file_path']}.png", vase / "train")
    (vase / "transforms_train.json").write_text(json.dumps(document))
    drop_folder(viewer, vase)
    shown = viewer.page.get_by_role("dialog", name="Vase")
    expect(shown.get_by_role("img", name="14 cameras around the object")).to_have_attribute("data-cameras", "14")
    expect(shown.get_by_role("radio", name="As held")).to_be_checked()
    expect(shown.get_by_text("far from how the camera was held")).to_be_visible()
    assert look(viewer, shown, folder, "capture-held", LAPTOP) == []
    turn_up(viewer, shown)
    shown.get_by_role("spinbutton", name="Direction x").fill("0.25")
    shown.get_by_role("spinbutton", name="Direction x").press("Enter")
    expect(shown).to_be_visible()
    viewer.page.set_viewport_size({"width": 760, "height": 420})
    shown.get_by_role("button", name="Build").click()
    expect(shown).to_be_hidden()
    card = viewer.page.get_by_role("listitem", name="Build Vase")
    card.get_by_role("button", name="Cancel").click()
    parameters = parameters_of(viewer, "Vase")
    x, y, z = parameters["up"]
    assert x == 0.25 and y > 0.9 and abs(z) < 0.3
    assert "box" not in parameters, "nobody moved it"
    card.get_by_role("button", name="Remove").click()
    viewer.page.get_by_role("button", name="Remove Vase").click()
