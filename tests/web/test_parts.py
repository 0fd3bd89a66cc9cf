"""Parts of an object: chosen by a click or painted, edited absolutely or by factors, and every value taken back by itself."""

import numpy as np
import pytest
from playwright.sync_api import expect

from tests.web.conftest import Viewer, wait_until

TOO_SMALL_TO_SEE = 6.0


@pytest.fixture(autouse=True)
def from_nothing(ball: Viewer) -> None:
    """Each test starts with everything selected, values set, and no edits."""
    ball.open_tab("Material")
    ball.page.keyboard.press("Escape")
    ball.page.get_by_role("button", name="As captured").click()
    ball.wait_for_edits(0)
    ball.page.get_by_role("radio", name="All", exact=True).check()
    ball.page.get_by_role("radio", name="Set", exact=True).check()


def click_middle(viewer: Viewer) -> None:
    """On the ball's red side; the right-hand panel covers 260 pixels."""
    viewer.page.mouse.click(250, 220)


def choose(viewer: Viewer, tool: str) -> None:
    viewer.page.get_by_role("radio", name=tool, exact=True).check()


def type_number(viewer: Viewer, label: str, value: str) -> None:
    field = viewer.page.get_by_label(f"{label}, exact value")
    field.fill(value)
    field.press("Enter")


def test_a_clicked_region_alone_turns_to_gold(ball: Viewer) -> None:
    before = ball.settled_picture()
    choose(ball, "Region")
    expect(ball.hint("Click on the object to select")).to_be_visible()
    click_middle(ball)
    expect(ball.hint("% of the object is selected")).to_be_visible()
    ball.page.get_by_role("button", name="Gold").click()
    (edit,) = ball.wait_for_edits(1)
    assert edit["select"]["region"] is not None
    assert edit["set"]["metallic"] == 1
    red = (before[..., 0] > 1.5 * before[..., 1]) & (before[..., 0] > 1.5 * before[..., 2]) & (before[..., 0] > 60)
    green = (before[..., 1] > 1.5 * before[..., 0]) & (before[..., 1] > 60)
    assert red.sum() > 500 and green.sum() > 50, "both parts are in sight"

    def change(part: np.ndarray) -> float:
        after = ball.settled_picture()
        return float(np.abs(after - before)[part].mean()) if after.shape == before.shape else 0.0

    wait_until(lambda: change(red) > 4 * TOO_SMALL_TO_SEE, "gold where it was red")
    assert change(green) < 2 * TOO_SMALL_TO_SEE, "what was not selected stays, but for light from the gold"


def test_a_selection_flashes_over_the_traced_picture(ball: Viewer) -> None:
    ball.settle()
    choose(ball, "Sphere")
    ball.page.evaluate(
        "() => { window.seen = new Set(); new MutationObserver(() => window.seen.add(document.querySelector('.stage').dataset.overlay))"
        ".observe(document.querySelector('.stage'), { attributes: true }); }"
    )
    click_middle(ball)
    wait_until(
        lambda: ball.page.evaluate("window.seen.has('true') && document.querySelector('.stage').dataset.overlay === 'false'"),
        "a flash that ends",
    )
    ball.page.get_by_role("radio", name="Box", exact=True).check()
    type_number(ball, "Metallic", "0.9")
    wait_until(lambda: ball.edits() and ball.edits()[-1]["select"].get("box"), "an edit of the box at the clicked point")


def test_reset_takes_that_value_back_and_nothing_else(ball: Viewer) -> None:
    captured = ball.page.get_by_label("Roughness, exact value").input_value()
    type_number(ball, "Roughness", "0.1")
    wait_until(lambda: ball.edits() and ball.edits()[-1]["set"].get("roughness") == 0.1, "the first edit")
    type_number(ball, "Metallic", "1")
    wait_until(lambda: ball.edits()[-1]["set"].get("metallic") == 1, "the second edit")
    ball.page.get_by_role("button", name="Reset roughness").click()
    wait_until(lambda: [edit["set"].get("roughness") for edit in ball.edits()] == [None] * len(ball.edits()), "a log without roughness")
    assert ball.edits()[-1]["set"]["metallic"] == 1
    expect(ball.page.get_by_label("Roughness, exact value")).to_have_value(captured)
    # Taking back is an edit like any other: it can be undone.
    ball.page.keyboard.press("Escape")
    ball.undo()
    wait_until(lambda: any(edit["set"].get("roughness") == 0.1 for edit in ball.edits()), "roughness again")


def test_what_is_being_typed_stays_while_news_of_the_value_arrives(ball: Viewer) -> None:
    field = ball.page.get_by_label("Metallic, exact value")
    field.fill("0.75")
    # Somebody else who looks at the same session.
    edit = {"op": "material", "select": {"all": True}, "set": {"roughness": 0.3}, "mode": "absolute"}
    ball.append_edit(edit)
    expect(ball.page.get_by_label("Roughness, exact value")).to_have_value("0.30")
    expect(field).to_have_value("0.75")
    field.press("Enter")
    wait_until(lambda: ball.edits()[-1]["set"].get("metallic") == 0.75, "what was typed in the log")


def test_multiplying_keeps_what_was_captured_apart(ball: Viewer) -> None:
    ball.page.get_by_role("radio", name="Multiply", exact=True).check()
    type_number(ball, "Roughness", "0.5")
    (edit,) = ball.wait_for_edits(1)
    assert edit["mode"] == "multiply" and edit["set"]["roughness"] == 0.5
    ball.settle()  # the page has heard of the first
    # Another factor takes the first one's place instead of multiplying it.
    type_number(ball, "Roughness", "0.25")
    wait_until(lambda: [edit["set"].get("roughness") for edit in ball.edits()] == [0.25], "one edit with the new factor")
    expect(ball.page.get_by_label("Roughness, exact value")).to_have_value("0.25")
    ball.page.get_by_role("button", name="Reset roughness").click()
    ball.wait_for_edits(0)


def test_a_copied_material_is_pasted_on_another_part(ball: Viewer) -> None:
    ball.page.get_by_role("button", name="Chrome").click()
    ball.wait_for_edits(1)
    expect(ball.page.get_by_label("Metallic, exact value")).to_have_value("1.00")  # the page has heard of it, too
    ball.page.keyboard.press("Control+c")
    ball.page.get_by_role("button", name="As captured").click()
    ball.wait_for_edits(0)
    choose(ball, "Similar")
    click_middle(ball)
    expect(ball.hint("% of the object is selected")).to_be_visible()
    ball.page.keyboard.press("Control+v")
    (edit,) = ball.wait_for_edits(1)
    assert edit["select"]["similar"]["tolerance"] == 0.1
    assert edit["set"]["metallic"] == pytest.approx(1) and edit["set"]["roughness"] == pytest.approx(0.06, abs=1e-6)


def test_painting_selects_and_edits_only_what_was_painted(ball: Viewer) -> None:
    choose(ball, "Brush")
    ball.page.mouse.move(250, 220)
    ball.page.mouse.down()
    ball.page.mouse.move(262, 226, steps=3)
    ball.page.mouse.up()
    expect(ball.hint("% of the object is selected")).to_be_visible()
    type_number(ball, "Metallic", "1")
    (edit,) = ball.wait_for_edits(1)
    weights = np.array(edit["select"]["vertex_weights"])
    assert weights.max() == 1 and 0 < np.count_nonzero(weights) < len(weights) / 3


def test_holding_b_shows_the_object_as_captured(ball: Viewer) -> None:
    ball.page.get_by_role("button", name="Car paint").click()
    ball.wait_for_edits(1)
    ball.settle()
    ball.page.keyboard.press("Escape")
    ball.page.keyboard.down("b")
    shown = ball.page.locator(".stage[data-before=true] .local")
    expect(shown).to_have_css("opacity", "1")
    expect(ball.page.locator(".stage .traced")).to_have_css("opacity", "0")
    ball.page.keyboard.up("b")
    expect(ball.page.locator(".stage .traced")).to_have_css("opacity", "1")


def test_the_page_logged_no_errors(ball: Viewer) -> None:
    assert ball.complaints == []
