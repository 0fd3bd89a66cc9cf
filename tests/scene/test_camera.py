"""Cameras: the same view at another size."""

import torch

from drgs.scene.camera import pixel_rays_world, scaled_camera, windowed_camera
from tests.render.closed_form_scenes import front_camera


def test_a_scaled_camera_sees_the_same():
    camera = front_camera(72, distance=3.0)
    small = scaled_camera(camera, 0.5)
    assert (small.width, small.height) == (camera.width // 2, camera.height // 2)
    _, fine = pixel_rays_world(camera)
    _, coarse = pixel_rays_world(small)
    middle = torch.nn.functional.normalize(fine[0::2, 0::2] + fine[0::2, 1::2] + fine[1::2, 0::2] + fine[1::2, 1::2], dim=-1)
    torch.testing.assert_close(coarse, middle, atol=1e-4, rtol=0)


def test_a_window_of_a_camera_sees_what_the_whole_sees_there():
    camera = front_camera(72, distance=3.0)
    window = windowed_camera(camera, slice(10, 50), slice(20, 31))
    assert (window.height, window.width) == (40, 11)
    torch.testing.assert_close(pixel_rays_world(window)[1], pixel_rays_world(camera)[1][10:50, 20:31], atol=1e-6, rtol=0)
