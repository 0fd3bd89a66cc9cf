"""What sums amount to: means and variances of passes, the environment behind the object, the screen's curve."""

import dataclasses

import torch

from drgs.maths.color import srgb_from_linear
from drgs.render.film.resolve_frame import _behinds, resolve_frame
from drgs.render.film.tonemap import tonemap
from drgs.render.progressive.converge import mean_variance
from drgs.render.progressive.frame_state import with_settings
from drgs.render.progressive.refine import refine_frame
from drgs.render.progressive.start_frame import start_frame
from drgs.render.records import RenderSettings
from drgs.scene.camera import pixel_rays_world
from drgs.scene.environment import Environment, environment_radiance
from drgs.scene.posed_scene import PosedScene
from tests.render.closed_form_scenes import front_camera, on_device, sphere_mesh, sunny_sky

CAMERA = front_camera(72)


def test_means_and_variances_are_those_of_the_passes(device: str) -> None:
    sky = Environment(sunny_sky(sun=20.0).radiance.to(device))
    scene = PosedScene(None, on_device(sphere_mesh(3), device), sky)
    state = refine_frame(start_frame(scene, CAMERA.to(device), RenderSettings(samples_per_pass=4, bounces=0)), 3)
    for passes in (1, 3):
        state.sums.places.fill_(passes)
        shown = resolve_frame(dataclasses.replace(state)).radiance

        def part(name: str) -> torch.Tensor:
            values = getattr(state.sums, name)
            return state.window.crop(values.unflatten(0, (CAMERA.height, CAMERA.width)))

        weight, count = part("weight").clamp(min=1), part("places")
        exact = mean_variance(part("luminance"), part("luminance_squared"), part("scatter")[..., 0], count) * (count / weight) ** 2
        crop = state.window.crop
        torch.testing.assert_close(crop(shown.variance), exact)
        torch.testing.assert_close(crop(shown.diffuse), part("diffuse") / weight[..., None])
        torch.testing.assert_close(crop(shown.specular), part("specular") / weight[..., None])
        torch.testing.assert_close(crop(shown.visibility), part("visibility") / weight)
        assert shown.specular_variance is not None
        torch.testing.assert_close(crop(shown.specular_variance), part("scatter")[..., 2] / weight**2)


def test_the_environment_stands_behind_the_object_turned_and_scaled(device: str) -> None:
    sky = Environment(torch.rand(16, 32, 3, device=device))
    scene = PosedScene(None, on_device(sphere_mesh(2), device), sky, environment_rotation_degrees=50.0, environment_intensity=0.5)
    settings = RenderSettings(samples_per_pass=4, bounces=0, background="environment", exposure=1.0)
    shown = resolve_frame(refine_frame(start_frame(scene, CAMERA.to(device), settings)))
    _, direction = pixel_rays_world(CAMERA)
    angle = torch.tensor(50.0).deg2rad()
    x, y, z = direction.to(device).unbind(-1)
    turned = torch.stack([angle.cos() * x + angle.sin() * y, angle.cos() * y - angle.sin() * x, z], -1)
    exact = srgb_from_linear(environment_radiance(sky, turned)).clamp(0, 1)  # half as strong, one stop more
    empty = shown.gbuffer.coverage == 0
    torch.testing.assert_close(shown.rgba_srgb[empty][:, :3], exact[empty], atol=2e-3, rtol=0)
    assert bool((shown.rgba_srgb[..., 3] == 1).all())


def test_the_second_picture_of_a_look_is_the_first_to_the_bit_and_of_looks_one_is_kept(device: str) -> None:
    """What is behind the object under one exposure and tone curve is kept for the next picture; a drag of the exposure keeps no more."""
    sky = Environment(torch.rand(16, 32, 3, device=device))
    scene = PosedScene(None, on_device(sphere_mesh(2), device), sky)
    settings = RenderSettings(samples_per_pass=4, bounces=0, background="environment")
    state = refine_frame(start_frame(scene, CAMERA.to(device), settings))
    for exposure in (0.0, 0.5, 1.0):
        looked = with_settings(state, exposure=exposure)
        first, second, third = (resolve_frame(looked).rgba_srgb for _ in range(3))
        assert torch.equal(first, second) and torch.equal(first, third)
        kept = vars(_behinds[state.traced.environment_light])
        assert kept["look"] == (exposure, "standard") and kept["seen"].shape == first.shape
        assert sum(isinstance(value, torch.Tensor) for value in kept.values()) == 2


def test_pictures_have_the_screens_curve_and_straight_alpha(device: str) -> None:
    radiance, coverage = 2 * torch.rand(9, 7, 3, device=device) ** 3, torch.rand(9, 7, device=device)
    coverage[0] = 0
    radiance[0] = torch.nan  # of nothing nothing is known
    inside = torch.where(coverage[..., None] > 0, radiance, 0.0)
    clear = tonemap(radiance, coverage, 0.5)
    torch.testing.assert_close(clear[..., :3], srgb_from_linear(inside * 2**0.5).clamp(0, 1), atol=1e-5, rtol=0)
    torch.testing.assert_close(clear[..., 3], coverage)
    gray = torch.tensor([0.2, 0.3, 0.4], device=device)
    full = tonemap(radiance, coverage, 0.0, gray)
    torch.testing.assert_close(
        full[..., :3], srgb_from_linear(torch.lerp(gray, inside, coverage[..., None])).clamp(0, 1), atol=1e-5, rtol=0
    )
    # A part of a larger picture, as the window is.
    torch.testing.assert_close(tonemap(radiance[2:5, 1:4], coverage[2:5, 1:4], 0.5), clear[2:5, 1:4])
