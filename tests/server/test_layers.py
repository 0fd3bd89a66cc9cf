"""All channels of a view in one EXR: the layers of `drgs render --aov`, and those that the viewer shows besides."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from conftest import Service
from test_channels import FRONT, half_known, posed
from test_rest import is_problem

from drgs.exchange.exr import decode_exr
from drgs.reconstruct.geometry.bind_gaussians import bind_gaussians
from drgs.render import render_bands
from drgs.render.film.resolve_frame import resolve_frame
from drgs.render.render_cameras import maps_of_frame
from drgs.render.render_frame import render_frame
from drgs.scene.asset import Asset
from drgs_server.live.messages import MAX_LAYERED_PIXELS, CameraMessage, Channel, Settings
from drgs_server.render.drgs_renderer import LoadedAsset, Picture, Pose
from drgs_server.render.interface import Layers
from tests.reconstruct.surfel_spheres import surfel_sphere
from tests.render.closed_form_scenes import sphere_mesh, sunny_sky, two_spheres

WIDTH, HEIGHT, SAMPLES = 40, 72, 20
AOV = ["R", "G", "B", "A", "albedo.R", "albedo.G", "albedo.B", "normal.X", "normal.Y", "normal.Z"]
AOV += ["depth.Z", "roughness.Y", "metallic.Y", "visibility.Y"]
OF_ALL = [*AOV, "indirect.R", "indirect.G", "indirect.B", "variance.Y"]
CAMERA = CameraMessage(type="camera", world_from_camera=FRONT, fov_y_degrees=40, width=WIDTH, height=HEIGHT)


def layers_of(pose: Pose, **settings) -> Layers:
    still = pose.layers(CAMERA, Settings(spp_target=SAMPLES, denoise=False, bounces=2, **settings), WIDTH, HEIGHT)
    while still.work():
        pass
    layers = still.picture()
    assert isinstance(layers, dict) and all(values.shape == (HEIGHT, WIDTH) for values in layers.values())
    return layers


def picture(pose: Pose, channel: Channel) -> Picture:
    made = pose.begin(CAMERA, Settings(spp_target=SAMPLES, denoise=False, bounces=2, channel=channel), WIDTH, HEIGHT, None)
    while made.samples < made.samples_target:
        made.refine()
    assert isinstance(made, Picture)
    return made


@pytest.fixture
def in_bands(monkeypatch: pytest.MonkeyPatch) -> None:
    """Several, as of a large picture."""
    whole: Callable = render_bands.band_rows
    monkeypatch.setattr(render_bands, "band_rows", lambda width, height, *_, at_least=0: whole(width, height, 1, at_least))


@pytest.mark.usefixtures("in_bands")
def test_the_layers_are_those_of_aov_to_the_bit_and_visibility_is_the_viewers() -> None:
    pose = posed(two_spheres(), sunny_sky())
    layers = layers_of(pose, exposure_stops=2.0)
    assert sorted(layers) == sorted(OF_ALL), "a mesh without certainty has neither that nor surfels"
    state = picture(pose, "final").state
    settings = state.inputs.settings
    aov = decode_exr(maps_of_frame(render_frame(pose.scene, state.inputs.camera, settings, pose.tracer)))
    assert sorted(aov) == sorted(AOV)
    for name in AOV:
        if name != "visibility.Y":  # under a white sky, so that light below the horizon counts as well
            np.testing.assert_array_equal(layers[name], aov[name], name)
    covered = layers["A"] > 0
    seen = resolve_frame(picture(pose, "visibility").state).radiance.visibility.numpy()
    np.testing.assert_array_equal(layers["visibility.Y"], np.where(covered, seen, 0))
    assert layers["visibility.Y"][covered].min() < 0.9


@pytest.mark.usefixtures("in_bands")
def test_indirect_light_and_noise_are_those_of_their_channels() -> None:
    pose = posed(two_spheres(), sunny_sky())
    layers = layers_of(pose)
    indirect = resolve_frame(picture(pose, "indirect").state).radiance.indirect
    variance = resolve_frame(picture(pose, "variance").state).radiance.variance
    assert indirect is not None
    covered = layers["A"] > 0
    for k, name in enumerate("RGB"):
        np.testing.assert_array_equal(layers[f"indirect.{name}"], np.where(covered, indirect[..., k].numpy(), 0))
    np.testing.assert_array_equal(layers["variance.Y"], np.where(covered, variance.numpy(), 0))
    assert layers["indirect.R"].max() > 0.01 and layers["variance.Y"].max() > 0
    assert np.isinf(layers["depth.Z"][~covered]).all() and (layers["normal.X"][~covered] == 0).all()


def test_an_asset_of_surfels_with_certainty_has_layers_of_both() -> None:
    mesh, surfels = sphere_mesh(), surfel_sphere(300)
    binding = bind_gaussians(surfels.centers, mesh)
    asset = Asset(surfels, mesh, binding, sunny_sky(), certainty=half_known(len(mesh.vertices)))
    pose = LoadedAsset(asset, Path("none")).pose([], None)
    layers = layers_of(pose)
    assert sorted(set(layers) - set(OF_ALL)) == ["certainty.B", "certainty.G", "certainty.R", *(f"surfels.{name}" for name in "ABGR")]
    inside = layers["A"] > 0.9  # Gaussians never cover a pixel wholly
    for name, value in (("R", 1.0), ("G", 0.5), ("B", 0.25)):
        np.testing.assert_allclose(layers[f"certainty.{name}"][inside], value, atol=2e-3)
    assert inside.sum() > 50 and layers["surfels.A"].max() == 1
    assert len({tuple(np.round(color, 1)) for color in np.stack([layers[f"surfels.{c}"][inside] for c in "RGB"], -1)}) > 8


def test_over_rest_they_are_one_exr_and_nothing_else(service: Service) -> None:
    url = f"/api/sessions/{service.open_session()}/frame"
    answer = service.client.get(f"{url}.exr?width=24&height=16&spp=8&channel=all")
    assert answer.status_code == 200 and sorted(decode_exr(answer.content)) == ["A", "B", "G", "R"], "all that the painter paints"
    assert "frame.exr instead of frame.png" in is_problem(service.client.get(f"{url}.png?channel=all"), 422)
    side = int(MAX_LAYERED_PIXELS**0.5) + 1
    assert str(MAX_LAYERED_PIXELS) in is_problem(service.client.get(f"{url}.exr?channel=all&spp=1&width={side}&height={side}"), 422)
