"""Passes of the surface's fit: weights go on from pass to pass, and a sphere finds its size over two of them."""

from dataclasses import replace
from itertools import pairwise

import pytest
import torch

from drgs.reconstruct.fit.evidence.register_cameras import CamerasFound
from drgs.reconstruct.fit.fit_loop import FitReport
from drgs.reconstruct.fit.surface import surface_passes
from drgs.reconstruct.fit.surface.fit_surface import SurfaceSettings, start_surface
from drgs.reconstruct.fit.surface.moving_surface import MoveSettings
from drgs.reconstruct.fit.surface.surface_passes import (
    PassSettings,
    SurfaceFit,
    fit_surface_in_passes,
    settings_of_displacement,
    settings_of_pass,
    settings_of_relief,
    start_next_pass,
)
from drgs.reconstruct.fit.surface.try_depths import TriedDepths
from drgs.reconstruct.fit.surface.try_kinds import TriedKinds, iterations
from drgs.reconstruct.geometry.divide_faces import DivisionSettings, divided_faces
from drgs.reconstruct.geometry.extract_mesh import MeshSettings
from drgs.reconstruct.geometry.remesh import NothingEnclosed
from tests.reconstruct.fit.painted_sphere import CENTER, grey_light, painted_views, placed_sphere
from tests.reconstruct.surfel_spheres import surfel_sphere
from tests.reconstruct.tiny_capture import SPHERE_RADIUS

SHRUNK = 0.93
SHORT = PassSettings(
    2,
    SurfaceSettings(rounds=1, steps_a_round=2, moves=MoveSettings(share_rays=4)),
    MeshSettings(resolution=40, face_limit=1500, smoothing_passes=0),
    relief_steps=0,
)
"""Of which only is asked that they go through, stop and go on."""


def test_more_passes_take_normals_as_far_as_the_few() -> None:
    settings = PassSettings(3)
    more = settings.with_more_passes(2)
    assert more.passes == 5 and settings.with_more_passes(0) == settings

    def path(plan: PassSettings) -> float:
        return sum(settings_of_pass(plan, index).rates.normals for index in range(plan.passes))

    assert path(more) == pytest.approx(path(settings), rel=0.02)


def test_weights_go_on_where_the_pass_before_ended_and_rates_fall():
    settings = PassSettings(passes=4)
    each = [settings_of_pass(settings, index) for index in range(4)]
    for before, after in pairwise(each):
        assert before.weight_smooth_end == pytest.approx(after.weight_smooth)
        assert before.weight_bend_end == pytest.approx(after.weight_bend)
    assert (each[0].weight_smooth, each[-1].weight_smooth_end) == pytest.approx((1.0, 0.02))
    falling = [one.rates.normals for one in each]
    assert falling == sorted(falling, reverse=True) and falling[0] ** 8 == pytest.approx(0.02**7 * 0.002)
    assert falling[-1] ** 8 == pytest.approx(0.02 * 0.002**7)
    assert [one.fall_from for one in each] == [1.0, 1.0, 1.0, settings.surface.fall_from]
    assert [one.moves.to_surface for one in each] == [1.0, 1.0, 1.0, 0.1]
    assert [one.light_at_end for one in each] == [False, False, False, True]
    assert len({one.seed for one in each}) == 4


@pytest.mark.slow
def test_a_sphere_that_is_too_small_is_as_large_as_its_photographs_after_two_passes(tmp_path):
    settings = PassSettings(
        2,
        SurfaceSettings(rounds=1, steps_a_round=6, moves=MoveSettings(share_rays=4)),
        MeshSettings(resolution=40, face_limit=1500, smoothing_passes=0),
        relief_steps=0,
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
    assert not torch.equal(fit.faces, start.faces) and told == sorted(told)
    assert set(told) | set(range(19, 25)) == set(range(3, 31)), "steps by which the fit as it was is compared may not be asked for"


@pytest.mark.slow
def test_relief_is_fitted_on_divided_faces_while_the_surface_stays_and_goes_on_where_it_was_stopped(tmp_path):
    settings = PassSettings(
        1,
        SurfaceSettings(rounds=1, steps_a_round=2, moves=MoveSettings(share_rays=4)),
        division=DivisionSettings(edge_pixels=1.0, most_faces=5120),
        relief_steps=4,
    )
    surfels = surfel_sphere(600, radius=SPHERE_RADIUS, center=tuple(CENTER.tolist()))
    start, views = placed_sphere(), painted_views(tmp_path)

    def begun() -> SurfaceFit:
        return SurfaceFit(start_surface(surfels, start, grey_light(), settings.surface, SPHERE_RADIUS), start.faces)

    fit, at_once, told = begun(), begun(), []
    assert fit_surface_in_passes(views, fit, replace(settings, relief_steps=0), SPHERE_RADIUS)
    assert (fit.index, fit.divided) == (0, 0) and torch.equal(fit.faces, start.faces)
    coarse = fit.mesh
    assert not fit_surface_in_passes(views, fit, settings, SPHERE_RADIUS, should_stop=lambda: (fit.divided, fit.state.iteration) == (1, 1))
    assert (fit.index, fit.divided, fit.state.iteration) == (1, 1, 1)
    assert fit_surface_in_passes(views, fit, settings, SPHERE_RADIUS, lambda r: told.append((r.iteration, r.iterations)))
    assert told == [(4, 6), (5, 6), (6, 6)]
    divided = divided_faces(start.faces, len(start.vertices))
    assert torch.equal(fit.faces, divided.faces) and torch.equal(fit.mesh.vertices, divided.carried(coarse.vertices))
    under = fit.undivided_mesh
    assert torch.equal(under.faces, start.faces) and torch.equal(under.vertices, coarse.vertices)
    between = divided.carried(fit.state.parameters["normals"][: len(start.vertices)].detach())
    assert float((fit.state.parameters["normals"].detach() - between)[len(start.vertices) :].abs().max()) > 1e-3
    assert fit_surface_in_passes(views, at_once, settings, SPHERE_RADIUS)
    assert torch.equal(at_once.mesh.normals, fit.mesh.normals) and torch.equal(at_once.mesh.albedo, fit.mesh.albedo)


@pytest.mark.slow
def test_what_trials_moved_is_at_home_there_and_stopped_trials_are_done_again(tmp_path, monkeypatch: pytest.MonkeyPatch):
    settings = replace(SHORT, try_after=(1,))
    asked: list[int] = []
    homes: list[torch.Tensor] = []

    def sunk(views, parameters, faces, trials, radius, seed, report, should_stop):
        asked.append(seed)
        if len(asked) == 1:
            return None
        depth = torch.zeros(len(parameters["vertices"]))
        depth[0] = 0.02 * radius
        moved = parameters["vertices"] + depth[:, None] * torch.tensor([0.0, 0.0, -1.0])
        report(FitReport(1, trials.iterations, 20.0, len(depth), 0.0))
        return TriedDepths(parameters | {"vertices": moved}, depth, torch.ones(len(depth), 1), depth > 0)

    def start(fit, settings, radius):
        homes.append(fit.state.parameters["homeward"].clone())
        start_next_pass(fit, settings, radius)

    monkeypatch.setattr(surface_passes, "try_depths", sunk)
    monkeypatch.setattr(surface_passes, "start_next_pass", start)
    surfels = surfel_sphere(600, radius=SPHERE_RADIUS, center=tuple(CENTER.tolist()))
    begun = placed_sphere()
    fit = SurfaceFit(start_surface(surfels, begun, grey_light(), settings.surface, SPHERE_RADIUS), begun.faces)
    fit.state.parameters["homeward"].fill_(0.5)
    views, told = painted_views(tmp_path), []
    assert not fit_surface_in_passes(views, fit, settings, SPHERE_RADIUS)
    assert (fit.index, fit.state.iteration) == (0, 2)
    assert fit_surface_in_passes(views, fit, settings, SPHERE_RADIUS, lambda r: told.append((r.iteration, r.iterations)))
    assert asked[0] == asked[1]
    kinds = iterations(settings_of_pass(settings, 1))
    total = 4 + kinds + settings.trials.iterations
    assert told[:4] == [(k, total) for k in range(3, 7)] and told[-3:] == [(k, total) for k in (3 + kinds, total - 1, total)]
    assert float(homes[0][0].norm()) == 0 and float(homes[0][1:].norm(dim=1).min()) > 0


@pytest.mark.slow
def test_the_fit_goes_on_from_where_cameras_were_moved_to_and_asks_once_a_pass(tmp_path, monkeypatch: pytest.MonkeyPatch):
    settings = replace(SHORT, passes=3, try_after=(1,), cameras_after=(1, 2))
    asked: list[int] = []
    seen: list[torch.Tensor] = []

    def registered(tracer, targets, outlines, light_of, surface, seed):
        asked.append(seed)
        assert len(surface) == len(tracer.mesh.vertices) and len(outlines) == len(targets)
        assert light_of(targets[0]).open_share.shape == tracer.mesh.vertices.shape
        if len(asked) == 2:
            return CamerasFound(None, 0.02, 0.03)
        moved = torch.stack([target.camera.camera_from_world.double() for target in targets])
        moved[:, 0, 3] += 1e-3
        return CamerasFound(moved, 0.3, 0.05)

    def tried(views, parameters, faces, trials, radius, seed, report, should_stop):
        return None  # stopped there, the first time and each time after

    monkeypatch.setattr(surface_passes, "register_cameras", registered)
    monkeypatch.setattr(surface_passes, "try_depths", tried)
    fitted = surface_passes.fit_surface

    def fit_seeing(views, *given):
        seen.append(views.cameras[0].camera_from_world)
        return fitted(views, *given)

    monkeypatch.setattr(surface_passes, "fit_surface", fit_seeing)
    surfels = surfel_sphere(600, radius=SPHERE_RADIUS, center=tuple(CENTER.tolist()))
    begun, views = placed_sphere(), painted_views(tmp_path)
    fit = SurfaceFit(start_surface(surfels, begun, grey_light(), settings.surface, SPHERE_RADIUS), begun.faces)
    assert not fit_surface_in_passes(views, fit, settings, SPHERE_RADIUS)
    assert not fit_surface_in_passes(views, fit, settings, SPHERE_RADIUS)
    assert (fit.index, fit.cameras_asked, len(asked)) == (0, 1, 1), "cameras that were moved are not moved again when trials go on"
    assert fit_surface_in_passes(views, fit, replace(settings, try_after=()), SPHERE_RADIUS)
    assert (fit.cameras_asked, len(asked), len(set(asked))) == (2, 2, 2)
    given = views.cameras[0].camera_from_world
    assert torch.equal(seen[0], given)
    for at in seen[1:]:
        torch.testing.assert_close(at - given, 1e-3 * torch.eye(4)[:, :1] * torch.eye(4)[3], rtol=0, atol=1e-6)


@pytest.mark.slow
def test_both_kinds_are_tried_after_the_first_pass_whether_light_turns_or_not(tmp_path, monkeypatch: pytest.MonkeyPatch):
    settings = SHORT
    asked: list[int] = []
    kept: list[float] = []

    def tried(views, parameters, faces, own, report, should_stop):
        asked.append(own.seed)
        if len(asked) == 1:
            return None
        if report is not None:
            report(FitReport(1, iterations(own), 20.0, len(faces), 0.0))
        return TriedKinds(parameters | {"metal": torch.full_like(parameters["metal"], 0.7)}, (1.0, 2.0))

    def start(fit, settings, radius):
        kept.append(float(fit.state.parameters["metal"].min()))
        start_next_pass(fit, settings, radius)

    monkeypatch.setattr(surface_passes, "try_kinds", tried)
    monkeypatch.setattr(surface_passes, "start_next_pass", start)
    surfels = surfel_sphere(600, radius=SPHERE_RADIUS, center=tuple(CENTER.tolist()))
    begun, views = placed_sphere(), painted_views(tmp_path)

    def started() -> SurfaceFit:
        return SurfaceFit(start_surface(surfels, begun, grey_light(), settings.surface, SPHERE_RADIUS), begun.faces)

    fit, told = started(), []
    turned = replace(views, light_from_world=tuple(torch.eye(3) for _ in views.cameras))
    assert not fit_surface_in_passes(turned, fit, settings, SPHERE_RADIUS)
    assert (fit.index, fit.state.iteration, kept) == (0, 2, [])
    assert fit_surface_in_passes(turned, fit, settings, SPHERE_RADIUS, lambda r: told.append((r.iteration, r.iterations)))
    assert asked == [asked[0]] * 2 and kept == [pytest.approx(0.7)]
    assert told == [(3, 10), (9, 10), (10, 10)]
    assert fit_surface_in_passes(views, started(), settings, SPHERE_RADIUS) and asked == [asked[0]] * 3
    assert fit_surface_in_passes(views, started(), replace(settings, passes=1), SPHERE_RADIUS) and len(asked) == 3, "nothing follows it"


def test_a_surface_that_cannot_be_meshed_anew_stays_as_it_was_and_the_user_is_told(monkeypatch: pytest.MonkeyPatch):
    def nothing(*_: object) -> None:
        raise NothingEnclosed("the mesh of 8 faces encloses nothing at 40 cells; expected a closed surface")

    monkeypatch.setattr(surface_passes, "remesh", nothing)
    settings = PassSettings(3)
    surfels = surfel_sphere(600, radius=SPHERE_RADIUS, center=tuple(CENTER.tolist()))
    start = placed_sphere(1.0)
    fit = SurfaceFit(start_surface(surfels, start, grey_light(), settings.surface, SPHERE_RADIUS), start.faces)
    start_next_pass(fit, settings, SPHERE_RADIUS)
    assert fit.index == 1 and torch.equal(fit.faces, start.faces) and torch.equal(fit.mesh.vertices, start.vertices)
    assert fit.remark == (
        "after pass 1 the mesh before was kept, for the mesh of 8 faces encloses nothing at 40 cells; expected a closed surface"
    )


@pytest.mark.slow
def test_after_the_passes_the_surface_is_displaced_before_its_faces_are_divided(tmp_path):
    settings = replace(
        SHORT,
        passes=1,
        displacement_steps=3,
        division=DivisionSettings(edge_pixels=1.0, most_faces=5120),
        relief_steps=2,
    )
    surfels = surfel_sphere(600, radius=SPHERE_RADIUS, center=tuple(CENTER.tolist()))
    start, views, told = placed_sphere(), painted_views(tmp_path), []

    def begun() -> SurfaceFit:
        return SurfaceFit(start_surface(surfels, start, grey_light(), settings.surface, SPHERE_RADIUS), start.faces)

    fit, at_once = begun(), begun()
    assert not fit_surface_in_passes(views, fit, settings, SPHERE_RADIUS, should_stop=lambda: (fit.index, fit.state.iteration) == (1, 2))
    assert (fit.index, fit.divided, fit.state.iteration) == (1, 0, 2) and fit.state.parameters["offsets"].any()
    assert fit_surface_in_passes(views, fit, settings, SPHERE_RADIUS, lambda r: told.append((r.iteration, r.iterations)))
    assert (fit.index, fit.divided) == (2, 1) and told == [(5, 7), (6, 7), (7, 7)]
    assert fit_surface_in_passes(views, at_once, settings, SPHERE_RADIUS)
    for name, value in at_once.state.parameters.items():
        assert torch.equal(fit.state.parameters[name], value), name
    # Done, it is not done again.
    assert fit_surface_in_passes(views, fit, settings, SPHERE_RADIUS) and (fit.index, fit.divided) == (2, 1)


def test_a_displacement_goes_on_with_the_last_passes_weights_and_without_looking_for_light():
    settings = PassSettings(3, displacement_steps=5, light_before=(3,))
    last, displaced = settings_of_pass(settings, 2), settings_of_displacement(settings)
    assert last.looks_for_light and not displaced.looks_for_light
    assert displaced.displaces and displaced.iterations == 5 and displaced.fall_from == 0
    assert displaced.weight_smooth == displaced.weight_smooth_end == last.weight_smooth_end
    assert displaced.rates.offsets > 0 and displaced.rates.normals == 0
    without = replace(settings, displacement_steps=0)
    assert (settings.relief_index, without.relief_index) == (4, 3)
    # Each its own draws; where nothing is displaced those of before.
    assert [one.seed for one in (last, displaced, settings_of_relief(settings))] == [2, 3, 4]
    assert settings_of_relief(without).seed == 3
