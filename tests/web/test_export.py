"""What leaves the page: stills to work on, films, and files that hold what was done to the object."""

import json
import math
import re
import zipfile
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Page, expect

from drgs.convert.import_mesh import import_mesh
from drgs.exchange.export_formats import DEFAULT_FACES
from drgs.exchange.exr import decode_exr
from drgs.reconstruct.capture.load_views import load_cameras
from drgs_server.client import Client
from tests.web.conftest import Viewer, wait_until

VIEWS = "Views of the film"


@pytest.fixture(autouse=True)
def at_the_export_panel(ball: Viewer) -> None:
    ball.page.keyboard.press("Escape")
    ball.page.get_by_role("button", name="As captured").click()
    ball.wait_for_edits(0)
    ball.open_tab("Export")


def enter(page: Page, label: str, value: str) -> None:
    field = page.get_by_label(label, exact=True)
    field.fill(value)
    field.press("Enter")


def downloaded(viewer: Viewer, role: str, name: str, path: Path) -> Path:
    """The file that a click gives, moved to a folder and a name of our own."""
    with viewer.page.expect_download() as download:
        viewer.page.get_by_role(role, name=name).click()  # type: ignore[arg-type]
    download.value.save_as(path)
    return path


def test_an_exr_of_any_size_holds_light_and_alpha(ball: Viewer, tmp_path: Path) -> None:
    page = ball.page
    enter(page, "Width", "90")
    enter(page, "Height", "60")
    assert page.locator("[name=choice-size]:checked").count() == 0, "none of the usual sizes"
    page.get_by_role("radio", name="32", exact=True).check()
    page.get_by_role("radio", name="EXR", exact=True).check()
    page.get_by_role("switch", name="Transparent background").check()
    channels = decode_exr(downloaded(ball, "button", "Render EXR", tmp_path / "ball.exr").read_bytes())
    assert sorted(channels) == ["A", "B", "G", "R"] and channels["A"].shape == (60, 90)
    assert channels["A"][0, 0] == 0 and channels["A"][30, 45] == 1
    assert channels["R"][30, 45] > 3 * channels["B"][30, 45] > 0, "the ball's red side"
    page.get_by_role("radio", name="PNG", exact=True).check()


def test_all_channels_are_layers_of_one_exr(ball: Viewer, tmp_path: Path) -> None:
    page = ball.page
    enter(page, "Width", "90")
    enter(page, "Height", "60")
    page.get_by_role("radio", name="32", exact=True).check()
    page.get_by_role("radio", name="All channels", exact=True).check()
    expect(page.get_by_role("switch", name="Transparent background")).to_have_count(0)
    layers = decode_exr(downloaded(ball, "button", "Render all channels", tmp_path / "ball.exr").read_bytes())
    assert {"R", "A", "albedo.G", "normal.Z", "depth.Z", "visibility.Y", "indirect.B", "variance.Y"} <= set(layers)
    assert (
        layers["A"][30, 45] == 1
        and layers["albedo.R"][30, 45] == pytest.approx(0.8, abs=0.01)
        and layers["roughness.Y"][30, 45] == pytest.approx(0.6, abs=0.01)
    )
    assert layers["A"][0, 0] == 0 and math.isinf(layers["depth.Z"][0, 0])
    page.get_by_role("radio", name="PNG", exact=True).check()
    page.get_by_role("radio", name="Window").check()


def test_a_picture_that_the_server_would_refuse_is_not_asked_for(ball: Viewer) -> None:
    enter(ball.page, "Width", "9999")
    expect(ball.page.get_by_label("Width", exact=True)).to_have_value("4096")
    enter(ball.page, "Height", "4096")
    expect(ball.page.get_by_text("megapixels is the limit: make the picture smaller")).to_be_visible()
    expect(ball.page.get_by_role("button", name="Render PNG")).to_be_disabled()
    ball.page.get_by_role("radio", name="Window").check()
    expect(ball.page.get_by_role("button", name="Render PNG")).to_be_enabled()


def test_a_picture_that_takes_long_is_given_up_and_the_server_is_free_for_another(ball: Viewer, tmp_path: Path) -> None:
    page = ball.page
    page.get_by_role("radio", name="3840×2160").check()
    page.get_by_role("radio", name="128", exact=True).check()
    page.get_by_role("button", name="Render PNG").click()
    page.get_by_role("button", name="Cancel", exact=True).click()
    expect(page.get_by_role("button", name="Render PNG")).to_be_enabled()
    assert page.locator(".notices").get_by_text("server").count() == 0
    page.get_by_role("radio", name="32", exact=True).check()
    enter(page, "Width", "64")
    enter(page, "Height", "64")
    downloaded(ball, "button", "Render PNG", tmp_path / "small.png")
    page.get_by_role("radio", name="Window").check()
    page.get_by_role("radio", name="128", exact=True).check()


def test_what_was_made_gold_is_exported_as_gold_or_as_captured(ball: Viewer, tmp_path: Path) -> None:
    ball.open_tab("Material")
    ball.page.get_by_role("button", name="Gold").click()
    ball.wait_for_edits(1)
    ball.open_tab("Export")
    gold = import_mesh(downloaded(ball, "link", "Mesh (GLB)", tmp_path / "gold.glb")).mesh
    assert float(gold.metallic.mean()) > 0.95
    assert float(gold.albedo[:, 0].min()) > 2 * float(gold.albedo[:, 2].max()), "gold is no blue anywhere"
    ball.page.get_by_role("switch", name="With this session’s edits").uncheck()
    plain = import_mesh(downloaded(ball, "link", "Mesh (GLB)", tmp_path / "plain.glb")).mesh
    assert float(plain.metallic.mean()) < 0.05 and float(plain.albedo[:, 2].max()) > 0.7
    with zipfile.ZipFile(downloaded(ball, "link", "Object for AR (USDZ)", tmp_path / "ball.usdz")) as package:
        assert package.namelist()[0] == "object.usdc"
    kilobytes = math.ceil((tmp_path / "ball.usdz").stat().st_size / 1e3)
    expect(ball.page.get_by_role("link", name=f"Object for AR (USDZ) {kilobytes} kB")).to_be_visible()
    ball.page.get_by_role("switch", name="With this session’s edits").check()


def test_a_mesh_is_exported_with_the_faces_that_were_asked_for(ball: Viewer, ball_asset: str, tmp_path: Path) -> None:
    """By the page and by the client, whose file is the same."""
    link = ball.page.get_by_role("link", name="Mesh (GLB)")
    expect(ball.page.get_by_label("Faces of textured meshes", exact=True)).to_have_value(str(DEFAULT_FACES))
    enter(ball.page, "Faces of textured meshes", "300")
    few = downloaded(ball, "link", "Mesh (GLB)", tmp_path / "few.glb")
    assert 200 < len(import_mesh(few).mesh.faces) <= 300
    expect(link).to_have_accessible_name(f"Mesh (GLB) {math.ceil(few.stat().st_size / 1e3)} kB")
    with Client(ball.server.address, token=ball.server.token) as client:
        client.export(ball_asset, "mesh", tmp_path / "same.glb", faces=300)
    assert (tmp_path / "same.glb").read_bytes() == few.read_bytes()
    enter(ball.page, "Faces of textured meshes", str(DEFAULT_FACES))
    expect(link).not_to_have_accessible_name(re.compile(rf" {math.ceil(few.stat().st_size / 1e3)} kB"))


def test_a_file_that_cannot_be_written_says_why(ball: Viewer) -> None:
    ball.page.get_by_role("link", name="Gaussians (2DGS PLY)").click()
    expect(ball.page.get_by_role("log").get_by_text("Gaussians")).to_be_visible()
    ball.page.get_by_role("log").get_by_role("button", name="Dismiss").click()
    ball.complaints[:] = [text for text in ball.complaints if "422" not in text]  # the browser's own line


def test_a_film_is_made_of_views_previewed_and_ordered_as_previewed(ball: Viewer, tmp_path: Path) -> None:
    page = ball.page
    first = ball.settled_picture()
    page.get_by_role("button", name="Add this view").click()
    page.mouse.move(300, 150)
    page.mouse.down()
    page.mouse.move(180, 150, steps=4)
    page.mouse.up()
    second = ball.settled_picture()
    assert np.abs(second - first).mean() > 3
    page.get_by_role("button", name="Add this view").click()
    enter(page, "Seconds to view 2", "0.5")
    page.get_by_role("button", name="Go to view 1").click()
    wait_until(lambda: np.abs(ball.settled_picture() - first).mean() < 2, "the first view")
    page.get_by_role("button", name="Preview").click()
    expect(page.get_by_label("Moment, exact value")).to_have_value("0.50")
    wait_until(lambda: np.abs(ball.settled_picture() - second).mean() < 2, "the second view at the end of the film")
    page.get_by_role("button", name="Move view 2 earlier").click()
    page.get_by_role("button", name="Go to view 1").click()
    wait_until(lambda: np.abs(ball.settled_picture() - second).mean() < 2, "the second view in the first place")

    page.get_by_role("radio", name="360p").check()
    with page.expect_request(lambda request: request.method == "POST" and request.url.endswith("/api/jobs")) as sent:
        page.get_by_role("button", name="Render film (MP4)").click()
    asked = sent.value.post_data_json
    assert [keyframe["seconds"] for keyframe in asked["path"]["keyframes"]][1] == 0.5
    assert (asked["width"], asked["height"], asked["video_fps"]) == (640, 360, 24)
    job = wait_until(lambda: [job for job in ball.server.ask("/api/jobs")["jobs"] if job["name"] == "ball, film"], "the job")[0]
    assert job["kind"] == "render" and job["state"] == "queued"
    cameras = load_cameras(downloaded(ball, "button", "Save cameras", tmp_path / "transforms.json"))
    assert len(cameras) == 13 and (cameras[0].width, cameras[0].height) == (640, 360)
    eye = asked["path"]["keyframes"][0]["eye"]
    np.testing.assert_allclose(cameras[0].center_world.numpy(), eye, atol=1e-5)

    page.get_by_role("switch", name="Closed path").check()
    enter(page, "Seconds to view 1", "1")
    expect(page.get_by_text("36 pictures, 24 a second.")).to_be_visible()
    assert len(load_cameras(downloaded(ball, "button", "Save cameras", tmp_path / "closed.json"))) == 36, "the first view comes once"
    page.get_by_role("switch", name="Closed path").uncheck()

    card = page.get_by_role("listitem", name="Pictures ball, film")
    card.get_by_role("button", name="Cancel").click()
    card.get_by_role("button", name="Remove").click()
    expect(card).to_have_count(0)
    page.get_by_role("button", name="Library").click()


def test_the_views_of_a_film_survive_a_reload(ball: Viewer) -> None:
    page = ball.page
    expect(page.get_by_role("list", name=VIEWS).get_by_role("listitem")).to_have_count(2)
    page.reload()
    expect(page.get_by_role("list", name=VIEWS).get_by_role("listitem")).to_have_count(2)
    for _ in range(2):
        page.get_by_role("button", name="Remove view 1").click()
    expect(page.get_by_role("list", name=VIEWS)).to_have_count(0)
    assert json.loads(page.evaluate("localStorage.getItem('drgs.films')")) == {}


def test_the_page_logged_no_errors(ball: Viewer) -> None:
    assert ball.complaints == []
