"""Adaptive frames: rays go where there is noise, the error asked for is met, and stopping favours no estimate."""

import dataclasses

import pytest
import torch

from drgs.render.film.resolve_frame import resolve_frame
from drgs.render.progressive.converge import tile_errors, tiles_to_go_on
from drgs.render.progressive.refine import refine_frame
from drgs.render.progressive.start_frame import start_frame
from drgs.render.records import RenderSettings
from drgs.render.render_frame import render_frame
from drgs.scene.posed_scene import PosedScene
from tests.render.closed_form_scenes import constant_sky, front_camera, sphere_mesh, sunny_sky, two_spheres

CAMERA = front_camera(48, distance=8)


def test_error_of_a_tile_is_that_of_its_worst_neighbour() -> None:
    luminance, variance = torch.ones(64 * 16), torch.zeros(64 * 16)
    variance[16 * 16 + 3 :: 64] = 0.0
    variance.view(16, 64)[:, 0:16] = 1.01
    errors = tile_errors(luminance, variance, torch.ones(64 * 16, dtype=torch.bool), 64, 16)
    torch.testing.assert_close(errors, torch.tensor([1.0, 1.0, 0.0, 0.0]))


def test_tiles_are_looked_at_when_their_passes_have_doubled() -> None:
    passes = torch.tensor([4, 8, 9, 16, 16])
    assert tiles_to_go_on(torch.tensor([0.0, 0.0, 0.0, 0.0, 1.0]), passes, 0.1).tolist() == [True, False, True, False, True]


@pytest.mark.slow
def test_a_frame_stops_below_the_error_asked_for() -> None:
    scene = PosedScene(None, sphere_mesh(4), sunny_sky(sun=20.0))
    settings = RenderSettings(samples_per_pixel=1 << 14, bounces=0, target_error=0.1)
    state = refine_frame(start_frame(scene, CAMERA, settings), 256)
    frame = resolve_frame(state)
    assert not bool(state.tiles.active.any()) and frame.metadata["error"] <= 0.1 and state.passes < 256
    exact = render_frame(scene, CAMERA, RenderSettings(samples_per_pixel=4096, bounces=0, seed=9))
    inside = exact.gbuffer.coverage == 1
    truth = exact.radiance_linear[inside].mean(-1)
    difference = frame.radiance_linear[inside].mean(-1) - truth
    assert float((difference.square() / (truth.square() + 0.01)).mean().sqrt()) < 0.1
    assert abs(float(difference.mean() / truth.mean())) < 0.005


def test_a_frame_at_rest_takes_no_more_rays() -> None:
    scene = PosedScene(None, sphere_mesh(3), constant_sky())
    state = refine_frame(start_frame(scene, CAMERA, RenderSettings(bounces=0, target_error=0.3)), 64)
    again = refine_frame(state, 5)
    assert state.passes < 64 and again.passes == state.passes and torch.equal(again.sums.diffuse, state.sums.diffuse)


@pytest.mark.slow
def test_a_smaller_error_asked_for_later_goes_on_with_the_same_sums() -> None:
    scene = PosedScene(None, two_spheres(), sunny_sky(sun=50.0))
    loose = RenderSettings(bounces=0, target_error=0.2)
    state = refine_frame(start_frame(scene, CAMERA, loose), 64)
    assert not bool(state.tiles.active.any())
    tight = start_frame(scene, CAMERA, dataclasses.replace(loose, target_error=0.1), previous=state)
    assert bool(tight.tiles.active.any()) and tight.passes == state.passes
    finished = refine_frame(tight, 1024)
    assert resolve_frame(finished).metadata["error"] <= 0.1 + 1e-6


def test_adaptive_passes_are_those_of_a_plain_frame_while_all_tiles_need_them() -> None:
    scene = PosedScene(None, two_spheres(), sunny_sky(sun=50.0))
    a = refine_frame(start_frame(scene, CAMERA, RenderSettings(target_error=1e-6)), 9)
    b = refine_frame(start_frame(scene, CAMERA, RenderSettings()), 9)
    assert torch.equal(a.sums.diffuse, b.sums.diffuse) and torch.equal(a.sums.weight, b.sums.weight)
