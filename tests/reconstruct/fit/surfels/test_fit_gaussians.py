"""Stage 1 on a painted sphere: it learns, gives the same bits for the same seed, and goes on from a checkpoint as if never stopped."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch

from drgs import warp_torch
from drgs.reconstruct.capture.exposures import with_gains, with_gains_of_fit
from drgs.reconstruct.capture.initial_points import InitialPoints, initial_points
from drgs.reconstruct.capture.load_views import load_views
from drgs.reconstruct.checkpoints import fit_tensors, read_tensors, restore_fit, write_tensors
from drgs.reconstruct.fit.densify import DensifySettings
from drgs.reconstruct.fit.fit_loop import FitReport, FitState
from drgs.reconstruct.fit.light.environment_pyramid import environment_table
from drgs.reconstruct.fit.light.split_sum import filter_environment
from drgs.reconstruct.fit.surfels.fit_gaussians import (
    FitSettings,
    drawn_object,
    fit_gaussians,
    gaussians_from_state,
    size_factor,
    start_fit,
)
from drgs.reconstruct.fit.surfels.render_stage_one import render_stage_one
from drgs.scene.views import Views
from tests.one_torch_thread import one_torch_thread  # noqa: F401
from tests.reconstruct.capture.test_exposures import balanced, exposed, some_stops
from tests.reconstruct.tiny_capture import SPHERE_CENTER, SPHERE_RADIUS, write_nerf_synthetic

CPU = torch.device("cpu")
SHORT = FitSettings(iterations=26, densify=DensifySettings(every=5, growth=0.2, budget=420), seed=3)


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Views:
    return load_views(write_nerf_synthetic(tmp_path_factory.mktemp("capture")))


@pytest.fixture(scope="module")
def points(capture: Views) -> InitialPoints:
    return initial_points(capture, 300, seed=0)


@pytest.fixture(scope="module")
def views(capture: Views) -> Views:
    """Every second view: fewer than the short fit has steps."""
    return dataclasses.replace(capture, cameras=capture.cameras[::2], images_srgb=capture.images_srgb[::2], coverage=capture.coverage[::2])


def run(views: Views, state: FitState, points: InitialPoints, settings: FitSettings, stop_at: int | None = None) -> list[FitReport]:
    reports: list[FitReport] = []
    fit_gaussians(
        views,
        state,
        settings,
        points.bounds_radius,
        reports.append,
        lambda: stop_at is not None and state.iteration >= stop_at,
    )
    return reports


def assert_same_parameters(a: FitState, b: FitState) -> None:
    assert a.parameters.keys() == b.parameters.keys()
    for name, value in a.parameters.items():
        assert torch.equal(value, b.parameters[name]), name


@pytest.fixture(scope="module")
def short_fit(views: Views, points: InitialPoints) -> FitState:
    state = start_fit(points, SHORT, CPU)
    run(views, state, points, SHORT)
    return state


@pytest.mark.slow
def test_the_sphere_is_learnt(views: Views, points: InitialPoints):
    settings = FitSettings(iterations=60, densify=DensifySettings(every=10, budget=420))
    state = start_fit(points, settings, CPU)
    reports = run(views, state, points, settings)
    assert [r.iteration for r in reports] == list(range(1, 61)) and {r.iterations for r in reports} == {60}
    assert reports[-1].psnr > reports[0].psnr + 3.0
    assert 300 < reports[-1].elements <= 420
    surfels = gaussians_from_state(state)
    distance = (surfels.centers - torch.tensor(SPHERE_CENTER, dtype=torch.float32)).norm(dim=-1)
    assert float((distance - SPHERE_RADIUS).abs().median()) < 0.05 * SPHERE_RADIUS
    for name in ("albedo", "roughness", "metallic"):
        value = getattr(surfels, name)
        assert float(value.min()) >= 0 and float(value.max()) <= 1
    torch.testing.assert_close(surfels.quats_wxyz.norm(dim=-1), torch.ones(len(distance)))
    assert float(environment_table(state.parameters).detach().min()) > 0


@pytest.mark.slow
@pytest.mark.parametrize("threads", ["1", "2"])
def test_the_same_seed_gives_the_same_bits_whatever_the_number_of_threads(
    views: Views, points: InitialPoints, short_fit: FitState, threads: str, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setenv("DRGS_THREADS", threads)
    monkeypatch.setattr(warp_torch, "_pool", None)  # the pool is made once, for the threads asked for then
    state = start_fit(points, SHORT, CPU)
    run(views, state, points, SHORT)
    assert_same_parameters(state, short_fit)


@pytest.mark.slow
def test_another_seed_gives_other_bits(views: Views, points: InitialPoints, short_fit: FitState):
    settings = dataclasses.replace(SHORT, seed=4)
    state = start_fit(points, settings, CPU)
    run(views, state, points, settings, stop_at=4)
    assert not torch.equal(state.parameters["centers"][:100], short_fit.parameters["centers"][:100])


@pytest.mark.slow
@pytest.mark.parametrize("stop_at", [10, 17])
def test_a_resumed_fit_ends_with_the_numbers_of_one_that_never_stopped(
    views: Views, points: InitialPoints, short_fit: FitState, stop_at: int, tmp_path: Path
):
    # 10: at half size, in the first round through the views; 17: at full size, in the second, between two divisions.
    stopped = start_fit(points, SHORT, CPU)
    run(views, stopped, points, SHORT, stop_at)
    assert stopped.iteration == stop_at
    write_tensors(tmp_path / "x", fit_tensors(stopped), {})
    resumed = start_fit(points, SHORT, CPU)
    restore_fit(read_tensors(tmp_path / "x", CPU)[0], resumed)
    assert resumed.iteration == stop_at
    run(views, resumed, points, SHORT)
    assert resumed.iteration == SHORT.iterations
    assert_same_parameters(resumed, short_fit)


@pytest.mark.slow
def test_a_finished_fit_is_left_alone(views: Views, points: InitialPoints, short_fit: FitState):
    before = {name: value.detach().clone() for name, value in short_fit.parameters.items()}
    assert run(views, short_fit, points, SHORT) == []
    assert all(torch.equal(short_fit.parameters[name], value) for name, value in before.items())


def test_the_gradient_reaches_every_group(points: InitialPoints, views: Views):
    state = start_fit(points, SHORT, CPU)
    with torch.no_grad():
        state.parameters["sh_rest"] += 0.01
    tables = filter_environment(environment_table(state.parameters))
    maps = render_stage_one(state.parameters, tables, views.cameras[0], 0.01, sh_degree=3)
    (maps.radiance_linear - 0.3).square().sum().backward()
    for name, value in state.parameters.items():
        assert value.grad is not None and bool(torch.isfinite(value.grad).all()), name
        assert float(value.grad.abs().max()) > 0, name


def test_large_photographs_are_reduced_to_so_many_pixels(views: Views, points: InitialPoints) -> None:
    camera = views.cameras[0]
    assert size_factor((camera,), camera.width * camera.height) == 1.0
    pixels = camera.width * camera.height // 4
    assert size_factor((camera,), pixels) == 0.5
    halved = dataclasses.replace(SHORT, half_size_share=1.0, iterations=4)
    reduced = dataclasses.replace(SHORT, half_size_share=0.0, most_pixels=pixels, iterations=4)
    states = [start_fit(points, settings, CPU) for settings in (halved, reduced)]
    for state, settings in zip(states, (halved, reduced), strict=True):
        run(views, state, points, settings)
    assert_same_parameters(*states)


@pytest.mark.slow
def test_exposures_that_are_known_roughly_are_known_well_after_the_fit(views: Views, points: InitialPoints) -> None:
    stops = some_stops(len(views.cameras))
    guess = stops + 0.3 * np.sin(3 * np.arange(len(stops)))
    rough = with_gains(exposed(views, stops), guess)
    settings = dataclasses.replace(SHORT, iterations=90, half_size_share=0.5)
    state = start_fit(points, settings, CPU)
    fit_gaussians(rough, state, settings, points.bounds_radius)
    found = with_gains_of_fit(rough, drawn_object(state, points.bounds_radius, settings.sh_degree))
    assert found.gains is not None
    off = np.abs(np.log2(found.gains) - stops)
    assert float(np.sqrt((off**2).mean())) < 0.5 * float(np.sqrt(((guess - guess.mean() - stops) ** 2).mean()))


@pytest.mark.slow
def test_white_balances_are_found_half_way_and_a_fit_that_goes_on_keeps_them(views: Views, points: InitialPoints) -> None:
    logs = np.random.default_rng(3).normal(scale=0.12, size=(len(views.cameras), 3)) * [1, 0, 1]
    tints = np.exp(logs - logs.mean(0))
    settings = dataclasses.replace(SHORT, iterations=90, half_size_share=0.6)
    varied, state = balanced(views, tints), start_fit(points, settings, CPU)
    fit_gaussians(varied, state, settings, points.bounds_radius, should_stop=lambda: state.iteration == 70)
    assert state.exposures is not None and float((state.exposures[:, 0] - 1).abs().max()) == 0
    kept = state.exposures.clone()
    assert float(np.abs(kept[:, 1:].numpy() - 1).max()) > 0.1
    fit_gaussians(varied, state, settings, points.bounds_radius)
    assert torch.equal(state.exposures, kept)
