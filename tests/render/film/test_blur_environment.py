"""The environment out of focus: what a blur on the sphere must keep, its closed form for a point of light, and that it lights nothing."""

import math

import torch

from drgs.maths.color import srgb_from_linear
from drgs.render.film.blur_environment import BLUR_DEGREES, HEIGHT, blur_environment
from drgs.render.film.resolve_frame import resolve_frame
from drgs.render.progressive.refine import refine_frame
from drgs.render.progressive.start_frame import start_frame
from drgs.render.records import RenderSettings
from drgs.scene.camera import pixel_rays_world
from drgs.scene.environment import Environment, environment_radiance
from drgs.scene.lat_long import texel_directions
from drgs.scene.posed_scene import PosedScene
from tests.render.closed_form_scenes import front_camera, on_device, sphere_mesh, sunny_sky


def test_a_constant_sky_of_any_size_stays_constant() -> None:
    for height in (2, 17, 64, 200):
        soft = blur_environment(Environment(torch.full((height, 2 * height, 3), 0.7)))
        torch.testing.assert_close(soft.radiance, torch.full((HEIGHT, 2 * HEIGHT, 3), 0.7))


def test_a_point_of_light_becomes_a_lobe_that_turns_with_it() -> None:
    point = torch.zeros(HEIGHT, 2 * HEIGHT, 3)
    point[12, 30] = 1.0
    soft = blur_environment(Environment(point)).radiance[..., 0]
    directions = torch.from_numpy(texel_directions(HEIGHT))
    lobe = torch.exp(((directions @ directions[12, 30]) - 1) / math.radians(BLUR_DEGREES) ** 2)
    torch.testing.assert_close(soft.double() / soft.max(), lobe / lobe.max(), atol=3e-3, rtol=0)
    # All of its light is still there: the lobe's integral is that of the texel.
    sine = torch.sin((torch.arange(HEIGHT) + 0.5) * math.pi / HEIGHT)
    assert math.isclose(float((soft * sine[:, None]).sum()), float(sine[12]), rel_tol=2e-2)
    turned = blur_environment(Environment(torch.roll(point, 51, dims=1))).radiance[..., 0]
    torch.testing.assert_close(turned, torch.roll(soft, 51, dims=1), atol=1e-6, rtol=0)


def test_a_blurred_background_leaves_the_light_on_the_object_as_it_is(device: str) -> None:
    sky = Environment(sunny_sky(sun=20.0).radiance.to(device))
    scene = PosedScene(None, on_device(sphere_mesh(2), device), sky, environment_rotation_degrees=40.0, environment_intensity=0.5)
    camera = front_camera(48).to(device)
    pictures = {
        background: resolve_frame(refine_frame(start_frame(scene, camera, RenderSettings(samples_per_pass=4, background=background))))
        for background in ("environment", "blurred")
    }
    sharp, soft = pictures["environment"], pictures["blurred"]
    assert torch.equal(sharp.radiance_linear, soft.radiance_linear)
    inside, outside = sharp.gbuffer.coverage == 1, sharp.gbuffer.coverage == 0
    assert torch.equal(sharp.rgba_srgb[inside], soft.rgba_srgb[inside]) and int(inside.sum()) > 50
    assert float((sharp.rgba_srgb - soft.rgba_srgb)[outside].abs().max()) > 0.05
    # It turns, and grows stronger, as the sharp one does: seen through the middle of the picture's edge.
    _, direction = pixel_rays_world(front_camera(48))
    angle = torch.tensor(40.0).deg2rad()
    x, y, z = direction.unbind(-1)
    turned = torch.stack([angle.cos() * x + angle.sin() * y, angle.cos() * y - angle.sin() * x, z], -1)
    from_table = 0.5 * environment_radiance(blur_environment(sky), turned.to(device))
    from_picture = soft.rgba_srgb[outside][:, :3]
    torch.testing.assert_close(from_picture, srgb_from_linear(from_table).clamp(0, 1)[outside], atol=2e-3, rtol=0)
