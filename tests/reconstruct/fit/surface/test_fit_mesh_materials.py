"""Stage 2 on the mesh: a fit that finds colours, repeats itself and resumes."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from drgs.maths.color import linear_from_srgb
from drgs.reconstruct.capture.turning_light import with_light_of_camera
from drgs.reconstruct.checkpoints import fit_tensors, read_tensors, restore_fit, write_tensors
from drgs.reconstruct.fit.fit_loop import FitReport, FitState, StepLoss
from drgs.reconstruct.fit.light.environment_pyramid import environment_table
from drgs.reconstruct.fit.light.split_sum import filter_environment
from drgs.reconstruct.fit.surface import fit_mesh_materials as fit_mesh_materials_file
from drgs.reconstruct.fit.surface.fit_mesh_materials import (
    MeshMaterialSettings,
    fit_mesh_materials,
    start_mesh_materials,
)
from drgs.reconstruct.fit.surface.fit_surface import SurfaceRates, SurfaceSettings, start_surface
from drgs.reconstruct.fit.surface.moving_surface import MoveSettings, MovingSurface, mesh_from_surface_fit
from drgs.reconstruct.fit.surface.shade_surface import joined, packed_surface, seen_places
from drgs.reconstruct.fit.view_targets import whole_targets
from drgs.render.integrate.environment_table import build_environment_table
from drgs.render.records import SampleCounts
from drgs.scene.environment import Environment
from drgs.scene.ground import Ground
from drgs.scene.views import Views
from tests.reconstruct.fit.painted_sphere import CENTER, grey_light, painted_views, placed_sphere
from tests.reconstruct.surfel_spheres import surfel_sphere
from tests.reconstruct.tiny_capture import SPHERE_RADIUS


@pytest.fixture(scope="module")
def views(tmp_path_factory: pytest.TempPathFactory) -> Views:
    return painted_views(tmp_path_factory.mktemp("capture"))


def short(iterations: int, **changes) -> MeshMaterialSettings:
    return MeshMaterialSettings(iterations=iterations, points_a_step=128, samples=SampleCounts(4, 2, 2), **changes)


def started(settings: MeshMaterialSettings) -> FitState:
    surfels = surfel_sphere(600, radius=SPHERE_RADIUS, center=tuple(CENTER.tolist()))
    surface = start_surface(surfels, placed_sphere(), grey_light(), SurfaceSettings(), SPHERE_RADIUS)
    return start_mesh_materials(surface, settings, SPHERE_RADIUS)


def fitted(
    views: Views, settings: MeshMaterialSettings, stop_at: int | None = None, state: FitState | None = None
) -> tuple[FitState, list[FitReport]]:
    state = state or started(settings)
    reports: list[FitReport] = []
    stop = lambda: stop_at is not None and state.iteration >= stop_at  # noqa: E731
    fit_mesh_materials(views, placed_sphere().faces, state, settings, reports.append, stop)
    return state, reports


@pytest.mark.slow
def test_a_grey_sphere_takes_on_the_colours_of_its_photographs(views: Views):
    state, reports = fitted(views, short(40, rounds=1))
    assert [r.iteration for r in reports] == list(range(1, 41))
    assert reports[-1].psnr > reports[0].psnr + 3.0
    mesh = mesh_from_surface_fit(state, placed_sphere().faces)
    assert torch.equal(mesh.vertices, placed_sphere().vertices)
    normal = (mesh.vertices - CENTER) / SPHERE_RADIUS
    for channel in range(3):  # the paint's red grows with the normal's x, and so on
        assert float(torch.corrcoef(torch.stack([mesh.albedo[:, channel], normal[:, channel]]))[0, 1]) > 0.5


def test_the_second_place_of_a_pixel_has_rays_of_its_own(views: Views) -> None:
    """Also where it is the very place of the first: with the same rays both estimates would share their noise, and crossed_halves would take it for error."""
    settings = short(1)
    state, targets = started(settings), whole_targets(views, torch.device("cpu"))
    surface = MovingSurface(views, placed_sphere().faces, state)
    tracer = surface.tracer.with_materials(mesh_from_surface_fit(state, placed_sphere().faces))
    lamp = torch.ones(128, 256, 3)
    lamp[20:50, 40:70] = 30.0
    around = fit_mesh_materials_file.Surroundings(
        tracer, surface.light_of(filter_environment(lamp))(targets[0]), build_environment_table(Environment(lamp))
    )
    seen = seen_places(targets[0], (targets[0].mask.flatten() > 0.995).nonzero().squeeze(1), tracer)
    packed = packed_surface(state.parameters).detach()

    def halves(draw: int) -> tuple[torch.Tensor, ...]:
        return fit_mesh_materials_file._radiance(joined([seen, seen]), packed, lamp, targets[0], around, settings, draw).chunk(2)

    draws = [torch.stack(halves(draw)).mean(-1) for draw in range(16)]
    noise = torch.stack(draws) - torch.stack(draws).mean(0)
    first, second = noise[:, 0].flatten(), noise[:, 1].flatten()
    assert float(first.std()) > 0.02
    assert abs(float(torch.corrcoef(torch.stack([first, second]))[0, 1])) < 0.1


@pytest.mark.slow
def test_between_rounds_the_surface_follows_and_keeps_its_outline(views: Views):
    once, twice = (fitted(views, short(4, rounds=rounds, moves=MoveSettings(share_rays=4)))[0].parameters for rounds in (1, 2))
    assert torch.equal(once["vertices"], placed_sphere().vertices)
    moved = (twice["vertices"] - once["vertices"]).norm(dim=-1)
    assert float(moved.max()) > 0.001 * SPHERE_RADIUS and float(moved.mean()) < 0.02 * SPHERE_RADIUS


def test_the_surface_is_at_home_where_its_fit_left_it():
    surfels = surfel_sphere(600, radius=SPHERE_RADIUS, center=tuple(CENTER.tolist()))
    surface = start_surface(surfels, placed_sphere(), grey_light(), SurfaceSettings(), SPHERE_RADIUS)
    surface.parameters["homeward"].fill_(0.5)
    assert not start_mesh_materials(surface, short(1), SPHERE_RADIUS).parameters["homeward"].any()
    assert float(surface.parameters["homeward"].min()) == 0.5


def test_the_rate_of_normals_falls_to_its_end(views: Views, monkeypatch: pytest.MonkeyPatch):
    settings = short(8, rates=SurfaceRates(normals=0.01), normals_end=0.0001, rounds=1)
    state, rates = started(settings), []
    step = state.optimizer.step

    def noted() -> None:
        rates.extend(group["lr"] for group in state.optimizer.param_groups if group["name"] == "normals")
        step()

    monkeypatch.setattr(state.optimizer, "step", noted)
    fitted(views, settings, state=state)
    assert rates[0] == pytest.approx(0.01) and rates == sorted(rates, reverse=True)
    assert rates[-1] == pytest.approx(0.0001 + 0.0099 * 0.5 * (1 + math.cos(math.pi * 7 / 8)))


@pytest.mark.parametrize("rings", [0, 1])
def test_normals_share_their_gradients_with_neighbours_that_face_the_same_way(views: Views, rings: int, monkeypatch: pytest.MonkeyPatch):
    settings = short(1, gradient_rings=rings)
    state, faces, seen = started(settings), placed_sphere().faces, {}

    def step() -> None:
        seen["gradient"] = state.parameters["normals"].grad

    def one_place(steps: object, iteration: int) -> StepLoss:
        return StepLoss({"traced": state.parameters["normals"][0].sum()}, views.cameras[0], 0.0)

    monkeypatch.setattr(fit_mesh_materials_file._Steps, "step", one_place)
    monkeypatch.setattr(state.optimizer, "step", step)
    fitted(views, settings, state=state)
    beside = faces[(faces == 0).any(1)].unique().long()
    others = torch.ones(len(seen["gradient"]), dtype=torch.bool).index_fill(0, beside, False)
    gradient = seen["gradient"][:, 0]
    assert not gradient[others].any()
    if rings:
        assert 0.1 < float(gradient[0]) < 0.3 and float(gradient[beside].min()) > 0.05
    else:
        assert float(gradient[0]) == 1 and float(gradient.sum()) == 1


@pytest.mark.slow
def test_the_same_seed_gives_the_same_bits(views: Views):
    results = [fitted(views, short(3, seed=5))[0].parameters for _ in range(2)]
    other = fitted(views, short(3, seed=6))[0].parameters
    assert all(torch.equal(results[0][name], results[1][name]) for name in results[0])
    assert not torch.equal(results[0]["albedo_logits"], other["albedo_logits"])


@pytest.mark.slow
def test_a_resumed_fit_ends_with_the_same_numbers(views: Views, tmp_path: Path):
    settings = short(7)
    whole, _ = fitted(views, settings)
    stopped, _ = fitted(views, settings, stop_at=4)
    assert stopped.iteration == 4
    write_tensors(tmp_path / "x", fit_tensors(stopped), {})
    resumed = started(settings)
    restore_fit(read_tensors(tmp_path / "x", torch.device("cpu"))[0], resumed)
    fitted(views, settings, state=resumed)
    assert resumed.iteration == 7
    for name, value in whole.parameters.items():
        assert torch.equal(resumed.parameters[name], value), name


@pytest.mark.parametrize("turns", [False, True])
def test_light_that_turns_is_looked_for_before_the_first_step(views: Views, turns: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    settings = short(2, times_light=3)
    state, asked = started(settings), []
    monkeypatch.setattr(MovingSurface, "look_for_light", lambda surface, targets, moves: asked.append(state.iteration))
    fitted(with_light_of_camera(views) if turns else views, settings, state=state)
    assert asked == ([0, 0, 0] if turns else [])


def test_light_for_pictures_without_the_ground_begins_as_the_ground_and_changes_nothing_else(views: Views, monkeypatch: pytest.MonkeyPatch):
    """A red ground below the ball; no photograph is asked, so that the light stays where it begins, and then some are."""
    low = float(CENTER[2]) - SPHERE_RADIUS - 0.05
    red = torch.tensor([0.9, 0.1, 0.1])[:, None, None].expand(3, 16, 16)
    ground = Ground(torch.tensor([0.0, 0.0, low]), torch.eye(3)[:2], 3.0, red, torch.ones(1, 16, 16))
    above, settings = replace(views, ground=ground), short(4)
    state = started(settings)
    before = {name: value.detach().clone() for name, value in state.parameters.items()}
    found = {}
    for steps in (0, 30):
        monkeypatch.setattr(fit_mesh_materials_file, "LIGHT_STEPS", steps)
        found[steps] = fit_mesh_materials_file.light_without_ground(above, placed_sphere().faces, state, CENTER, settings, SPHERE_RADIUS)
    assert all(torch.equal(value, before[name]) for name, value in state.parameters.items())
    down, up = found[0][-1, 0], found[0][0, 0]
    torch.testing.assert_close(down, linear_from_srgb(red[:, 0, 0]), rtol=1e-3, atol=1e-3)
    torch.testing.assert_close(up, environment_table(before)[0, 0], rtol=1e-4, atol=1e-4)
    assert not torch.allclose(found[30], found[0], rtol=0.01) and bool(torch.isfinite(found[30]).all())
