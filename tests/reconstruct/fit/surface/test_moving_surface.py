"""Light on a surface that moved."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from drgs.reconstruct.capture.turning_light import with_light_of_camera
from drgs.reconstruct.fit.fit_loop import FitState
from drgs.reconstruct.fit.light.environment_pyramid import environment_table
from drgs.reconstruct.fit.light.mesh_light import MeshLight, irradiance_share
from drgs.reconstruct.fit.light.split_sum import filter_environment
from drgs.reconstruct.fit.light.turned_light import seen_sky
from drgs.reconstruct.fit.surface import moving_surface
from drgs.reconstruct.fit.surface.fit_surface import NOT_FITTED, SurfaceSettings
from drgs.reconstruct.fit.surface.moving_surface import MoveSettings, MovingSurface, mesh_from_surface_fit
from drgs.reconstruct.fit.surfel_parameters import leaves, light_parameters, logits_of_shares, make_optimizer
from drgs.reconstruct.fit.view_targets import view_targets
from drgs.render.intersect.trace_rays import build_tracer
from drgs.scene.environment import Environment
from tests.reconstruct.fit.painted_sphere import grey_light, painted_views
from tests.render.closed_form_scenes import sphere_mesh

RAYS = 16


def two_spheres() -> tuple[FitState, torch.Tensor]:
    """Grey, of radius 1, near one another."""
    one = sphere_mesh(subdivisions=3)
    count = 2 * len(one.vertices)
    vertices = torch.cat([one.vertices, one.vertices + torch.tensor([2.2, 0.0, 0.0])])
    values = {
        "normals": torch.cat([one.normals] * 2),
        "albedo_logits": logits_of_shares(torch.full((count, 3), 0.5)),
        "roughness_logits": logits_of_shares(torch.full((count,), 0.9)),
        "metallic_logits": logits_of_shares(torch.full((count,), 0.01)),
        "vertices": vertices,
        "homeward": torch.zeros(count, 3),
        "to_texture": torch.zeros(count, 3),
        "texture_weight": torch.zeros(count),
        "open_share": torch.ones(count, 3),
        "metal": torch.zeros(count),
    } | light_parameters(grey_light())
    parameters = leaves(values, frozen=NOT_FITTED)
    optimizer = make_optimizer(parameters, SurfaceSettings().rates, 1.0)
    return FitState(parameters, optimizer, torch.Generator().manual_seed(1)), torch.cat([one.faces, one.faces + len(one.vertices)])


@pytest.mark.slow
def test_shares_of_a_few_rays_are_as_good_as_those_of_many(tmp_path: Path) -> None:
    state, faces = two_spheres()
    radiance = environment_table(state.parameters).detach()
    tracer = build_tracer(mesh_from_surface_fit(state, faces))
    light = MeshLight(filter_environment(radiance), torch.ones_like(state.parameters["vertices"]))

    def shares(rays: int) -> torch.Tensor:
        return irradiance_share(tracer, Environment(radiance), light, rays, torch.Generator().manual_seed(2))

    right = shares(2048)
    MovingSurface(painted_views(tmp_path), faces, state).relight(RAYS)

    def error(found: torch.Tensor) -> float:
        return float((found - right).square().mean().sqrt())

    assert error(state.parameters["open_share"]) < 0.5 * error(shares(RAYS))
    assert error(state.parameters["open_share"]) < error(shares(4 * RAYS))


@pytest.mark.parametrize("relight", [True, False])
def test_a_surface_that_moved_is_lit_anew_where_it_is_shaded_next_and_met_where_it_is(relight: bool, tmp_path: Path):
    state, faces = two_spheres()
    state.parameters["vertices"].mul_(1.01)
    surface = MovingSurface(replace(painted_views(tmp_path, count=3), has_masks=False), faces, state)
    before = state.parameters["vertices"].clone()
    surface.move(MoveSettings(solves=1, share_rays=RAYS), relight)
    assert not torch.equal(state.parameters["vertices"], before)
    torch.testing.assert_close(surface.tracer.mesh.vertices, state.parameters["vertices"])
    assert bool((state.parameters["open_share"] != 1).any()) == relight


def test_what_is_seen_of_a_turning_sky_is_traced_once_for_a_place_and_anew_after_a_move(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    traced = []
    monkeypatch.setattr(moving_surface, "seen_sky", lambda *given: traced.append(seen_sky(*given)) or traced[-1])
    state, faces = two_spheres()
    views = with_light_of_camera(replace(painted_views(tmp_path, count=3), has_masks=False))
    target = view_targets(views, 1.0, torch.device("cpu"))[1]
    surface = MovingSurface(views, faces, state)

    def share(of: MovingSurface) -> torch.Tensor:
        return of.light_of(filter_environment(environment_table(state.parameters).detach()))(target).open_share

    assert not traced
    before = share(surface)
    assert torch.equal(share(MovingSurface(views, faces, state, surface)), before) and len(traced) == 1
    surface.move(MoveSettings(solves=1))
    after = share(surface)
    assert len(traced) == 2 and not torch.equal(before, after)
    assert torch.equal(after, share(MovingSurface(views, faces, state)))


@pytest.mark.slow
def test_paint_that_light_is_taken_from_sends_what_it_sent(tmp_path: Path) -> None:
    state, faces = two_spheres()
    parameters = state.parameters
    up = parameters["normals"][:, 2:]
    with torch.no_grad():
        parameters["albedo_logits"].copy_(logits_of_shares((0.4 + 0.2 * up).expand(-1, 3)))
        parameters["metal"][0] = 1.0
    views = painted_views(tmp_path)
    surface, target = MovingSurface(views, faces, state), view_targets(views, 1.0, torch.device("cpu"))[0]
    surface.relight(64)

    @torch.no_grad()
    def sent() -> torch.Tensor:
        light = MeshLight(filter_environment(environment_table(parameters)), parameters["open_share"])
        return (torch.sigmoid(parameters["albedo_logits"]) + MoveSettings().paint_light.gloss) * surface.irradiance(light)

    before, metal = sent(), parameters["albedo_logits"][0].detach().clone()
    surface.look_for_light([target], MoveSettings(share_rays=64))
    change = (sent() / before).log()[1:]
    assert float(change.abs().mean()) < 0.02
    albedo = torch.sigmoid(parameters["albedo_logits"].detach()).mean(1)
    assert float(albedo[up[:, 0] > 0.7].mean() / albedo[up[:, 0] < -0.7].mean()) < 0.5 * (0.57 / 0.23) + 0.5
    torch.testing.assert_close(parameters["albedo_logits"][0].detach(), metal)
