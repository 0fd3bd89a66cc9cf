"""The notebooks of examples/ run from top to bottom, and what they were published with is what they show; an asset's view in one is its page."""

import json
from pathlib import Path

import pytest
from playwright.sync_api import Browser

import drgs
from examples.run_notebook import run_notebook, shown_as
from tests.web.browser import ROOT, RunningServer
from tests.web.conftest import patient_page, wait_until

MOST_BYTES = 1_000_000
"""Of a notebook with what it shows: they are in the repository."""


def shown(notebook: dict) -> list[list[str]]:
    """Of each cell of code the kinds of its outputs: media of values, and what was printed."""
    cells = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    return [[kind for output in cell["outputs"] for kind in sorted(output.get("data", output.get("text")))] for cell in cells]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["relight_a_mesh", "drive_a_server"])
def test_a_notebook_shows_what_it_was_published_with(name: str, server: RunningServer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DRGS_ADDRESS", f"{server.address}/#token={server.token}")
    path = ROOT / "examples" / f"{name}.ipynb"
    published, notebook = (json.loads(path.read_text(encoding="utf-8")) for _ in range(2))
    run_notebook(notebook, path.name)
    assert shown(notebook) == shown(published)
    assert sum("image/png" in kinds for kinds in shown(notebook)) >= 2
    assert path.stat().st_size < MOST_BYTES and server.token not in path.read_text(encoding="utf-8")


def test_a_cell_shows_what_it_prints_and_its_last_value() -> None:
    cells = [
        {"cell_type": "code", "source": ["print('said')\n", "x = 3\n", "x + 1"]},
        {"cell_type": "markdown", "source": ["no code"]},
        {"cell_type": "code", "source": ["x;"]},
        {"cell_type": "code", "source": ["if x:\n", "    x = 4"]},
    ]
    run_notebook({"cells": cells}, "a.ipynb")
    printed, value = cells[0]["outputs"]
    assert printed == {"output_type": "stream", "name": "stdout", "text": ["said\n"]}  # type: ignore[comparison-overlap]
    assert value["data"] == {"text/plain": ["4"]}  # type: ignore[index]
    assert [cell.get("outputs") for cell in cells[1:]] == [None, [], []]
    assert [cell.get("execution_count") for cell in cells] == [1, None, 2, 3]


@pytest.mark.slow
def test_the_view_of_an_asset_draws_within_its_frame_and_reaches_nothing_outside(
    built: None, browser: Browser, ball_file: Path, tmp_path: Path
) -> None:
    asset = drgs.import_mesh(ball_file)
    html = "".join(shown_as(drgs.view(asset, height_px=300))["text/html"])
    (tmp_path / "cell.html").write_text(f"<!doctype html><script>window.secret = 1</script>{html}")
    page = patient_page(browser, viewport={"width": 500, "height": 320}, device_scale_factor=0.5)
    asked: list[str] = []
    page.on("request", lambda request: asked.append(request.url))
    page.goto((tmp_path / "cell.html").as_uri())
    frame = wait_until(lambda: next(iter(page.frames[1:]), None), "the cell's frame")
    wait_until(lambda: int(frame.evaluate("document.querySelector('.stage')?.dataset.pictures ?? 0")), "the page in it to draw")
    assert page.locator("iframe").bounding_box()["height"] == 300  # type: ignore[index]
    blocked = "(() => { try { return parent.secret; } catch (error) { return error.name; } })()"
    assert frame.evaluate(blocked) == "SecurityError"
    assert [url for url in asked if not url.startswith(("file:", "data:", "about:"))] == []
    page.close()


def test_a_view_of_no_height_is_refused(ball_file: Path) -> None:
    with pytest.raises(ValueError, match="height_px is 0; expected pixels"):
        drgs.view(drgs.import_mesh(ball_file), height_px=0)
