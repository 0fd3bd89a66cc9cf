"""Handles and the corners of the lattice: taken hold of on the picture or by the keyboard, seen in pixels and in the server's edits."""

import io
import re
from collections.abc import Iterator

import numpy as np
import pytest
from PIL import Image
from playwright.sync_api import Browser, expect

from tests.web.conftest import Viewer, patient_page, wait_until


@pytest.fixture(autouse=True)
def shape(ball: Viewer) -> Iterator[None]:
    ball.page.keyboard.press("Escape")
    ball.page.get_by_role("button", name="As captured").click()
    ball.wait_for_edits(0)
    ball.open_tab("Shape")
    yield
    for name in ("Handles on the picture", "Corners on the picture", "Paint what stays"):
        if (switch := ball.page.get_by_label(name)).is_visible():
            switch.uncheck()


def outline(viewer: Viewer) -> tuple[float, float, float, float]:
    """Left, top, right and bottom of what is no background [CSS pixels]; the light around the ball is white."""
    picture = viewer.settled_picture()
    rows, columns = np.nonzero(picture.min(-1) < 200)
    scale = viewer.page.viewport_size["height"] / len(picture)
    return tuple(scale * float(value) for value in (columns.min(), rows.min(), columns.max(), rows.max()))


def screen(viewer: Viewer) -> np.ndarray:
    """(height, width, 3) of the page as it is seen, one pixel to two CSS pixels."""
    return np.asarray(Image.open(io.BytesIO(viewer.page.screenshot())).convert("RGB"), float)


def chosen_ball(viewer: Viewer) -> tuple[float, float]:
    """Where the arrows are [CSS pixels]."""
    x, y = wait_until(lambda: viewer.stage().get("arrows"), "arrows on the picture").split(",")
    return float(x), float(y)


def handles(viewer: Viewer) -> dict:
    edits = viewer.edits()
    return edits[-1]["handles"] if edits and edits[-1].get("handles") else {"drag": [], "pin": []}


def wait_for_handles(viewer: Viewer, moved: int, held: int) -> dict:
    def there() -> dict | None:
        now = handles(viewer)
        return now if (len(now["drag"]), len(now["pin"])) == (moved, held) else None

    found = wait_until(there, f"{moved} moved handles and {held} held ones")
    # The log is ahead of the page, which takes hold of those only that it has heard of.
    for count, state in ((moved, "moved"), (held, "stays")):
        expect(viewer.page.get_by_role("button", name=re.compile(rf"^Handle \d+, {state}$"))).to_have_count(count)
    return found


def test_a_handle_dragged_on_the_picture_pulls_the_object_and_is_one_step_of_undo(ball: Viewer) -> None:
    page = ball.page
    left, top, right, bottom = outline(ball)
    middle, reach = (left + right) / 2, 0.22 * (bottom - top)
    page.get_by_label("Handles on the picture").check()
    page.mouse.click(middle, bottom - reach)
    wait_for_handles(ball, 0, 1)
    page.mouse.click(middle, top + reach)
    pinned = wait_for_handles(ball, 0, 2)["pin"]
    page.mouse.move(middle, top + reach)
    page.mouse.down()
    for step in range(1, 9):
        page.mouse.move(middle, top + reach - 5 * step)
        page.wait_for_timeout(30)
    # The local picture follows while the button is held, and the traced one behind it.
    frames = int(ball.stage()["localFrames"])
    for step in range(1, 2000):  # traced pictures may come a dozen times a second, and a screen takes a while
        page.mouse.move(middle + step % 2, top + reach - 40)
        page.wait_for_timeout(20)
        if ball.stage()["picture"] == "stale" and int(ball.stage()["localFrames"]) > frames + 2:
            drawn = screen(ball).min(-1) < 200
            if ball.stage()["picture"] == "stale":  # no traced picture came while the screen was taken
                break
    else:
        pytest.fail("no screen was taken between two traced pictures")
    assert 2 * np.nonzero(drawn[:, round(middle / 2)])[0].min() < top - 15, "drawn here, pulled up"
    held = wait_until(lambda: (now := outline(ball))[1] < top - 15 and now, "a picture pulled up")
    assert held[3] - held[1] > bottom - top + 4, "drawn out, since the lower handle holds its part"
    page.mouse.up()
    now = wait_for_handles(ball, 1, 1)
    assert now["drag"][0]["point"] == pinned[1]["point"] and now["pin"] == pinned[:1]
    assert now["drag"][0]["target"][2] > pinned[1]["point"][2] + 0.1
    expect(page.get_by_role("button", name="Handle 1, moved")).to_have_attribute("aria-pressed", "true")
    assert chosen_ball(ball) == pytest.approx((middle, top + reach - 40), abs=4)
    white = screen(ball)[round((bottom - reach) / 2), round(middle / 2)]
    assert white.min() > 180, f"the ball of the handle that stays is white on the coloured object; found {white}"
    ball.undo()
    assert wait_for_handles(ball, 0, 2)["pin"] == pinned
    wait_until(lambda: abs(outline(ball)[1] - top) < 4, "the object as it was")
    ball.redo()
    wait_for_handles(ball, 1, 1)


def test_a_click_on_what_was_moved_puts_a_handle_on_the_same_place_at_rest(ball: Viewer) -> None:
    page = ball.page
    ball.append_edit({"op": "deform", "handles": {"drag": [{"point": [0, 0, 0.5], "radius": 0.1, "target": [0, 0, 0.65]}]}})
    ball.wait_for_edits(1)
    page.get_by_label("Handles on the picture").check()
    left, top, right, bottom = outline(ball)
    page.mouse.click((left + right) / 2, (top + bottom) / 2)
    (pin,) = wait_for_handles(ball, 1, 1)["pin"]
    assert np.linalg.norm(pin["point"]) == pytest.approx(0.5, abs=0.02)
    page.keyboard.press("Delete")
    wait_for_handles(ball, 1, 0)
    page.get_by_role("button", name="Handle 1, moved").click()
    expect(page.get_by_label("Place z")).to_be_visible()
    page.mouse.click(20, 400)  # beside the object
    expect(page.get_by_label("Place z")).not_to_be_visible()
    assert handles(ball)["pin"] == []
    # Materials are chosen on it just so.
    ball.open_tab("Material")
    page.get_by_role("radio", name="Sphere").check()
    page.mouse.click((left + right) / 2, (top + bottom) / 2)
    expect(ball.hint("% of the object is selected.")).to_be_visible()
    page.get_by_role("radio", name="All", exact=True).check()
    ball.open_tab("Shape")


def test_handles_work_by_the_keyboard(ball: Viewer) -> None:
    page = ball.page
    page.get_by_label("Handles on the picture").focus()
    page.keyboard.press("Space")
    for count in (1, 2):
        page.get_by_role("button", name="Add one in front").focus()
        page.keyboard.press("Enter")
        wait_for_handles(ball, 0, count)
    first, second = handles(ball)["pin"]
    assert np.subtract(first["point"], second["point"]).__abs__().max() > 0.1
    field = page.get_by_label("Place z")
    field.fill("0.75")
    field.press("Enter")
    assert wait_for_handles(ball, 1, 1)["drag"][0]["target"][2] == 0.75
    field = page.get_by_label("Turn z")
    field.fill("30")
    field.press("Enter")
    wait_until(lambda: handles(ball)["drag"][0]["turn"] == [0, 0, 30], "a turned handle")
    page.get_by_role("button", name="Put back").click()
    wait_for_handles(ball, 0, 2)
    page.keyboard.press("Escape")
    expect(page.get_by_label("Place z")).not_to_be_visible()
    page.get_by_role("button", name="Remove all").click()
    ball.wait_for_edits(0)


def test_a_corner_of_the_lattice_is_dragged_and_the_local_picture_follows(ball: Viewer) -> None:
    page = ball.page
    if not page.get_by_label("Corners on the picture").is_visible():
        page.get_by_text("Lattice", exact=True).click()
    page.get_by_label("Corners on the picture").check()
    page.get_by_role("button", name="Corner 8, at rest").click()
    x, y = chosen_ball(ball)
    frames = int(ball.stage()["localFrames"])
    page.mouse.move(x, y)
    page.mouse.down()
    for step in range(1, 6):
        page.mouse.move(x + 6 * step, y - 4 * step)
        page.wait_for_timeout(30)
    wait_until(lambda: int(ball.stage()["localFrames"]) > frames and ball.stage()["picture"] == "stale", "a local picture of the lattice")
    assert ball.edits() == []
    page.mouse.up()
    (edit,) = ball.wait_for_edits(1)
    corners = np.reshape(edit["map"]["control_points"], (8, 3))
    assert np.abs(np.abs(corners[:7]) - 0.5).max() < 1e-3 and np.abs(corners[7] - 0.5).max() > 0.05
    assert chosen_ball(ball) == pytest.approx((x + 30, y - 20), abs=4)
    ball.undo()
    ball.wait_for_edits(0)


def test_what_is_painted_stays_while_the_rest_falls(ball: Viewer, browser: Browser, ball_asset: str) -> None:
    page = ball.page
    left, top, right, bottom = outline(ball)
    before = screen(ball)
    page.get_by_label("Paint what stays").check()
    expect(ball.hint("Nothing is held.")).to_be_visible()
    x, y = (left + right) / 2, top + 0.15 * (bottom - top)
    page.mouse.move(x - 30, y)
    page.mouse.down()
    page.mouse.move(x, y, steps=3)
    page.mouse.move(x + 30, y, steps=3)
    page.mouse.up()
    expect(ball.hint("% of the surface is held.")).to_be_visible()
    spot = (round(y / 2), round(x / 2))
    wait_until(lambda: np.abs(screen(ball)[spot] - before[spot]).max() > 60, "a mark where it was painted")
    page.get_by_role("button", name="Hold the top").click()
    page.get_by_label("Paint what stays").uncheck()
    for label, value in (("Length", "0.25"), ("Density", "2"), ("Poisson", "0.4")):
        field = page.get_by_label(f"{label}, exact value")
        field.fill(value)
        field.press("Enter")
    page.get_by_role("button", name="Let it go").click()
    (edit,) = wait_until(lambda: [edit for edit in ball.edits() if edit.get("time", 0) > 0], "a simulation that plays", 60)
    page.get_by_role("button", name="Pause").click()
    assert len(edit["scene"]["pins"]) > 10
    assert edit["scene"]["matter"] == {"preset": "jelly", "density": 2000, "poisson_ratio": 0.4}
    time = page.get_by_label("Time, exact value")
    for moment, shown in (("0.247", "0.25"), ("0.25", "0.25")):  # the second reads as the first does, and counts all the same
        time.fill(moment)
        time.press("Enter")
        wait_until(lambda moment=float(moment): ball.edits()[-1]["time"] == moment, f"the moment {moment}", 60)
        expect(time).to_have_value(shown)
    assert abs(outline(ball)[1] - top) < 6, "the top hangs where it was; without pins it would have fallen by a third of the ball"
    page.get_by_role("button", name="Remove", exact=True).click()
    # What it was made of and held by is the session's: another viewer sees it, and it is undone.
    (kept,) = ball.wait_for_edits(1)
    assert kept == {"op": "matter", "scene": edit["scene"]}
    other = Viewer(patient_page(browser, viewport={"width": 760, "height": 420}, device_scale_factor=0.5), ball.server)
    session = ball.session_path().rpartition("/")[2]
    other.page.add_init_script(f"localStorage.setItem('drgs.session.{ball_asset}', '{session}')")
    other.page.goto(f"{ball.server.address}/#token={ball.server.token}&asset={ball_asset}")
    other.open_tab("Shape")
    expect(other.page.get_by_label("Density, exact value")).to_have_value("2")
    expect(other.hint("% of the surface is held.")).to_be_visible()
    other.page.close()
    page.get_by_role("button", name="Hold nothing").click()
    wait_until(lambda: ball.edits()[0]["scene"]["pins"] == [], "nothing held")
    expect(page.get_by_role("button", name="Hold nothing")).to_have_count(0)
    ball.undo()
    expect(page.get_by_role("button", name="Hold nothing")).to_be_visible()
    page.get_by_role("button", name="As captured").click()
    ball.wait_for_edits(0)
    expect(page.get_by_label("Poisson, exact value")).to_have_value(re.compile(r"^0\.30?$"))


def test_the_page_logged_no_errors(ball: Viewer) -> None:
    assert ball.complaints == []
