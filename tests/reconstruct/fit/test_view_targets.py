"""Photographs as losses want them: the light of the large ones in the small, and every view drawn once a round."""

from dataclasses import replace

import pytest
import torch

from drgs.reconstruct.capture.load_views import load_views
from drgs.reconstruct.fit.view_targets import drawn_view, view_targets, windowed
from drgs.scene.camera import pixel_rays_world
from drgs.scene.views import Views
from tests.reconstruct.tiny_capture import write_nerf_synthetic

CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def views(tmp_path_factory: pytest.TempPathFactory) -> Views:
    return load_views(write_nerf_synthetic(tmp_path_factory.mktemp("capture")))


def test_every_view_is_looked_at_once_a_round_in_an_order_of_its_own():
    rounds = [[drawn_view(12 * k + i, 12, seed=7) for i in range(12)] for k in range(3)]
    assert all(sorted(order) == list(range(12)) for order in rounds)
    assert rounds[0] != rounds[1] != rounds[2] and rounds[0] != [drawn_view(i, 12, seed=8) for i in range(12)]


def test_small_photos_keep_the_light_of_the_large_ones(views: Views):
    for large, small in zip(view_targets(views, 1.0, CPU), view_targets(views, 0.5, CPU), strict=True):
        assert small.photo.shape[:2] == (small.camera.height, small.camera.width)
        torch.testing.assert_close(small.photo.mean((0, 1)), large.photo.mean((0, 1)))
        torch.testing.assert_close(small.mask.mean(), large.mask.mean())
        outside = torch.ones_like(small.mask, dtype=torch.bool)
        outside[small.rows, small.columns] = False
        assert float(small.mask[outside].sum()) == 0.0  # the box holds the whole object


def test_a_window_holds_the_box_and_a_margin_of_the_same_photograph(views: Views):
    for target in view_targets(views, 1.0, CPU):
        window = windowed(target)
        height, width = window.mask.shape
        assert (window.camera.height, window.camera.width) == (height, width)
        assert window.whole is target.camera and window.share == height * width / target.mask.numel() < 1
        assert float(window.mask.sum()) == float(target.mask.sum())
        torch.testing.assert_close(window.photo[window.box], target.photo[target.box], atol=0, rtol=0)
        torch.testing.assert_close(window.saturation[window.box], target.saturation[target.box], atol=0, rtol=0)
        assert pixel_rays_world(window.camera)[1][window.box].allclose(pixel_rays_world(target.camera)[1][target.box], atol=1e-6)
        # What strays beyond the mask's box is seen still, unless the photograph ends there.
        box_rows = window.rows.stop - window.rows.start
        assert window.rows.start >= box_rows // 8 or target.rows.start - window.rows.start <= 0


def test_a_photograph_that_is_all_mask_is_its_own_window(views: Views):
    everywhere = replace(views, coverage=tuple(torch.full_like(mask, 255) for mask in views.coverage))
    target = windowed(view_targets(everywhere, 1.0, CPU)[0])
    assert target.share == 1.0 and target.mask.shape == views.coverage[0].shape
