"""The moving camera's benchmark on a small scene: rate and error of both ways of making its pictures, side by side."""

import pytest

from benchmarks.render.frame import moving, true_pictures
from drgs.scene.asset import Asset
from tests.render.closed_form_scenes import sunny_sky, two_spheres

ASSET = Asset(None, two_spheres(roughness=0.6), None, sunny_sky(sun=20.0))


@pytest.mark.slow
def test_a_moving_camera_is_timed_and_its_pictures_compared_with_true_ones() -> None:
    truth = true_pictures(ASSET, 40, 128, 6, None)
    assert sorted(truth) == [1, 3, 5] and truth[1].metadata["samples"] == 128
    kept, traced = (moving(ASSET, 40, 8, 6, None, truth, keep_light) for keep_light in (True, False))
    assert kept["kept"] > 0 == traced["kept"] and kept["fps_moving"] > 0
    assert len(kept["relmse"]) == len(traced["relmse"]) == 3 and all(0 < error < 1 for error in kept["relmse"])
    assert true_pictures(ASSET, 40, 0, 6, None) == {} and moving(ASSET, 40, 8, 3, None)["relmse"] == []
