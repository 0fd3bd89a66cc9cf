"""The surface's fit on the painted sphere: it finds size and colours, repeats itself, and goes on where it stopped."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

import drgs.reconstruct.fit.surface.fit_surface as fit_surface_module
from drgs.reconstruct.capture.turning_light import with_light_of_camera
from drgs.reconstruct.checkpoints import fit_tensors, read_tensors, restore_fit, write_tensors
from drgs.reconstruct.fit.fit_loop import FitReport, FitState
from drgs.reconstruct.fit.surface.fit_surface import SurfaceRates, SurfaceSettings, fit_surface, start_surface
from drgs.reconstruct.fit.surface.moving_surface import MoveSettings, MovingSurface, mesh_from_surface_fit
from drgs.reconstruct.fit.surface.shade_surface import SOLID, SeenPlaces, seen_twice
from drgs.reconstruct.fit.view_targets import ViewTarget
from drgs.scene.views import Views
from tests.reconstruct.fit.painted_sphere import CENTER, grey_light, painted_views, placed_sphere
from tests.reconstruct.surfel_spheres import surfel_sphere
from tests.reconstruct.tiny_capture import SPHERE_RADIUS

SHRUNK = 0.93


@pytest.fixture(scope="module")
def views(tmp_path_factory: pytest.TempPathFactory) -> Views:
    return painted_views(tmp_path_factory.mktemp("capture"))


def short(**changes) -> SurfaceSettings:
    return SurfaceSettings(**{"rounds": 2, "steps_a_round": 3, "moves": MoveSettings(share_rays=4)} | changes)


def started(settings: SurfaceSettings) -> FitState:
    surfels = surfel_sphere(600, radius=SHRUNK * SPHERE_RADIUS, center=tuple(CENTER.tolist()))
    return start_surface(surfels, placed_sphere(SHRUNK), grey_light(), settings, SPHERE_RADIUS)


def fitted(
    views: Views, settings: SurfaceSettings, stop_at: int | None = None, state: FitState | None = None
) -> tuple[FitState, list[FitReport]]:
    state = state or started(settings)
    reports: list[FitReport] = []
    fit_surface(views, placed_sphere(SHRUNK), state, settings, reports.append, lambda: stop_at is not None and state.iteration >= stop_at)
    return state, reports


@pytest.mark.slow
def test_a_grey_sphere_that_is_too_small_takes_on_the_size_and_the_colours_of_its_photographs(views: Views):
    state, reports = fitted(views, short(rounds=3, steps_a_round=12))
    mesh = mesh_from_surface_fit(state, placed_sphere().faces)
    normal = (mesh.vertices - CENTER) / SPHERE_RADIUS
    assert abs(float(normal.norm(dim=1).mean()) - 1) < 0.01
    assert reports[-1].psnr > reports[0].psnr + 3.0
    assert float((mesh.normals * torch.nn.functional.normalize(normal, dim=-1)).sum(1).mean()) > 0.98
    for channel in range(3):
        assert float(torch.corrcoef(torch.stack([mesh.albedo[:, channel], normal[:, channel]]))[0, 1]) > 0.5


@pytest.mark.slow
def test_the_same_seed_gives_the_same_bits(views: Views):
    results = [fitted(views, short(seed=5))[0].parameters for _ in range(2)]
    other = fitted(views, short(seed=6))[0].parameters
    assert all(torch.equal(results[0][name], results[1][name]) for name in results[0])
    assert not torch.equal(results[0]["albedo_logits"], other["albedo_logits"])


DISPLACES = {"rounds": 1, "steps_a_round": 6, "settle_every": 3, "displaces": True, "rates": SurfaceRates(normals=0.0, offsets=0.02)}


@pytest.mark.slow
@pytest.mark.parametrize("turns", [False, True])
@pytest.mark.parametrize(("changes", "stop_at"), [({}, 2), ({}, 3), (DISPLACES, 2), (DISPLACES, 3)])
def test_a_fit_resumed_inside_a_round_or_between_two_ends_with_the_same_numbers(
    views: Views, tmp_path: Path, changes: dict, stop_at: int, turns: bool
):
    settings, seen = short(**changes), with_light_of_camera(views) if turns else views
    whole, _ = fitted(seen, settings)
    assert not torch.equal(whole.parameters["vertices"], placed_sphere(SHRUNK).vertices) and not whole.parameters["offsets"].any()
    stopped, _ = fitted(seen, settings, stop_at)
    assert stopped.iteration == stop_at
    assert bool(stopped.parameters["offsets"].any()) == (settings.displaces and stop_at % settings.settle_every > 0)
    write_tensors(tmp_path / "x", fit_tensors(stopped), {})
    resumed = started(settings)
    restore_fit(read_tensors(tmp_path / "x", torch.device("cpu"))[0], resumed)
    fitted(seen, settings, state=resumed)
    assert resumed.iteration == 6
    for name, value in whole.parameters.items():
        assert torch.equal(resumed.parameters[name], value), name


@pytest.mark.slow
def test_of_large_photographs_some_pixels_are_looked_at(views: Views):
    few = short(rounds=1, pixels_a_step=200)
    (some, reports), (same, _), (all_, _) = fitted(views, few), fitted(views, few), fitted(views, short(rounds=1))
    assert torch.equal(some.parameters["normals"], same.parameters["normals"])
    assert not torch.equal(some.parameters["normals"], all_.parameters["normals"])
    changed = (some.parameters["albedo_logits"] != started(few).parameters["albedo_logits"]).any(1)
    assert float(changed.float().mean()) > 0.05
    assert reports[-1].psnr > 5


@pytest.mark.parametrize("several", [1, 3])
def test_a_step_shares_its_pixels_among_several_photographs(views: Views, several: int, monkeypatch: pytest.MonkeyPatch) -> None:
    looked: list[tuple[int, int, int]] = []  # which photograph, pixels drawn, pixels it has

    def watched(target: ViewTarget, pixels: Tensor, *rest: Any) -> SeenPlaces:
        solid = (target.mask.flatten() > SOLID).nonzero().squeeze(1)
        assert len(pixels.unique()) == len(pixels) and torch.isin(pixels, solid).all()
        looked.append((id(target), len(pixels), len(solid)))
        return seen_twice(target, pixels, *rest)

    monkeypatch.setattr(fit_surface_module, "seen_twice", watched)
    fitted(views, short(rounds=1, steps_a_round=1, photographs_a_step=several))
    assert len({number for number, _, _ in looked}) == len(looked) == several
    assert all(drawn == -(-has // several) for _, drawn, has in looked)


def test_no_rounds_leave_the_mesh_as_it_was(views: Views):
    settings = short(rounds=0)
    state, reports = fitted(views, settings)
    assert reports == [] and torch.equal(mesh_from_surface_fit(state, placed_sphere().faces).vertices, placed_sphere(SHRUNK).vertices)


@pytest.mark.parametrize(("turns", "still", "expected"), [(False, False, [0]), (True, False, [2]), (True, True, [])])
def test_light_is_looked_for_by_paint_before_the_first_step_or_half_way_where_it_turns(
    views: Views, turns: bool, still: bool, expected: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = short(rounds=1, steps_a_round=4, looks_for_light=True, still=still)
    state, asked = started(settings), []
    monkeypatch.setattr(MovingSurface, "look_for_light", lambda surface, targets, moves: asked.append(state.iteration))
    fitted(with_light_of_camera(views) if turns else views, settings, state=state)
    assert asked == expected


def with_a_pattern(views: Views) -> Views:
    """The same pictures, whose colours say which way the sphere faces, with waves of paint instead: what is smooth says little of where it lies."""
    waves = (127.5 + 80 * torch.sin(6 * (image.float() / 127.5 - 1)) for image in views.images_srgb)
    return replace(views, images_srgb=tuple(image.round().to(torch.uint8) for image in waves))


@pytest.mark.slow
def test_a_dent_is_moved_back_by_what_pixels_show(views: Views):
    """Of paint that is known already, under even light, which shades nothing: what tells of the dent is where pixels see the paint's pattern."""
    views = with_a_pattern(views)
    rates = SurfaceRates(normals=0.0, albedo_logits=0.0, roughness_logits=0.0, metallic_logits=0.0, environment=0.0, offsets=0.1)
    settings = short(
        rounds=1, steps_a_round=60, settle_every=10, displaces=True, fall_from=0.0, rates=rates, weight_bend=0.003, weight_bend_end=0.003
    )
    sphere = placed_sphere()
    outward = (sphere.vertices - CENTER) / SPHERE_RADIUS
    dent = 0.08 * SPHERE_RADIUS * torch.exp(-8 * (1 - outward @ torch.tensor([0.8, 0.0, 0.6])))
    surfels = surfel_sphere(600, radius=SPHERE_RADIUS, center=tuple(CENTER.tolist()))
    painting = short(rounds=1, steps_a_round=40, still=True, rates=SurfaceRates(normals=0.0, albedo_logits=0.1))
    depths = []
    for share in (0.0, 1.0):
        state = start_surface(surfels, sphere, grey_light(), settings, SPHERE_RADIUS)
        fit_surface(views, sphere, state, painting)
        with torch.no_grad():
            state.parameters["vertices"] -= share * dent[:, None] * outward
        state.iteration = 0
        fit_surface(views, sphere, state, settings)
        assert not state.parameters["offsets"].any()
        depths.append(SPHERE_RADIUS - (state.parameters["vertices"] - CENTER).norm(dim=1))
    deep = dent > 0.5 * float(dent.max())
    assert float((depths[1] - depths[0])[deep].abs().mean()) < 0.3 * float(dent[deep].mean())
