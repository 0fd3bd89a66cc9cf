"""What a moving camera takes along: the kernel against its twin, rejection, convergence, and no trace of what was edited."""

import dataclasses
import math

import pytest
import torch

from drgs.reference import reproject as reference
from drgs.reference.denoise import reflectances
from drgs.render.film.resolve_frame import resolve_frame
from drgs.render.intersect.trace_rays import build_tracer
from drgs.render.progressive.frame_state import with_settings
from drgs.render.progressive.refine import refine_frame
from drgs.render.progressive.reproject import FADE_SAMPLES, MOST_SAMPLES, blend_history, remember, reproject
from drgs.render.progressive.spread_places import LEAST, ONE
from drgs.render.progressive.start_frame import start_frame
from drgs.render.records import DemodulatedLight, GBuffer, History, Radiance, RenderSettings, Reprojected
from drgs.render.render_frame import render_frame
from drgs.render.visible.trace_primary import trace_primary
from drgs.scene.camera import Camera, camera_from_opengl
from drgs.scene.environment import Environment
from drgs.scene.posed_scene import PosedScene
from tests.render.closed_form_scenes import front_camera, sphere_mesh, sunny_sky, two_spheres

SIZE = 32


def camera_at(degrees: float, size: int = SIZE, distance: float = 6.0) -> Camera:
    """On a circle around the z axis, looking at the origin."""
    a = math.radians(degrees)
    turn = torch.tensor([[math.cos(a), -math.sin(a), 0, 0], [math.sin(a), math.cos(a), 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])
    front = torch.tensor([[1.0, 0, 0, 0], [0, 0, -1.0, -distance], [0, 1.0, 0, 0], [0, 0, 0, 1.0]])
    return camera_from_opengl(turn @ front, front_camera(size).intrinsics, size, size)


def history_of(gbuffer: GBuffer, camera: Camera, samples: float) -> History:
    """A picture whose values are functions of the place on the surface."""
    size = gbuffer.coverage.shape
    light = DemodulatedLight(gbuffer.position_world * 0.2 + 0.5, gbuffer.normal_world * 0.3 + 0.5, torch.rand(*size, 2))
    return History(camera, gbuffer, light, torch.full((*size, 2), samples))


def light_moved_to(light: DemodulatedLight, device: str) -> DemodulatedLight:
    return DemodulatedLight(*(values.to(device) for values in vars(light).values()))


def moved_to(gbuffer: GBuffer, device: str) -> GBuffer:
    return GBuffer(**{f.name: getattr(gbuffer, f.name).to(device) for f in dataclasses.fields(gbuffer)})


def test_kernel_looks_history_up_as_the_reference_does(device: str) -> None:
    mesh, before, now = two_spheres(), camera_at(0, 20, 9.0), camera_at(8, 20, 9.0)
    old, new = trace_primary(mesh, before), trace_primary(mesh, now)
    history = history_of(old, before, 40.0)
    exact = reference.reproject(history, new, now)
    there = History(before, moved_to(old, device), light_moved_to(history.light, device), history.samples.to(device))
    ours = reproject(there, moved_to(new, device), now)
    for found, wanted in [(ours.samples, exact.samples), *zip(vars(ours.light).values(), vars(exact.light).values(), strict=True)]:
        close = (found.cpu().double() - wanted).abs().amax(-1) < 1e-3
        assert float(close.double().mean()) > 0.99  # a tap at a limit may fall to either side


def test_what_is_taken_along_belongs_to_the_same_place() -> None:
    mesh, before, now = sphere_mesh(4), camera_at(0), camera_at(12)
    old, new = trace_primary(mesh, before), trace_primary(mesh, now)
    found = reproject(history_of(old, before, 16.0), new, now)
    kept = found.samples[..., 0] > 0
    assert float(kept[new.coverage > 0].float().mean()) > 0.7
    error = (found.light.diffuse - (new.position_world * 0.2 + 0.5))[kept]
    footprint = 5.0 / float(now.intrinsics[0, 0])
    assert float(error.abs().mean()) < 0.2 * 0.25 * footprint and float(error.abs().max()) < 0.2 * 4 * footprint


def test_what_was_hidden_has_no_history() -> None:
    """Two balls in a row; from the side the far one appears."""
    mesh = two_spheres()
    before, now = camera_at(90, 40, 12.0), camera_at(60, 40, 12.0)
    old, new = trace_primary(mesh, before), trace_primary(mesh, now)
    found = reproject(history_of(old, before, 16.0), new, now)
    covered = torch.nonzero(new.coverage.reshape(-1) > 0).squeeze(-1)
    position, normal = (values.reshape(-1, 3)[covered] for values in (new.position_world, new.normal_world))
    to_old = torch.nn.functional.normalize(before.center_world - position, dim=-1)
    hidden = torch.zeros(40 * 40, dtype=torch.bool)
    hidden[covered] = build_tracer(mesh).occluded((position + 1e-3 * normal).contiguous(), to_old.contiguous())
    hidden = hidden.view(40, 40)
    assert int(hidden.sum()) > 10
    taken = found.samples[..., 0] > 0
    assert float(taken[hidden].float().mean()) < 0.05
    assert float((found.samples[..., 0] > 0)[(new.coverage > 0) & ~hidden].float().mean()) > 0.5


def test_history_is_worth_nothing_on_a_mirror_and_little_more_than_asked_anywhere() -> None:
    before, now = camera_at(0), camera_at(2)
    worth = {}
    for roughness in (0.05, 0.8):
        mesh = sphere_mesh(4, roughness=roughness)
        found = reproject(history_of(trace_primary(mesh, before), before, 1e4), trace_primary(mesh, now), now)
        kept = found.samples[..., 0] > 0
        assert float(found.samples.max()) <= MOST_SAMPLES
        worth[roughness] = float(found.samples[..., 1][kept].mean())
    assert worth[0.05] < 1e-3 * MOST_SAMPLES and worth[0.8] > 0.5 * MOST_SAMPLES


def radiance_like(gbuffer: GBuffer, value: float, variance: float) -> Radiance:
    vectors = [torch.full_like(gbuffer.albedo, value) for _ in range(2)]
    scalars = [torch.full_like(gbuffer.coverage, variance) for _ in range(2)]
    return Radiance(*vectors, scalars[0].clone(), torch.ones_like(scalars[0]), 8, *scalars)


def test_the_share_of_history_falls_to_nothing_as_samples_grow(device: str) -> None:
    camera = camera_at(0)
    gbuffer = moved_to(trace_primary(sphere_mesh(), camera), device)
    black = DemodulatedLight(*(torch.zeros(SIZE, SIZE, n, device=device) for n in (3, 3, 2)))
    history = History(camera, gbuffer, black, torch.full((SIZE, SIZE, 2), 64.0, device=device))
    found = reproject(history, gbuffer, camera)
    shares = []
    for samples in (8.0, 64.0, FADE_SAMPLES):
        mean = radiance_like(gbuffer, 1.0, 0.0)
        blend_history(mean, found, gbuffer, torch.full((SIZE, SIZE, 2), samples, device=device))
        shares.append(1 - float(mean.diffuse.min()))
    assert shares[0] > 0.8 and shares[0] > shares[1] > shares[2] == 0


def test_history_is_blended_by_its_worth_and_remembered_without_reflectance(device: str) -> None:
    camera = camera_at(0)
    gbuffer = moved_to(trace_primary(two_spheres(), camera), device)
    light = DemodulatedLight(*(torch.rand(SIZE, SIZE, n, device=device) for n in (3, 3, 2)))
    old = Reprojected(light, 64 * torch.rand(SIZE, SIZE, 2, device=device))
    mean, own = radiance_like(gbuffer, 0.7, 0.2), torch.tensor([40.0, 16.0], device=device).expand(SIZE, SIZE, 2).contiguous()
    blend_history(mean, old, gbuffer, own)
    share = old.samples * (1 - own / FADE_SAMPLES)
    share = share / (share + own)
    kept = remember(mean, gbuffer, camera, own, old)
    parts = ((mean.diffuse, mean.diffuse_variance), (mean.specular, mean.specular_variance))
    for k, ((color, variance), before, factor) in enumerate(
        zip(parts, (light.diffuse, light.specular), reflectances(gbuffer), strict=True)
    ):
        w, square = share[..., k], factor.square().mean(-1)
        torch.testing.assert_close(color, torch.lerp(torch.full_like(color, 0.7), before * factor, w[..., None]))
        assert variance is not None
        torch.testing.assert_close(variance, (1 - w).square() * 0.2 + w.square() * light.variance[..., k] * square)
        torch.testing.assert_close((kept.light.diffuse, kept.light.specular)[k], color / factor)
        torch.testing.assert_close(kept.light.variance[..., k], variance / square)
    torch.testing.assert_close(kept.samples, own + old.samples * (1 - own / FADE_SAMPLES))


SCENE = PosedScene(None, sphere_mesh(4, roughness=0.6), sunny_sky(sun=20.0))
SETTINGS = RenderSettings(samples_per_pass=8, bounces=0, denoise="svgf")


def test_a_moving_camera_sees_less_noise_than_single_frames() -> None:
    state = refine_frame(start_frame(SCENE, camera_at(0), SETTINGS), 2)
    for step in range(1, 5):
        state = refine_frame(start_frame(SCENE, camera_at(1.5 * step), dataclasses.replace(SETTINGS, seed=0), previous=state), 2)
    alone = refine_frame(start_frame(SCENE, camera_at(6), SETTINGS), 2)
    exact = render_frame(SCENE, camera_at(6), RenderSettings(samples_per_pixel=2048, bounces=0, seed=5))
    inside = exact.gbuffer.coverage == 1
    errors = []
    for frame in (state, alone):
        shown = resolve_frame(with_settings(frame, denoise="none"))
        errors.append(float((shown.radiance_linear - exact.radiance_linear)[inside].square().mean()))
    assert state.reprojected is not None and errors[0] < 0.6 * errors[1]


def test_a_frame_left_alone_converges_to_the_mean_without_history() -> None:
    state = refine_frame(start_frame(SCENE, camera_at(0), SETTINGS), 2)
    passes = int(FADE_SAMPLES) // 8 * ONE // LEAST  # until the pixels that are looked at least have as many
    moved = refine_frame(start_frame(SCENE, camera_at(10), SETTINGS, previous=state), passes)
    alone = refine_frame(start_frame(SCENE, camera_at(10), SETTINGS), passes)
    assert moved.reprojected is not None
    assert torch.equal(resolve_frame(moved).radiance_linear, resolve_frame(alone).radiance_linear)


@pytest.mark.parametrize("edit", ["environment", "rotation", "material"])
def test_nothing_of_the_old_light_or_material_is_left_one_frame_after_an_edit(edit: str) -> None:
    state = refine_frame(start_frame(SCENE, camera_at(0), SETTINGS), 2)
    state = refine_frame(start_frame(SCENE, camera_at(2), SETTINGS, previous=state))
    scene = {
        "environment": dataclasses.replace(SCENE, environment=Environment(SCENE.environment.radiance.flip(1))),
        "rotation": dataclasses.replace(SCENE, environment_rotation_degrees=120.0),
        "material": dataclasses.replace(SCENE, mesh=dataclasses.replace(SCENE.mesh, albedo=0.2 * SCENE.mesh.albedo)),
    }[edit]
    after = refine_frame(start_frame(scene, camera_at(2), SETTINGS, previous=state))
    fresh = refine_frame(start_frame(scene, camera_at(2), SETTINGS))
    assert after.history is None and after.reprojected is None
    torch.testing.assert_close(resolve_frame(after).radiance_linear, resolve_frame(fresh).radiance_linear, rtol=1e-4, atol=1e-5)


@pytest.mark.slow
def test_a_highlight_that_moves_with_the_camera_is_not_smeared() -> None:
    """A glossy ball under a sun: error of the frame after a move, near the highlight, against that of a frame alone."""
    glossy = PosedScene(None, sphere_mesh(4, roughness=0.25), sunny_sky(sun=200.0))
    state = refine_frame(start_frame(glossy, camera_at(0), SETTINGS), 8)
    state = refine_frame(start_frame(glossy, camera_at(4), SETTINGS, previous=state))
    alone = refine_frame(start_frame(glossy, camera_at(4), SETTINGS))
    exact = render_frame(glossy, camera_at(4), RenderSettings(samples_per_pixel=4096, bounces=0, seed=5)).radiance.specular.mean(-1)
    bright = exact > exact.flatten().quantile(0.97)
    plain = [resolve_frame(with_settings(s, denoise="none")) for s in (state, alone)]
    errors = [float((frame.radiance.specular.mean(-1) - exact)[bright].square().mean()) for frame in plain]
    assert errors[0] < 1.1 * errors[1]
