"""Times to a given error are read off measured points as the table says; the variants show the same picture."""

import numpy as np
import pytest

from benchmarks.render.integrator import of_mean, ours, time_to_error
from drgs.render.intersect.trace_rays import build_tracer
from drgs.render.records import RenderSettings
from drgs.scene.posed_scene import PosedScene
from tests.render.closed_form_scenes import front_camera, sunny_sky, two_spheres

ROWS = [{"spp": n, "relmse": 0.8 / n, "seconds": 0.01 * n} for n in (64, 8, 16)]


@pytest.mark.parametrize("target", [1.0, 0.07, 0.0125, 0.001])
def test_time_to_an_error_follows_the_curve_between_and_beyond_its_points(target: float) -> None:
    assert time_to_error(ROWS, target, "seconds") == pytest.approx(0.01 * 0.8 / target, rel=1e-6)


def test_the_mean_over_seeds_tells_bias_from_what_pictures_share_by_chance() -> None:
    random = np.random.default_rng(0)
    truth = np.ones((32, 32, 4), np.float32)
    # One pixel holds most of the noise of the sum, as a lamp's mirror image does.
    pictures = [np.full((32, 32, 3), 1.01) for _ in range(16)]
    for picture in pictures:
        picture[3, 4] += random.normal(scale=40.0)
    found = of_mean(pictures, truth, np.zeros((32, 32)))
    assert found["seeds"] == len(pictures)
    assert found["spread"] == pytest.approx(40.0 / (1.01 * 32 * 32), rel=0.5)
    assert abs(found["bias"] - 0.01) < 3 * found["bias_error"] < 3 * found["spread"]


@pytest.mark.slow
def test_every_variant_shows_the_same_picture_and_low_discrepancy_lowers_the_error() -> None:
    scene = PosedScene(None, two_spheres(roughness=0.8), sunny_sky(sun=5.0))
    camera, tracer = front_camera(16, 6.0), build_tracer(scene.mesh)
    settings = RenderSettings(bounces=0, primary="mesh")
    shots = {s.variant: s for s in ours(scene, camera, settings, tracer, [128], ["paper", "sobol", "plan", "svgf"])}
    truth = next(ours(scene, camera, settings, tracer, [4096], ["plan"])).mean
    inside = truth[..., 1] > 0
    assert sorted(shots) == ["paper", "plan", "sobol", "svgf"] and all(s.spp == 128 for s in shots.values())
    for s in shots.values():
        assert s.mean[inside].mean() == pytest.approx(truth[inside].mean(), rel=0.02), s.variant
    error = {name: float(np.mean((s.mean - truth)[inside] ** 2)) for name, s in shots.items()}
    assert error["sobol"] < 0.8 * error["paper"]
