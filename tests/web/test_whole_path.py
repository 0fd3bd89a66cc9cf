"""The whole way of a newcomer: drop a capture, look at it, watch it built, change a part, the light and the shape, take all back, carry files away; then
drop plain photographs, whose poses are found first, say by strokes what of them is the object, and build what of that lies in a box.

A real worker process builds the sample's photographs, fewer and smaller ones, in `short_builder`'s few iterations. The tests run in this
order on one page; each looks at the pixels of the canvas and at what the server says.
"""

import base64
import io
import json
import os
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image
from playwright.sync_api import Browser, Download, Locator, expect
from scipy import ndimage

from tests.patience import PATIENCE_SECONDS
from tests.reconstruct.pose.textured_scene import orbit, write_photographs
from tests.web.browser import ROOT, RunningServer
from tests.web.conftest import Viewer, patient_page, wait_until
from tests.web.test_dropped_photos import drop_folder, numbers

CAPTURE = ROOT / "examples" / "sample_capture"
VIEW_STEP, SIDE = 2, 96
"""Every second view, at this many pixels a side: with half as many, the object's outline is lost."""
BUILD_SECONDS = 900
"""Some twenty on two idle cores; others may use them, too."""
EGG_VIEWS = 14
SAMPLES = 64
NOISE = 3.0
"""Mean over the object of the difference between two pictures of the same thing, sRGB 0..255, stays below this."""
DROP = """(base64) => {
  const bytes = Uint8Array.from(atob(base64), (letter) => letter.charCodeAt(0));
  const files = new DataTransfer();
  files.items.add(new File([bytes], 'Little sample.zip', { type: 'application/zip' }));
  for (const type of ['dragenter', 'dragover', 'drop'])
    document.body.dispatchEvent(new DragEvent(type, { dataTransfer: files, bubbles: true, cancelable: true }));
}"""
DRAG_SLIDER = """(slider, values) => {
  for (const value of values) {
    slider.value = value;
    slider.dispatchEvent(new Event('input', { bubbles: true }));
  }
  slider.dispatchEvent(new Event('change', { bubbles: true }));
}"""
READ_CANVAS = "document.querySelector('canvas.traced').toDataURL('image/png')"


def small_capture() -> bytes:
    """The sample capture with fewer and smaller photographs, zipped."""
    transforms = json.loads((CAPTURE / "transforms_train.json").read_text())
    transforms["frames"] = transforms["frames"][::VIEW_STEP]
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        archive.writestr("transforms_train.json", json.dumps(transforms))
        for frame in transforms["frames"]:
            name = frame["file_path"].removeprefix("./") + ".png"
            photo = io.BytesIO()
            with Image.open(CAPTURE / name) as full:
                full.resize((SIDE, SIDE), Image.Resampling.BOX).save(photo, "PNG")
            archive.writestr(name, photo.getvalue())
    return packed.getvalue()


@pytest.fixture(scope="module")
def worker(server: RunningServer) -> Iterator[None]:
    """A worker process on the server's data directory."""
    environment = os.environ | {"DRGS_BUILDER": "tests.web.short_builder:build"}
    running = subprocess.Popen([sys.executable, "-m", "drgs_worker", "--data", str(server.data)], env=environment, cwd=ROOT)
    yield
    running.terminate()
    try:
        running.wait(PATIENCE_SECONDS)
    except subprocess.TimeoutExpired:
        running.kill()


@pytest.fixture(scope="module")
def path(server: RunningServer, browser: Browser, worker: None) -> Iterator[Viewer]:
    """A page in which nobody has been before."""
    page = patient_page(browser, viewport={"width": 1000, "height": 620}, device_scale_factor=0.5, color_scheme="dark")
    shown = Viewer(page, server)
    page.on("pageerror", lambda error: shown.complaints.append(str(error)))
    page.on("console", lambda message: shown.complaints.append(message.text) if message.type == "error" else None)
    page.goto(f"{server.address}/#token={server.token}")
    yield shown
    page.close()


@pytest.fixture(scope="module")
def first(path: Viewer) -> np.ndarray:
    """The object before any edit; the tests before the first user of it have opened it and chosen how it is shown."""
    return refined_picture(path)


def refined_picture(viewer: Viewer) -> np.ndarray:
    """(height, width, 4) float sRGB and alpha 0..255 of the traced picture with all its samples, of the newest edits."""

    def is_refined() -> bool:
        viewer.settle()
        return int(viewer.stage()["samples"]) >= SAMPLES

    wait_until(is_refined, lambda: f"all samples; the page says {viewer.stage()}", PATIENCE_SECONDS)
    data = viewer.page.evaluate(READ_CANVAS)
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(data.partition(",")[2]))).convert("RGBA"), float)


def wait_for_picture(viewer: Viewer, holds: Callable[[np.ndarray], bool], what: str) -> np.ndarray:
    """The first refined picture of which `holds` is true. The log is written before the picture is drawn."""

    last: list[np.ndarray] = []

    def picture() -> list[np.ndarray]:
        last[:] = [refined_picture(viewer)]
        return last if holds(last[0]) else []

    def said() -> str:
        with tempfile.NamedTemporaryFile(suffix=".png", delete=False) as shown:
            Image.fromarray(last[0].astype(np.uint8)).save(shown, "PNG")
        return f"{what}; the page shows {shown.name} and says {viewer.stage()}, the log is {viewer.edits()}"

    return wait_until(picture, said, PATIENCE_SECONDS)[0]


def silhouette(picture: np.ndarray) -> np.ndarray:
    return picture[..., 3] > 127


def change(before: np.ndarray, after: np.ndarray, where: np.ndarray) -> float:
    """Mean difference of colour, 0..255, over some pixels."""
    return float(np.abs(after - before)[where][:, :3].mean())


def overlap(a: np.ndarray, b: np.ndarray) -> float:
    """Intersection over union of two silhouettes."""
    return float((silhouette(a) & silhouette(b)).sum() / (silhouette(a) | silhouette(b)).sum())


def brightness(picture: np.ndarray) -> np.ndarray:
    return picture[..., :3].mean(-1)


def is_under_way(viewer: Viewer, kind: str) -> bool:
    """Whether the newest job of this kind is not at its end.

    Raises:
        AssertionError: it failed; why.
    """
    newest = next(job for job in viewer.server.ask("/api/jobs")["jobs"] if job["kind"] == kind)
    assert newest["state"] != "failed", newest["error"]
    return newest["state"] in ("queued", "running")


def jobs_of(viewer: Viewer) -> list[dict]:
    return [job for job in viewer.server.ask("/api/jobs")["jobs"] if job["name"] == "Little sample"]


def test_a_dropped_capture_is_shown_and_becomes_a_job_whose_progress_is_shown(path: Viewer) -> None:
    path.page.evaluate(DROP, base64.b64encode(small_capture()).decode())
    shown = path.page.get_by_role("dialog", name="Little sample")
    expect(shown.get_by_role("img", name="cameras around the object")).to_have_attribute("data-cameras", "28")
    expect(shown.get_by_text("28 pictures of 96x96 with masks")).to_be_visible()
    assert jobs_of(path) == [], "nothing is built before somebody says so"
    shown.get_by_role("radio", name="Draft").check()
    shown.get_by_role("button", name="Build").click()
    expect(shown).to_be_hidden()
    listed = path.page.get_by_role("listitem", name="Build Little sample")
    expect(listed).to_be_visible()
    (job,) = wait_until(lambda: jobs_of(path), "a job on the server", 60)
    assert (job["kind"], job["preset"]) == ("build", "draft")
    bar = listed.get_by_role("progressbar", name="Progress of Little sample")
    wait_until(lambda: bar.count() and int(bar.get_attribute("aria-valuenow") or 0) > 0, "progress on the page", BUILD_SECONDS)
    (running,) = jobs_of(path)
    assert running["state"] in ("running", "done") and running["fraction"] > 0


def test_the_finished_asset_opens_by_itself(path: Viewer) -> None:
    expect(path.page.get_by_role("heading", name="Little sample", exact=True)).to_be_visible(timeout=BUILD_SECONDS * 1000)
    (job,) = jobs_of(path)
    assert job["state"] == "done" and job["asset_id"] in path.page.url
    asset = path.server.ask(f"/api/assets/{job['asset_id']}")
    assert asset["source"] == "build" and asset["surfel_count"] > 1000 and asset["face_count"] > 1000
    log = path.session()
    assert (log["edits"], log["can_undo"]) == ([], False)
    # From here on every picture is of the object alone.
    path.page.get_by_role("button", name="Library").click()
    path.open_tab("View")
    path.page.get_by_role("radio", name=str(SAMPLES), exact=True).check()
    path.open_tab("Light")
    path.page.get_by_role("radio", name="None", exact=True).check()
    path.page.keyboard.press("Escape")
    path.page.keyboard.press("Shift+F")
    picture = wait_for_picture(path, lambda now: now[0, 0, 3] == 0 and silhouette(now).any(), "the object on nothing")
    inside = picture[silhouette(picture)]
    assert 0.03 < silhouette(picture).mean() < 0.7, "the object fills part of the picture"
    assert inside[:, :3].std() > 10 and inside[:, :3].mean() > 20, "it is lit, and not one flat colour"
    red, _, blue = inside[:, :3].T
    assert (blue > 1.3 * red).mean() > 0.1, "some of it is of the photographs' blue glaze"


def test_a_part_picked_by_a_click_alone_turns_to_gold(path: Viewer, first: np.ndarray) -> None:
    captured_metal = metallic_picture(path)
    x, y = middle_of_the_blue(first)
    path.open_tab("Material")
    # Not a region: where those end depends on how well the few iterations told materials apart.
    path.page.get_by_role("radio", name="Sphere", exact=True).check()
    click_pixel(path, first, x, y)
    expect(path.hint("% of the object is selected")).to_be_visible()
    path.page.get_by_role("button", name="Gold", exact=True).click()
    (edit,) = path.wait_for_edits(1)
    assert edit["op"] == "material" and edit["select"]["sphere"]["radius"] > 0 and edit["set"]["metallic"] == 1
    assert path.session()["can_undo"]
    part = (metallic_picture(path) - captured_metal)[..., 0] > 100
    rest = silhouette(first) & ~ndimage.binary_dilation(part, iterations=10)
    assert part[y, x] and part.sum() > 100, "the clicked part is of metal now"
    assert rest.sum() > 500, "and not the whole object"
    asked = f"another colour than {first[part].mean(0)} on {part.sum()} pixels around {x}, {y}"
    gold = wait_for_picture(path, lambda now: change(first, now, part) > 20, asked)
    red, green, blue = gold[part][:, :3].mean(0)
    assert red > green > 1.2 * blue, f"gold is yellow, not {red:.0f}, {green:.0f}, {blue:.0f}"
    assert change(first, gold, rest) < 0.25 * change(first, gold, part), "but for light from the gold, the rest stays"


def test_another_light_shines_and_turns_with_alt_drag(path: Viewer, first: np.ndarray) -> None:
    inside = silhouette(first)
    before = refined_picture(path)
    path.open_tab("Light")
    path.page.get_by_role("radio", name="Studio", exact=True).check()
    _, chosen = path.wait_for_edits(2)
    assert (chosen["op"], chosen["file"], chosen["rotation"]) == ("environment", "studio.exr", 0)
    studio = wait_for_picture(path, lambda now: change(before, now, inside) > 2 * NOISE, "the object in the studio")
    path.page.keyboard.down("Alt")
    path.page.mouse.move(200, 120)
    path.page.mouse.down()
    path.page.mouse.move(500, 120, steps=5)
    path.page.mouse.up()
    path.page.keyboard.up("Alt")
    wait_until(lambda: [edit.get("rotation") for edit in path.edits()] == [None, 0, 120], "a turn by 300 pixels, 0.4 degrees each")
    assert path.edits()[2]["file"] == "studio.exr"
    turned = wait_for_picture(path, lambda now: change(studio, now, inside) > 2 * NOISE, "the object in the turned studio")
    assert overlap(turned, studio) > 0.99, "the light turns, not the object"
    gained = (brightness(turned) - brightness(studio))[inside]
    assert min((gained > 10).mean(), (gained < -10).mean()) > 0.05, "bright places are elsewhere: some darken, others light up"


def test_a_slider_twists_the_object(path: Viewer) -> None:
    before = refined_picture(path)
    path.open_tab("Shape")
    path.page.get_by_label("Twist", exact=True).evaluate(DRAG_SLIDER, [40, 80, 120])
    *_, twist = path.wait_for_edits(4)
    assert twist["op"] == "deform" and twist["map"]["type"] == "twist"
    height = np.ptp(stored_mesh(path).vertices[:, 1])  # glTF's y is up
    wait_until(lambda: abs(path.edits()[3]["map"]["rate"] * height - np.radians(120)) < np.radians(2), "the slider's last value")
    wait_for_picture(path, lambda now: overlap(now, before) < 0.95, "another outline")


def test_undoing_all_brings_the_first_picture_back(path: Viewer, first: np.ndarray) -> None:
    undo = path.page.get_by_role("button", name="Undo", exact=True)
    for left in (3, 2, 1, 0):
        expect(undo).to_be_enabled()
        undo.click()
        path.wait_for_edits(left)
    expect(undo).to_be_disabled()
    log = path.session()
    assert (log["edits"], log["can_undo"], log["can_redo"]) == ([], False, True)
    again = wait_for_picture(path, lambda now: change(first, now, silhouette(first)) < NOISE, "the first picture")
    assert overlap(again, first) > 0.99


def test_the_object_is_exported_as_a_textured_mesh(path: Viewer) -> None:
    path.open_tab("Export")
    download = downloaded(path, path.page.get_by_role("link", name="Mesh (GLB)"))
    assert download.suggested_filename.endswith(".glb")
    scene = trimesh.load_scene(download.path(), file_type="glb")
    (mesh,) = scene.geometry.values()
    stored = stored_mesh(path)
    assert len(mesh.faces) == len(stored.faces)
    assert np.allclose(scene.bounds, stored.bounds, atol=1e-3 * np.ptp(stored.bounds))
    material = mesh.visual.material
    color = np.asarray(material.baseColorTexture.convert("RGB"), float)
    assert min(color.shape[:2]) >= 256 and color.std() > 10, "a texture with something on it"
    assert material.metallicRoughnessTexture.size == material.baseColorTexture.size


def test_the_picture_is_exported_as_a_png(path: Viewer, first: np.ndarray) -> None:
    path.page.get_by_role("radio", name="Window", exact=True).check()
    path.page.get_by_role("radio", name="32", exact=True).check()
    path.page.get_by_role("switch", name="Transparent background").check()
    download = downloaded(path, path.page.get_by_role("button", name="Render PNG"))
    assert download.suggested_filename == "Little sample.png"
    picture = Image.open(download.path())
    assert (picture.format, picture.mode, picture.size) == ("PNG", "RGBA", (first.shape[1], first.shape[0]))
    pixels = np.asarray(picture, float)
    assert overlap(pixels, first) > 0.98, "what is saved is what is on the canvas"
    assert change(first, pixels, silhouette(first) & silhouette(pixels)) < 3 * NOISE, "in the same colours; it has fewer samples"
    assert path.edits() == [], "saving is no edit"


def test_a_folder_of_plain_photographs_is_posed_seen_stroked_cut_and_built(path: Viewer, tmp_path: Path) -> None:
    pytest.importorskip("pycolmap")
    drop_folder(path, write_photographs(tmp_path / "Egg", orbit(EGG_VIEWS), masks=True))
    plain = path.page.get_by_role("dialog", name="Egg", exact=True)
    expect(plain.get_by_text("is not known yet")).to_be_visible()
    find, bar = plain.get_by_role("button", name="Find poses"), plain.get_by_role("progressbar", name="Search for the poses of Egg")
    find.click()
    expect(bar).to_be_visible()
    expect(plain.get_by_role("button", name="Build")).to_be_disabled()
    path.page.screenshot(path=tmp_path / "poses-searched.png")
    plain.get_by_role("button", name="Cancel").click()
    find.click()
    expect(bar).to_be_visible()
    posed = path.page.get_by_role("dialog", name="Egg, posed")
    wait_until(lambda: posed.is_visible() or not is_under_way(path, "pose"), "the poses", BUILD_SECONDS)
    expect(posed).to_be_visible()
    expect(posed.get_by_role("img", name=f"{EGG_VIEWS} cameras around the object")).to_have_attribute("data-cameras", str(EGG_VIEWS))
    expect(posed.get_by_text(f"{EGG_VIEWS} of {EGG_VIEWS} pictures found their place")).to_be_visible()
    searches = [job["state"] for job in path.server.ask("/api/jobs")["jobs"] if job["kind"] == "pose"]
    assert searches == ["done", "cancelled"]
    stroke_the_egg(path, posed, tmp_path)
    low, high = numbers(posed, "Box from"), numbers(posed, "Box to")
    cut = low[2] + (high[2] - low[2]) / 4
    posed.get_by_role("spinbutton", name="Box from z").fill(f"{cut:.3f}")
    posed.get_by_role("spinbutton", name="Box from z").press("Enter")
    expect(posed.get_by_text("What lies outside is not built")).to_be_visible()
    path.page.screenshot(path=tmp_path / "poses-found.png")
    posed.get_by_role("radio", name="Draft").check()
    posed.get_by_role("button", name="Build").click()
    expect(posed).to_be_hidden()
    expect(path.page.get_by_role("heading", name="Egg, posed", exact=True)).to_be_visible(timeout=BUILD_SECONDS * 1000)
    path.settle()
    path.page.screenshot(path=tmp_path / "egg.png")
    asset = json.loads((path.server.data / "assets" / path.session()["asset"] / "asset.json").read_text())
    strokes = asset["provenance"]["strokes"]
    assert [stroke["shows"] for stroke in strokes] == ["object", "background"] * 2 and len({stroke["picture"] for stroke in strokes}) == 2
    heights = stored_mesh(path).vertices[:, 1]  # glTF's y is up
    assert heights.min() == pytest.approx(cut, abs=0.02) and heights.min() >= round(cut, 3) - 1e-4, "its bottom is cut off"
    assert heights.max() == pytest.approx(high[2], abs=0.1 * (high[2] - low[2]))


def stroke_the_egg(viewer: Viewer, shown: Locator, folder: Path) -> None:
    """By mouse in one picture and by keys in another; the sheet then shows the masks that they give."""
    shown.get_by_text("Mark the object by strokes").click()
    said, sheet = shown.locator(".strokes [role=status]"), shown.get_by_role("img", name="the masks that the strokes give")
    expect(said).to_have_text("Draw over the object, and over what is around it.")
    brush, picture = shown.locator(".brush canvas"), shown.get_by_label("Picture", exact=True)
    wait_until(lambda: shown.locator(".brush img").evaluate("(image) => image.complete && image.naturalWidth > 0"), "the picture")
    paint(viewer, brush, [(0.42, 0.42), (0.58, 0.58)])
    expect(said).to_have_text("Draw over what is not the object, too.")
    shown.get_by_role("radio", name="Not object").check()
    paint(viewer, brush, [(0.5, 0.5), (0.6, 0.6)])
    brush.press("Control+z")
    expect(brush).to_have_attribute("data-strokes", "1")
    paint(viewer, brush, [(0.03, 0.97), (0.03, 0.03), (0.97, 0.03)])
    expect(said).to_contain_text("The sheet below shows the masks", timeout=BUILD_SECONDS * 1000)
    first = sheet.get_attribute("src")
    picture.select_option("4")
    brush.press("x")
    expect(shown.get_by_role("radio", name="Object", exact=True)).to_be_checked()
    for key in ("ArrowLeft", "Space", "Shift+ArrowRight", "Shift+ArrowRight", "Space", "x"):
        brush.press(key)
    expect(brush).to_have_attribute("data-strokes", "1")
    for key in (*["Shift+ArrowUp"] * 9, "Space", *["Shift+ArrowLeft"] * 6, "Space"):
        brush.press(key)
    expect(brush).to_have_attribute("data-strokes", "2")
    wait_until(lambda: sheet.get_attribute("src") != first, "a sheet of the new strokes", BUILD_SECONDS)
    viewer.page.screenshot(path=folder / "strokes.png")
    wait_until(lambda: sheet.evaluate("(image) => image.complete && image.naturalWidth > 0"), "the sheet")
    sheet.scroll_into_view_if_needed()
    viewer.page.screenshot(path=folder / "strokes-masks.png")


def paint(viewer: Viewer, brush: Locator, way: list[tuple[float, float]]) -> None:
    """A stroke by mouse through places, as shares of the picture."""
    brush.scroll_into_view_if_needed()
    place = brush.bounding_box()
    assert place is not None
    for number, (x, y) in enumerate(way):
        viewer.page.mouse.move(place["x"] + x * place["width"], place["y"] + y * place["height"], steps=4)
        if number == 0:
            viewer.page.mouse.down()
    viewer.page.mouse.up()


def test_the_page_logged_no_errors(path: Viewer) -> None:
    assert path.complaints == []


def metallic_picture(viewer: Viewer) -> np.ndarray:
    """The metallic channel, 0..255; the final picture is asked for again."""
    viewer.page.keyboard.press("Escape")
    viewer.page.keyboard.press("4")
    picture = viewer.settled_picture()
    viewer.page.keyboard.press("1")
    return picture


def middle_of_the_blue(picture: np.ndarray) -> tuple[int, int]:
    """(x, y) of the pixel that is farthest from the edge of what is blue."""
    red, green, blue = np.moveaxis(picture[..., :3], -1, 0)
    depth = ndimage.distance_transform_edt(silhouette(picture) & (blue > 1.3 * red) & (blue > 0.8 * green))
    y, x = np.unravel_index(depth.argmax(), depth.shape)
    return int(x), int(y)


def click_pixel(viewer: Viewer, picture: np.ndarray, x: int, y: int) -> None:
    scale = viewer.page.evaluate("document.querySelector('.stage').clientWidth") / picture.shape[1]
    viewer.page.mouse.click((x + 0.5) * scale, (y + 0.5) * scale)


def stored_mesh(viewer: Viewer) -> trimesh.Trimesh:
    """The open asset's mesh as the server keeps it, in glTF's frame."""
    path = viewer.server.data / "assets" / viewer.session()["asset"] / "mesh.glb"
    return trimesh.load_mesh(path, process=False)


def downloaded(viewer: Viewer, what: Locator) -> Download:
    with viewer.page.expect_download(timeout=PATIENCE_SECONDS * 1000) as download:
        what.click()
    return download.value
