"""Passes of the surface's fit: weights go on from pass to pass, and a sphere finds its size over two of them."""

from itertools import pairwise

import pytest
import torch

from drgs.reconstruct.fit.fit_surface import SurfaceSettings, start_surface
from drgs.reconstruct.fit.surface_passes import PassSettings, SurfaceFit, fit_surface_in_passes, settings_of_pass
from drgs.reconstruct.geometry.extract_mesh import MeshSettings
from tests.reconstruct.fit.painted_sphere import CENTER, grey_light, painted_views, placed_sphere
from tests.reconstruct.surfel_spheres import surfel_sphere
from tests.reconstruct.tiny_capture import SPHERE_RADIUS

SHRUNK = 0.93


def test_weights_go_on_where_the_pass_before_ended_and_rates_fall_in_the_last():
    settings = PassSettings(passes=4)
    each = [settings_of_pass(settings, index) for index in range(4)]
    for before, after in pairwise(each):
        assert before.weight_smooth_end == pytest.approx(after.weight_smooth)
        assert before.weight_bend_end == pytest.approx(after.weight_bend)
    assert (each[0].weight_smooth, each[-1].weight_smooth_end) == pytest.approx((1.0, 0.02))
    assert [one.fall_from for one in each] == [1.0, 1.0, 1.0, settings.surface.fall_from]
    assert len({one.seed for one in each}) == 4


@pytest.mark.slow
def test_a_sphere_that_is_too_small_is_as_large_as_its_photographs_after_two_passes(tmp_path):
    settings = PassSettings(
        2, SurfaceSettings(rounds=1, steps_a_round=6, share_rays=4), MeshSettings(resolution=40, face_limit=1500, smoothing_passes=0)
    )
    surfels = surfel_sphere(600, radius=SHRUNK * SPHERE_RADIUS, center=tuple(CENTER.tolist()))
    start = placed_sphere(SHRUNK)
    told: list[int] = []
    fit = SurfaceFit(start_surface(surfels, start, grey_light(), settings.surface, SPHERE_RADIUS), start.faces)
    views = painted_views(tmp_path)
    assert not fit_surface_in_passes(views, fit, settings, SPHERE_RADIUS, should_stop=lambda: fit.state.iteration == 2)
    assert (fit.index, fit.state.iteration) == (0, 2)
    assert fit_surface_in_passes(views, fit, settings, SPHERE_RADIUS, lambda r: told.append(r.iteration))
    assert abs(float((fit.mesh.vertices - CENTER).norm(dim=1).mean()) / SPHERE_RADIUS - 1) < 0.01
    assert not torch.equal(fit.faces, start.faces) and told == list(range(3, 13))
