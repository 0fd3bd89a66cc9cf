"""Windows around the object in the place of whole pictures: cameras, pictures and masks belong together, and fine paint is read through them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from drgs.reconstruct.capture.load_views import read_capture
from drgs.reconstruct.capture.load_views.read_pictures import read_pictures
from drgs.reconstruct.capture.look_nearer import look_nearer, object_windows
from drgs.reconstruct.capture.open_capture import open_capture
from drgs.reconstruct.fit.evidence.photographs_as_taken import PhotographsAsTaken
from drgs.reconstruct.fit.view_targets import view_targets
from drgs.scene.camera import pixel_rays_world
from drgs.scene.views import Views
from tests.reconstruct.tiny_capture import SPHERE_CENTER, SPHERE_RADIUS, VIEWS, WIDTH, color_of_normal, hits_sphere, write_nerfstudio

SMALL = WIDTH // 2
"""[pixels] Side of the views: half of the photographs', of which the sphere fills less than half."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_nerfstudio(tmp_path_factory.mktemp("capture"))


def assert_pictures_are_of_their_cameras(views: Views, least_share: float) -> None:
    """Against rays to the sphere; `least_share` of the pixels' masks and colours within a pixel's blur."""
    for camera, image, mask in zip(views.cameras, views.images_srgb, views.coverage, strict=True):
        assert image.shape[:2] == mask.shape == (camera.height, camera.width)
        origin, directions = (values.double().numpy() for values in pixel_rays_world(camera))
        distance = hits_sphere(origin, directions)
        hit = ~np.isnan(distance)
        assert float((hit == (mask.numpy() > 127)).mean()) > least_share
        inside = hit & (mask.numpy() == 255)
        normal = (origin + np.nan_to_num(distance)[..., None] * directions - SPHERE_CENTER) / SPHERE_RADIUS
        off = np.abs(image.numpy().astype(float) - color_of_normal(np.clip(normal, -1, 1)))[inside]
        assert float(off.mean()) < 3


def test_windows_show_the_object_larger_and_their_cameras_know(folder: Path):
    _, whole, _ = open_capture(folder, SMALL, 300, 0, sharpen=False)
    _, near, points = open_capture(folder, SMALL, 300, 0, sharpen=False, nearer=True)
    assert [camera.name for camera in near.cameras] == [camera.name for camera in whole.cameras]
    assert all(max(camera.width, camera.height) <= SMALL for camera in near.cameras)
    filled = [sum(int((mask > 127).sum()) for mask in views.coverage) for views in (whole, near)]
    assert filled[1] > 1.5 * filled[0]
    assert_pictures_are_of_their_cameras(whole, 0.9)
    assert_pictures_are_of_their_cameras(near, 0.95)
    assert float((points.bounds_center - torch.from_numpy(SPHERE_CENTER)).norm()) < 0.15 * SPHERE_RADIUS


def test_masks_that_were_found_are_enlarged(folder: Path):
    capture, whole, _ = open_capture(folder, SMALL, 300, 0, sharpen=False)
    some = replace(
        whole, cameras=whole.cameras[::3], images_srgb=whole.images_srgb[::3], coverage=whole.coverage[::3], lenses=whole.lenses[::3]
    )
    windows = object_windows(capture, some, SMALL)
    assert windows is not None
    near = look_nearer(capture, some, windows, has_own_masks=False, sharpen=False)
    assert len(near.cameras) == len(some.cameras) == -(-VIEWS // 3)
    assert_pictures_are_of_their_cameras(near, 0.93)


def test_what_fills_its_pictures_or_is_in_none_is_left_as_it_is(folder: Path):
    capture, whole, _ = open_capture(folder, None, 300, 0, sharpen=False)
    assert object_windows(capture, whole, WIDTH) is None  # no photograph is any larger
    empty = replace(whole, coverage=tuple(torch.zeros_like(mask) for mask in whole.coverage))
    assert object_windows(capture, empty, SMALL) is None
    _, near, _ = open_capture(folder, None, 300, 0, sharpen=False, nearer=True)
    assert all(torch.equal(a, b) for a, b in zip(near.images_srgb, whole.images_srgb, strict=True))


def test_a_photograph_as_it_was_taken_is_seen_through_its_window(folder: Path):
    capture, near, _ = open_capture(folder, SMALL, 300, 0, sharpen=False, nearer=True)
    as_taken = PhotographsAsTaken(capture, near, view_targets(near, 1.0, torch.device("cpu")), WIDTH)
    full = read_pictures(read_capture(folder), None)
    larger = 0
    for number, camera in enumerate(as_taken.cameras):
        target = as_taken.target(number)
        assert (target.camera.width, target.camera.height) == (camera.width, camera.height)
        torch.testing.assert_close(target.camera.intrinsics, camera.intrinsics)
        larger += camera.width > near.cameras[number].width
        # What the window shows, pixel by pixel, is a part of the photograph.
        left, top = (round(float(full.cameras[number].intrinsics[axis, 2] - camera.intrinsics[axis, 2])) for axis in (0, 1))
        part = full.images_srgb[number][top : top + camera.height, left : left + camera.width].float() / 255
        solid = target.mask > 0.99
        torch.testing.assert_close(target.saturation[solid], part[solid], atol=1e-4, rtol=0)
    assert larger == len(as_taken.cameras)
