"""The list of jobs: what a user sees of a build while it runs, when it fails, and once it is done. The answers are written here."""

import io
from collections.abc import Iterator

import pytest
from PIL import Image
from playwright.sync_api import Locator, Page, Route, expect

from drgs_server.api.openapi_document import EXAMPLES
from tests.web.conftest import Viewer, wait_until

RUNNING = EXAMPLES["JobInfo"]["running"]
WARNING = {"level": "warning", "sentence": "12 views are few.", "advice": "Take 20 to 100 pictures, all around the object."}
ERROR = {"level": "error", "sentence": "r_003.png: no such image.", "advice": "Mend that first."}


class Jobs:
    """What the server says of its jobs, as the test has it, and what it was asked to do."""

    def __init__(self) -> None:
        self.list: list[dict] = []
        self.asked: list[tuple[str, str]] = []

    def answer(self, route: Route) -> None:
        path = route.request.url.split("/api/jobs", 1)[1]
        if "preview" in path:
            stream = io.BytesIO()
            Image.new("RGB", (64, 48), (200, 90, 40)).save(stream, "JPEG")
            route.fulfill(content_type="image/jpeg", body=stream.getvalue())
        elif route.request.method == "GET":
            route.fulfill(json={"jobs": self.list, "total": len(self.list), "workers_alive": 1})
        else:
            self.asked.append((route.request.method, path))
            route.fulfill(status=202, json=self.list[0] if self.list else RUNNING)


@pytest.fixture(scope="module")
def answers(viewer: Viewer) -> Iterator[Jobs]:
    """For as long as the page lives: it asks for what a test showed it after that test, too."""
    made = Jobs()
    viewer.page.route("**/api/jobs**", made.answer)
    viewer.page.route("**/api/jobs/**", made.answer)
    yield made
    viewer.page.unroute_all(behavior="wait")


@pytest.fixture
def jobs(answers: Jobs) -> Jobs:
    answers.list, answers.asked = [], []
    return answers


def wait_for_a_request(page: Page, jobs: Jobs) -> None:
    """Playwright hands requests to `answer` only while it is being asked something."""
    wait_until(lambda: page.wait_for_timeout(20) or jobs.asked, "the server to hear of it")


def shown(page: Page, jobs: Jobs, **values: object) -> Locator:
    """The card of a job that is as in the examples but for these."""
    jobs.list = [RUNNING | values]
    page.reload()
    card = page.get_by_role("listitem", name="Build Mug")
    expect(card).to_be_visible()
    return card


def test_a_running_build_shows_picture_quality_time_left_and_findings(viewer: Viewer, jobs: Jobs) -> None:
    page = viewer.page
    card = shown(page, jobs, psnr=20.0, fraction=0.2, capture={"summary": "12 pictures of 800x600 without masks.", "findings": [WARNING]})
    expect(card.get_by_text("1200 of 4000 · 20.0 dB · 3 min left")).to_be_visible()
    expect(card.get_by_role("img", name="Preview of Mug")).to_be_visible()
    expect(card.get_by_role("progressbar")).to_have_attribute("aria-valuenow", "20")
    expect(card.get_by_text("12 pictures of 800x600 without masks.")).to_be_visible()
    expect(card.get_by_text("12 views are few.")).to_be_visible()
    expect(card.get_by_text("Take 20 to 100 pictures")).to_be_visible()
    jobs.list = [jobs.list[0] | {"psnr": 26.5, "fraction": 0.4, "preview_version": 13}]
    expect(card.get_by_role("img", name="Quality from 20.0 to 26.5 dB")).to_be_visible()
    page.reload()
    expect(card.get_by_role("img", name="Quality from 20.0 to 26.5 dB")).to_be_visible()
    card.get_by_role("button", name="Cancel").click()
    wait_for_a_request(page, jobs)
    assert ("POST", f"/{RUNNING['id']}/cancel") in jobs.asked


def test_a_capture_that_cannot_be_built_says_why_and_what_to_do(viewer: Viewer, jobs: Jobs) -> None:
    card = shown(viewer.page, jobs, state="failed", error=ERROR["sentence"], capture={"summary": "", "findings": [ERROR]})
    expect(card.get_by_text("r_003.png: no such image.")).to_have_count(1)
    expect(card.get_by_text("Mend that first.")).to_be_visible()
    expect(card.get_by_text("Then drop the mended folder here.")).to_be_visible()
    card.get_by_role("button", name="Retry").click()
    wait_for_a_request(viewer.page, jobs)
    assert ("POST", f"/{RUNNING['id']}/retry") in jobs.asked


def test_every_state_offers_what_can_be_done(viewer: Viewer, jobs: Jobs) -> None:
    offered = {"stalled": "Resume", "cancelled": "Retry", "unknown": "Retry", "done": "Open"}
    clean = {"summary": "64 pictures.", "findings": []}
    jobs.list = [RUNNING | {"id": state, "name": state, "state": state, "capture": clean} for state in offered]
    jobs.list[-1]["asset_id"] = "done"
    viewer.page.reload()
    for state, button in offered.items():
        card = viewer.page.get_by_role("listitem", name=f"Build {state}")
        expect(card.get_by_role("button", name=button)).to_be_visible()
        expect(card.get_by_text("Nothing about this capture stands in the way.")).to_be_visible()


def test_where_gaussians_lie_and_what_stays_as_given_is_chosen_with_the_build(viewer: Viewer, jobs: Jobs) -> None:
    page = viewer.page
    page.reload()
    page.get_by_text("Advanced").click()
    page.get_by_role("radio", name="On the mesh").check()
    page.get_by_role("group", name="Cameras stand").get_by_role("radio", name="As given").check()
    with page.expect_request(lambda request: request.url.endswith("/api/jobs") and request.method == "POST") as sent:
        page.get_by_role("button", name="Build the sample").click()
    found = {"light": "auto", "masks": "auto", "cameras": "given"}
    assert sent.value.post_data_json == {"dataset": "sample", "preset": "fast", "binding": "mesh"} | found


def test_the_page_logged_no_errors(viewer: Viewer) -> None:
    assert viewer.complaints == []
