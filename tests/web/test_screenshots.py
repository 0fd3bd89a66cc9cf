"""Pictures of every panel, dark and light, at the sizes of screens that people have, to be looked at; and what can be checked in them without eyes.

    DRGS_SCREENSHOTS=FOLDER python -m pytest tests/web/test_screenshots.py

keeps the pictures in FOLDER; otherwise they lie in pytest's folder of temporary files.
"""

import io
import os
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

import pytest
from PIL import Image
from playwright.sync_api import Browser, Route, expect

from drgs_server.api.rest_records import JobFile, JobFileList, JobInfo, JobList
from tests.web.browser import ROOT, RunningServer
from tests.web.conftest import Viewer, patient_page

TABS = ("Material", "Light", "Shape", "View", "Export")
LAPTOP, TABLET, LARGE = (1280, 720), (1024, 768), (3840, 2160)
EDITS: list[dict] = [
    {
        "op": "material",
        "select": {"all": True},
        "set": {"albedo": [1.0, 0.77, 0.34], "metallic": 1.0, "roughness": 0.2},
        "mode": "absolute",
    },
    {"op": "environment", "file": "studio.exr", "rotation": 40.0, "intensity": 1.0},
    {"op": "deform", "map": {"type": "twist", "rate": 0.8}},
]
PHOTO = ROOT / "examples" / "sample_capture" / "train" / "r_000.png"
NOW = datetime(2026, 1, 1, tzinfo=UTC)
FIND_FAULTS = """() => {
  const faults = [];
  const name = (element) => `${element.tagName.toLowerCase()} "${(element.getAttribute('aria-label') ?? element.innerText ?? element.value ?? '').trim().slice(0, 40)}"`;
  const hidden = (element) => !element.checkVisibility({ checkOpacity: false, checkVisibilityCSS: true }) || element.closest('.visually-hidden') !== null;
  const page = document.scrollingElement;
  if (page.scrollWidth > page.clientWidth || page.scrollHeight > page.clientHeight) faults.push('the page itself scrolls');
  const panels = [...document.querySelectorAll('.panel, .topbar, .hud, .notices, dialog[open]')].filter((panel) => !hidden(panel));
  for (const panel of panels) {
    const { left, top, right, bottom } = panel.getBoundingClientRect();
    if (left < -1 || top < -1 || right > innerWidth + 1 || bottom > innerHeight + 1) faults.push(`${panel.className} is cut off by the window`);
  }
  // Panels that lie side by side must not cover one another.
  const sides = panels.filter((panel) => panel.matches('.panel')).map((panel) => panel.getBoundingClientRect());
  if (sides.length === 2 && sides[0].right > sides[1].left && sides[1].right > sides[0].left) faults.push('the two panels overlap');
  for (const element of document.querySelectorAll('.panel, .panel *, dialog[open], dialog[open] *')) {
    if (hidden(element)) continue;
    const { overflowX } = getComputedStyle(element);
    if ((overflowX === 'auto' || overflowX === 'scroll') && element.scrollWidth > element.clientWidth + 1) faults.push(`${name(element)} scrolls sideways`);
  }
  for (const element of document.querySelectorAll('.panel :is(button, a, input, select, textarea, summary), dialog[open] :is(button, a), .topbar button')) {
    if (hidden(element)) continue;
    element.scrollIntoView({ block: 'nearest' });
    const { left, top, right, bottom, width, height } = element.getBoundingClientRect();
    if (!width || !height) continue; // a radio button that its tile or its label stands for
    const frame = (element.closest('.panel, dialog, .topbar')).getBoundingClientRect();
    if (left < frame.left - 1 || right > frame.right + 1 || top < frame.top - 1 || bottom > frame.bottom + 1) faults.push(`${name(element)} does not come into sight`);
  }
  // Words that are longer than their box. Those that end in an ellipsis say all of it in a tool-tip.
  for (const element of document.querySelectorAll('.panel *, .topbar *, dialog[open] *')) {
    const words = [...element.childNodes].some((node) => node.nodeType === Node.TEXT_NODE && node.data.trim());
    if (!words || hidden(element)) continue;
    const { textOverflow, display } = getComputedStyle(element);
    if (display === 'inline') continue;
    const wider = element.scrollWidth > element.clientWidth + 1;
    if (wider && textOverflow !== 'ellipsis') faults.push(`${name(element)} is wider than its box by ${element.scrollWidth - element.clientWidth}`);
    if (wider && textOverflow === 'ellipsis' && !element.closest('[title]') && !element.matches('h1, .asset-text *')) faults.push(`${name(element)} is shortened, and no tool-tip says the rest`);
    const inside = document.createRange();
    inside.selectNodeContents(element);
    const box = element.closest('button, .choice-row label, .tag')?.getBoundingClientRect();
    const text = inside.getBoundingClientRect();
    if (box && textOverflow !== 'ellipsis' && (text.left < box.left - 1 || text.right > box.right + 1)) faults.push(`${name(element)} sticks out of its button`);
  }
  for (const input of document.querySelectorAll('.panel input[type=number], .panel input[type=text]')) {
    if (!hidden(input) && input.scrollWidth > input.clientWidth + 1) faults.push(`${name(input)} shows only part of ${input.value}`);
  }
  for (const scrolled of document.querySelectorAll('.panel, .panel *')) scrolled.scrollTop = 0;
  return [...new Set(faults)];
}"""
SCROLL_DOWN = """() => {
  let any = false;
  for (const panel of document.querySelectorAll('.library, .tab-page, dialog[open]')) {
    if (panel.scrollHeight <= panel.clientHeight + 4) continue;
    any = true;
    panel.scrollTop = panel.scrollHeight;
  }
  return any;
}"""
PICTURES_ARE_THERE = """() => [...document.querySelectorAll('.panel img')].every((image) => {
  const { top, bottom } = image.getBoundingClientRect();
  return image.complete || bottom < 0 || top > innerHeight;
})"""


def job(name: str, **said: object) -> JobInfo:
    """A finished build, but for what is said."""
    done = dict.fromkeys(JobInfo.model_fields) | {
        "id": name.replace(" ", "-"),
        "name": name,
        "kind": "build",
        "preset": "fast",
        "state": "done",
    }
    done |= {"priority": 100, "created_at": NOW, "stage": "", "message": "", "attempts": 1, "iteration": 0, "iterations": 0}
    done |= {"fraction": 1.0, "preview_version": 0}
    return JobInfo(**(done | said))


def jobs_at(moment: int) -> JobList:
    """One of each sort, and a build that has come a little further each time somebody asks."""
    quality = 31.5 - 14 / (1 + moment)
    running = job("A jug with a long name that says where it was photographed", state="running", finished_at=None, stage="fit")
    further = {
        "iteration": min(1260, 70 * moment),
        "iterations": 1400,
        "fraction": min(0.9, 0.05 * moment),
        "psnr": quality,
        "eta_seconds": 214.0,
    }
    listed = [
        running.model_copy(update=further | {"message": "14 203 surfels", "preview_version": moment}),
        job("Cup", state="queued", finished_at=None, fraction=0.0),
        job("Ball, turntable", kind="render", preset=""),
        job(
            "Vase",
            state="failed",
            error="transforms_train.json: frame train/r_012 names a picture that is not there; expected train/r_012.png",
        ),
        job("Sample", asset_id="gone"),
    ]
    return JobList(jobs=listed, total=len(listed), workers_alive=1)


def play_jobs(viewer: Viewer) -> None:
    """Jobs in every state, without a worker: the page hears of these."""
    asked = 0
    photo = io.BytesIO()
    Image.open(PHOTO).convert("RGB").save(photo, "JPEG")
    film = JobFileList(files=[JobFile(name="edited-environment.mp4", bytes=1 << 20, media_type="video/mp4")])

    def answer(route: Route) -> None:
        nonlocal asked
        address = route.request.url
        if "preview.jpg" in address:
            route.fulfill(content_type="image/jpeg", body=photo.getvalue())
        elif "/files" in address:
            route.fulfill(content_type="application/json", body=film.model_dump_json())
        else:
            asked += 1
            route.fulfill(content_type="application/json", body=jobs_at(asked).model_dump_json())

    viewer.page.route("**/api/jobs**", answer)
    viewer.page.route("**/api/jobs/**", answer)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    named = os.environ.get("DRGS_SCREENSHOTS")
    chosen = Path(named) if named else tmp_path_factory.mktemp("screenshots")
    chosen.mkdir(parents=True, exist_ok=True)
    return chosen


@pytest.fixture(scope="module")
def shown(server: RunningServer, browser: Browser, ball_asset: str) -> Iterator[Viewer]:
    """A ball with three edits open in a page."""
    # These pictures are of panels: what is behind them is drawn small until the edits are there, coarse afterwards, and by the server only.
    page = patient_page(browser, viewport={"width": 760, "height": 420}, color_scheme="dark")
    page.add_init_script("localStorage.setItem('drgs.localPicture', 'false')")
    viewer = Viewer(page, server)
    play_jobs(viewer)
    page.goto(f"{server.address}/#token={server.token}&asset={ball_asset}")
    expect(page.get_by_role("heading", name="ball", exact=True)).to_be_visible()
    for edit in EDITS:
        viewer.append_edit(edit)
    expect(page.get_by_role("list", name="Edits in force").get_by_role("button")).to_have_count(1 + len(EDITS))
    viewer.open_tab("View")
    page.get_by_role("radio", name="Low", exact=True).check()
    page.set_viewport_size(dict(zip(("width", "height"), LAPTOP, strict=True)))
    yield viewer
    page.close()


def look(viewer: Viewer, folder: Path, name: str) -> list[str]:
    """Keep a picture, a second one of what a panel has further down, and say what is wrong with what is shown."""
    viewer.page.mouse.move(5, viewer.page.viewport_size["height"] - 5)
    viewer.page.wait_for_function(PICTURES_ARE_THERE)
    viewer.page.screenshot(path=folder / f"{name}.png")
    if viewer.page.evaluate(SCROLL_DOWN):
        viewer.page.screenshot(path=folder / f"{name}-end.png")
    return [f"{name}: {fault}" for fault in viewer.page.evaluate(FIND_FAULTS)]


@pytest.mark.parametrize("theme", ["dark", "light"])
def test_every_panel_fits_a_laptop(shown: Viewer, folder: Path, theme: str) -> None:
    page = shown.page
    if page.evaluate("document.documentElement.dataset.theme") != theme:
        page.keyboard.press("Escape")
        page.keyboard.press("t")
    shown.close_library()
    faults = []
    for tab in TABS:
        shown.open_tab(tab)
        shown.settle()
        faults += look(shown, folder, f"{theme}-{tab.lower()}")
    page.get_by_role("button", name="Library").click()
    expect(page.get_by_alt_text("Preview of A jug")).to_be_visible()
    expect(page.get_by_role("img", name="Quality from")).to_be_visible()
    faults += look(shown, folder, f"{theme}-library")
    shown.close_library()
    page.keyboard.press("Escape")
    page.keyboard.press("?")
    expect(page.get_by_role("dialog", name="Keys and gestures")).to_be_visible()
    faults += look(shown, folder, f"{theme}-help")
    page.keyboard.press("Escape")
    assert faults == []


@pytest.mark.parametrize(("screen", "size"), [("tablet", TABLET), ("large", LARGE)])
def test_every_panel_fits_a_tablet_and_a_large_screen(shown: Viewer, folder: Path, screen: str, size: tuple[int, int]) -> None:
    page = shown.page
    page.set_viewport_size(dict(zip(("width", "height"), size, strict=True)))
    shown.close_library()
    page.get_by_role("button", name="Library").click()
    faults = []
    for tab in TABS:
        shown.open_tab(tab)
        faults += [f"{screen}, {tab}: {fault}" for fault in page.evaluate(FIND_FAULTS)]
    shown.open_tab("Material")
    shown.settle()
    faults += look(shown, folder, screen)
    page.set_viewport_size(dict(zip(("width", "height"), LAPTOP, strict=True)))
    assert faults == []


def test_the_search_for_faults_finds_them(shown: Viewer) -> None:
    shown.open_tab("Export")
    sheet = shown.page.add_style_tag(
        content=".inspector { right: -60px } .inspector .button { width: 90px !important; white-space: nowrap }"
    )
    found = " ".join(shown.page.evaluate(FIND_FAULTS))
    sheet.evaluate("(sheet) => sheet.remove()")
    assert "cut off by the window" in found and "is wider than its box" in found
