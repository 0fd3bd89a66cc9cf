"""Pictures over REST for further work: an EXR holds the light that a PNG shows."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import Service
from test_rest import is_problem

from drgs.convert.import_mesh import import_mesh
from drgs.exchange.exr import decode_exr
from drgs.maths.color import srgb_from_linear
from drgs.reference.tonemap import apply_tone_curve
from drgs.render import render_bands
from drgs.scene.asset import Asset, load_asset, save_asset
from drgs.scene.certainty import Certainty
from drgs_server.live.messages import CameraMessage, Channel, Settings
from drgs_server.render.drgs_renderer import DrgsRenderer
from drgs_server.render.interface import LINEAR_CHANNELS, AbstractPose, LinearPixels
from drgs_worker.jobs.start_view import FOV_Y_DEGREES, start_view
from tests.web.browser import write_ball


def test_an_exr_holds_linear_values_and_alpha_only_where_there_is_some(service: Service) -> None:
    url = f"/api/sessions/{service.open_session()}/frame.exr?width=24&height=16&spp=8"
    answer = service.client.get(f"{url}&exposure_stops=1")
    assert answer.headers["content-type"] == "image/x-exr" and answer.headers["x-drgs-revision"] == "0"
    channels = decode_exr(answer.content)
    assert sorted(channels) == ["B", "G", "R"] and channels["G"].shape == (16, 24)
    assert (channels["R"].max(), channels["G"].max(), channels["B"].max()) == (0.0, 0.5, 16.0), "one stop brighter, and not cut at 1"
    clear = decode_exr(service.client.get(f"{url}&background=transparent&exposure_stops=1").content)
    assert clear["A"].max() == 0.5, "the exposure brightens light, not alpha"


def test_an_exr_of_a_channel_without_values_is_refused(service: Service) -> None:
    url = f"/api/sessions/{service.open_session()}/frame.exr?channel=beauty"
    is_problem(service.client.get(url), 422)


def test_a_still_may_be_larger_than_what_is_streamed_up_to_a_limit(service: Service) -> None:
    url = f"/api/sessions/{service.open_session()}/frame.jpg?spp=4"
    assert service.client.get(f"{url}&width=3840&height=2160").status_code == 200
    assert "4096x2160" in is_problem(service.client.get(f"{url}&width=4096&height=4096"), 422)


def with_certainty(asset: Asset) -> Asset:
    known = (torch.full((len(asset.mesh.vertices),), value, dtype=torch.float16) for value in (1.0, 0.5, 0.75, 0.25))
    return replace(asset, certainty=Certainty(*known))


@pytest.mark.slow
def test_certainty_comes_over_rest_and_an_asset_without_it_says_so(tmp_path: Path) -> None:
    write_ball(tmp_path / "ball.ply")
    service = Service(tmp_path, DrgsRenderer("cpu"))  # type: ignore[arg-type]
    with service.client:
        older, asset_id = service.add_mesh(tmp_path / "ball.ply"), service.add_mesh(tmp_path / "ball.ply")
        folder = service.context.directory.asset(asset_id)
        save_asset(with_certainty(load_asset(folder)), folder)
        sessions = [service.client.post("/api/sessions", json={"asset": name}).json()["id"] for name in (older, asset_id)]
        answers = [service.client.get(f"/api/sessions/{name}/frame.exr?width=24&height=16&spp=4&channel=certainty") for name in sessions]
    assert "does not say what is certain" in is_problem(answers[0], 422)
    shown = decode_exr(answers[1].content)
    inside = shown["A"] == 1
    assert inside.any()
    for name, value in (("R", 1.0), ("G", 0.5), ("B", 0.25)):
        np.testing.assert_allclose(shown[name][inside], value, atol=1e-3)


@pytest.fixture(scope="module")
def pose(tmp_path_factory: pytest.TempPathFactory) -> AbstractPose:
    folder = tmp_path_factory.mktemp("ball")
    write_ball(folder / "ball.ply")
    save_asset(with_certainty(import_mesh(folder / "ball.ply")), folder / "asset")
    return DrgsRenderer("cpu").load(folder / "asset", folder).pose([], None)


def rendered(pose: AbstractPose, **settings) -> tuple[np.ndarray, LinearPixels]:
    """(height, width, 4) of a 48x32 picture: as a screen shows it, 0..1, and its values."""
    view = start_view((-0.5, -0.5, -0.5), (0.5, 0.5, 0.5)).tolist()
    camera = CameraMessage(type="camera", world_from_camera=view, fov_y_degrees=FOV_Y_DEGREES, width=48, height=32)
    picture = pose.begin(camera, Settings(spp_target=8, denoise=False, **settings), 48, 32, None)
    while picture.samples < picture.samples_target:
        picture.refine()
    return picture.resolve() / 255, picture.linear()


@pytest.mark.parametrize("background", ["environment", "blurred", "transparent"])
def test_what_a_screen_shows_of_the_linear_picture_is_the_picture(pose: AbstractPose, background: str) -> None:
    shown, linear = rendered(pose, background=background)
    alpha = linear[..., 3:]
    assert (alpha.min() == 0) == (background == "transparent") and alpha.max() == 1
    straight = np.divide(linear[..., :3], alpha, out=np.zeros_like(linear[..., :3]), where=alpha > 0)
    again = srgb_from_linear(torch.from_numpy(straight)).clamp(0, 1).numpy()
    np.testing.assert_allclose(again, shown[..., :3], atol=0.51 / 255)
    np.testing.assert_allclose(alpha[..., 0], shown[..., 3], atol=0.51 / 255)


def test_a_tone_curve_is_the_screens_and_no_matter_of_the_light(pose: AbstractPose) -> None:
    (standard, light), (filmic, same_light) = rendered(pose), rendered(pose, tone_curve="filmic")
    np.testing.assert_array_equal(light, same_light)
    exact = srgb_from_linear(apply_tone_curve(torch.from_numpy(light[..., :3]), "filmic").clamp(0, 1)).numpy()
    np.testing.assert_allclose(filmic[..., :3], exact, atol=0.6 / 255)
    assert np.abs(filmic - standard)[..., :3].mean() > 0.01


def test_a_channel_holds_the_values_themselves(pose: AbstractPose) -> None:
    _, roughness = rendered(pose, channel="roughness")
    inside = roughness[..., 3] == 1
    np.testing.assert_allclose(roughness[inside][:, :3], 0.6, atol=1e-5)
    assert (roughness[roughness[..., 3] == 0] == 0).all() and inside.mean() > 0.15
    _, normal = rendered(pose, channel="normal")
    np.testing.assert_allclose(np.linalg.norm(normal[inside][:, :3], axis=-1), 1, atol=1e-5)
    assert normal[inside].min() < -0.3, "not squeezed into 0..1"
    _, depth = rendered(pose, channel="depth")
    assert np.isinf(depth[0, 0, 0]) and 0.5 < depth[16, 24, 0] < 4


@pytest.mark.slow
@pytest.mark.parametrize("channel", ["final", "depth", "normal", "variance", "visibility", "indirect", "surfels", "certainty"])
def test_a_picture_rendered_once_in_bands_has_the_pixels_of_one_that_is_refined(
    pose: AbstractPose, monkeypatch: pytest.MonkeyPatch, channel: Channel
) -> None:
    whole = render_bands.band_rows
    monkeypatch.setattr(render_bands, "band_rows", lambda width, height, *_, at_least=0: whole(width, height, 1, at_least))
    view = start_view((-0.5, -0.5, -0.5), (0.5, 0.5, 0.5)).tolist()
    camera = CameraMessage(type="camera", world_from_camera=view, fov_y_degrees=FOV_Y_DEGREES, width=40, height=72)
    settings = Settings(spp_target=20, channel=channel, tone_curve="agx", exposure_stops=0.5)
    refined = pose.begin(camera, settings, 40, 72, None)
    while refined.samples < refined.samples_target:
        refined.refine()
    for linear in (False, True) if channel in LINEAR_CHANNELS else (False,):
        still, slices = pose.still(camera, settings, 40, 72, linear), 0
        while still.work():
            slices += 1
        assert slices >= (0 if channel == "surfels" else 2)
        np.testing.assert_array_equal(still.picture(), refined.linear() if linear else refined.resolve())
