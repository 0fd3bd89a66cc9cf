"""Samples that choose among candidates: the same light in the mean, less noise, and nothing that depends on how the work is cut up."""

import math
from dataclasses import replace

import pytest
import torch
import warp as wp

from drgs.reference import environment_pool as twin
from drgs.reference import shade as reference
from drgs.render.integrate import environment_pool
from drgs.render.integrate.environment_pool import BLOCKS, CANDIDATES, NUMBERS, POOL, candidate_pools, draw_ahead
from drgs.render.integrate.environment_table import build_environment_table, environment_light
from drgs.render.integrate.fused_embree import FusedEmbreeIntegrator
from drgs.render.integrate.integrator import IntegratorSettings
from drgs.render.integrate.wavefront import WavefrontIntegrator
from drgs.render.intersect.tracer_embree import EmbreeTracer
from drgs.render.intersect.tracer_warp import WarpTracer
from drgs.render.progressive.frame_state import FrameState
from drgs.render.progressive.refine import refine_frame
from drgs.render.progressive.start_frame import start_frame
from drgs.render.records import RayStarts, RenderSettings, SampleCounts, ShadedPoints, ShadingPoints
from drgs.scene.environment import Environment
from drgs.scene.mesh import TriangleMesh
from drgs.scene.posed_scene import PosedScene
from tests.render.closed_form_scenes import constant_sky, crumpled_mesh, front_camera, on_device, sphere_mesh, sunny_sky, two_spheres

INTEGRATORS = pytest.mark.parametrize("integrator", [FusedEmbreeIntegrator, WavefrontIntegrator])
MAPS = ("diffuse", "specular", "variance", "visibility")
COUNTS = SampleCounts(4, 4, 8)


def half_black_sky() -> Environment:
    """A lamp of one texel in a dim half, the other half black."""
    radiance = torch.full((16, 32, 3), 0.05)
    radiance[:, 16:] = 0
    radiance[3, 5] = torch.tensor([300.0, 200.0, 100.0])
    return Environment(radiance)


def lamps() -> Environment:
    """Few, small and bright, on a dim sky, all round."""
    radiance = torch.full((32, 64, 3), 0.02)
    radiance[4::6, 3::9] = 50.0
    return Environment(radiance)


def points_on(mesh: TriangleMesh, slant: float = 0.5) -> tuple[ShadingPoints, RayStarts]:
    """The vertices, seen `slant` off their normals, and where their rays start."""
    numbers = torch.Generator().manual_seed(2)
    wo = torch.nn.functional.normalize(mesh.normals + slant * torch.randn(mesh.normals.shape, generator=numbers), dim=-1)
    points = ShadingPoints(
        mesh.vertices, mesh.normals, wo, mesh.albedo, mesh.roughness, mesh.metallic, torch.arange(len(mesh.vertices)).int()
    )
    return points, RayStarts(mesh.vertices + 1e-3 * mesh.normals, mesh.normals)


def shade(
    mesh: TriangleMesh, sky: Environment, settings: IntegratorSettings, integrator: type = FusedEmbreeIntegrator, samples_round: int = 0
) -> ShadedPoints:
    points, starts = points_on(mesh)
    light = environment_light(build_environment_table(sky), rotation_degrees=70.0, intensity=2.0)
    return integrator(EmbreeTracer(mesh)).shade(points, starts, light, settings, samples_round)


def relative_error(found: torch.Tensor, truth: torch.Tensor) -> torch.Tensor:
    found, truth = found.cpu().double(), truth.cpu().double()
    return (found - truth).abs() / (truth.abs() + 1e-3 * truth.abs().mean() + 1e-6)


def rough_metal_and_paint() -> TriangleMesh:
    """Two balls that see each other; their vertices are metal and paint of all roughness in turn."""
    mesh, numbers = two_spheres(), torch.Generator().manual_seed(3)
    count = len(mesh.vertices)
    metallic, roughness = torch.rand(count, generator=numbers).round(), 0.1 + 0.8 * torch.rand(count, generator=numbers)
    return replace(mesh, metallic=metallic, roughness=roughness)


# ---- the pool -------------------------------------------------------------------------------------------------------------


def test_the_pool_is_its_twins_and_follows_the_tables_density(device: str) -> None:
    sky = sunny_sky(sun=20.0)
    exact = Environment(sky.radiance.double())
    light = environment_light(build_environment_table(Environment(sky.radiance.to(device))))
    pools = candidate_pools(light, CANDIDATES, 7, 4, 5, torch.device(device))
    numbers = torch.as_tensor(pools.numbers.numpy()).view(2, 2, BLOCKS, NUMBERS, CANDIDATES)
    for round_, pool in ((4, 0), (5, 1)):
        found, truth = numbers[round_ - 4, pool], twin.draw_pool(exact, build_environment_table(exact), 7, round_, pool)
        torch.testing.assert_close(found[:, :3].transpose(1, 2).double(), truth.direction, atol=1e-4, rtol=0)
        assert float(relative_error(found[:, 6], truth.density).quantile(0.99)) < 1e-2
        assert float(relative_error(found[:, 7], truth.floor).quantile(0.99)) < 1e-3
    # The mean of f / density is the integral of f: of each channel, by a midpoint rule over the texels' own bilinear patches.
    radiance, density = numbers[0, 0, :, 3:6], numbers[0, 0, :, 6]
    finer = torch.nn.functional.interpolate(
        torch.cat([sky.radiance[:, -1:], sky.radiance, sky.radiance[:, :1]], 1).permute(2, 0, 1)[None].double(),
        scale_factor=16, mode="bilinear",
    )[0, :, :, 16:-16]  # fmt: skip
    polar = (torch.arange(finer.shape[1], dtype=torch.float64) + 0.5) * math.pi / finer.shape[1]
    integral = (finer * torch.sin(polar)[:, None]).mean((1, 2)) * 2 * math.pi**2
    torch.testing.assert_close((radiance / density[:, None]).double().mean((0, 2)), integral, rtol=0.02, atol=0)


def test_pools_drawn_ahead_are_those_that_would_be_drawn_when_asked_for() -> None:
    ahead, asked = (environment_light(build_environment_table(half_black_sky())) for _ in range(2))
    draw_ahead(ahead, 7, 3, 9, torch.device("cpu"))
    drawn = environment_pool._kept[ahead][7, 5]
    found, truth = (wp.to_torch(candidate_pools(light, CANDIDATES, 7, 3, 8, torch.device("cpu")).numbers) for light in (ahead, asked))
    assert torch.equal(found, truth)
    draw_ahead(ahead, 7, 4, 12, torch.device("cpu"))
    assert environment_pool._kept[ahead][7, 5] is drawn, "what is there is not drawn again"


def test_pools_of_rounds_and_purposes_differ_and_are_kept_within_a_bound(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(environment_pool, "ROUNDS_KEPT", 3)
    light = environment_light(build_environment_table(sunny_sky()))

    def numbers(first: int, last: int) -> torch.Tensor:
        pools = candidate_pools(light, CANDIDATES, 7, first, last, torch.device("cpu"))
        return torch.as_tensor(pools.numbers.numpy()).view(-1, NUMBERS, CANDIDATES)[:, :3].reshape(last - first + 1, 2, 3 * POOL).clone()

    both = numbers(0, 1).view(4, -1)
    assert all(float((a - b).abs().mean()) > 0.01 for k, a in enumerate(both) for b in both[:k])
    assert torch.equal(numbers(0, 5)[:2].view(4, -1), both)
    assert len(environment_pool._kept[light]) == 3


def test_another_number_of_candidates_is_refused() -> None:
    with pytest.raises(ValueError, match=r"3 candidates .* expected 1 or 16"):
        shade(sphere_mesh(1), constant_sky(), IntegratorSettings(COUNTS, candidates=3))


# ---- the light ------------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("by_material", [False, True])
@pytest.mark.parametrize("bounces", [0, 1, 3])
def test_choosing_integrators_shade_as_the_reference_does(bounces: int, by_material: bool, device: str) -> None:
    mesh, sky = rough_metal_and_paint(), sunny_sky(sun=20.0)
    points, starts = points_on(mesh)
    settings, exact = IntegratorSettings(COUNTS, bounces, 3, by_material, candidates=CANDIDATES), Environment(sky.radiance.double())
    double = ShadingPoints(*(t.double() if t.is_floating_point() else t for t in vars(points).values()))
    diffuse, specular = reference.shade(double, starts, exact, build_environment_table(exact), EmbreeTracer(mesh), settings, 4)
    there = ShadingPoints(*(t.to(device) for t in vars(points).values()))
    starts_there = RayStarts(starts.origin_world.to(device), starts.surface_normal_world.to(device))
    light = environment_light(build_environment_table(Environment(sky.radiance.to(device))))
    for integrator, tracer_class in (
        (FusedEmbreeIntegrator, EmbreeTracer),
        (WavefrontIntegrator, EmbreeTracer),
        (WavefrontIntegrator, WarpTracer),
    ):
        if tracer_class is EmbreeTracer and device != "cpu":
            continue  # Embree traces on the CPU
        result = integrator(tracer_class(on_device(mesh, device))).shade(there, starts_there, light, settings, 4)
        for found, truth in ((result.diffuse, diffuse), (result.specular, specular)):
            error = relative_error(found, truth)
            assert float(error.quantile(0.97)) < 5e-3  # a ray at a silhouette may fall to either side
            assert float(error.median()) < 1e-5
    assert float(diffuse.mean()) > 0.01 and float(specular.mean()) > 0.01


@pytest.mark.parametrize("bounces", [0, 3])
@pytest.mark.parametrize("sky", [lamps(), half_black_sky(), constant_sky(0.0)], ids=["lamps", "half black", "black"])
def test_both_integrators_choose_the_same(sky: Environment, bounces: int) -> None:
    settings = IntegratorSettings(SampleCounts(7, 3, 5), bounces, 11, True, candidates=CANDIDATES)
    fused, wavefront = (shade(crumpled_mesh(), sky, settings, integrator, 3) for integrator in (FusedEmbreeIntegrator, WavefrontIntegrator))
    for name in MAPS:
        error = relative_error(getattr(fused, name), getattr(wavefront, name))
        assert float((error < 2e-3).float().mean()) > 0.99, name
        assert float(error.median()) < 1e-5, name


@pytest.mark.slow
@INTEGRATORS
@pytest.mark.parametrize(
    ("counts", "bounces"), [(COUNTS, 0), (COUNTS, 3), (SampleCounts(0, 0, 16), 0)], ids=["direct", "bounces", "environment alone"]
)
@pytest.mark.parametrize("sky", [lamps(), half_black_sky()], ids=["lamps", "half black"])
def test_choosing_keeps_the_mean(sky: Environment, counts: SampleCounts, bounces: int, integrator: type) -> None:
    """Where occluders stand and light goes from ball to ball, on metal and on paint, each by itself."""
    mesh = rough_metal_and_paint()
    points, _ = points_on(mesh)
    seen = (points.normal_world * points.wo_world).sum(-1) > 0
    sums: dict[int, list[torch.Tensor]] = {1: [], CANDIDATES: []}
    for candidates, of_kind in sums.items():
        for seed in range(24):
            light = shade(mesh, sky, IntegratorSettings(counts, bounces, seed, candidates=candidates), integrator)
            both = torch.stack([light.diffuse, light.specular], -1).double().mean(1)
            of_kind.append(torch.stack([both[seen & (mesh.metallic == metal)].mean(0) for metal in (0.0, 1.0)]).view(-1))
    one, many = (torch.stack(of_kind) for of_kind in sums.values())
    error = torch.sqrt((one.var(0) + many.var(0)) / len(one))
    assert bool((error < 0.15 * one.mean(0) + 1e-9).all())  # of most, a hundredth
    assert bool(((many.mean(0) - one.mean(0)).abs() <= 4 * error + 1e-9).all())


@INTEGRATORS
def test_choosing_lowers_the_scatter_on_metal_under_small_lamps(integrator: type) -> None:
    mesh = replace(two_spheres(metallic=1.0), roughness=torch.full((len(two_spheres().vertices),), 0.35))

    def scatter(candidates: int) -> torch.Tensor:
        seeds = [shade(mesh, lamps(), IntegratorSettings(COUNTS, 2, seed, candidates=candidates), integrator) for seed in range(8)]
        return torch.stack([light.specular.double().mean(-1) for light in seeds]).var(0).mean()

    assert float(scatter(CANDIDATES)) < 0.5 * float(scatter(1))


@INTEGRATORS
def test_one_candidate_is_the_estimate_without_pools(integrator: type, monkeypatch: pytest.MonkeyPatch) -> None:
    """No pool is read, and no weight is touched: bits are those of settings that know no candidates."""
    mesh, settings = rough_metal_and_paint(), IntegratorSettings(COUNTS, 2, 5, True)
    plain = shade(mesh, lamps(), settings, integrator)
    monkeypatch.setattr(environment_pool, "_pools_of_round", None)
    again = shade(mesh, lamps(), replace(settings, candidates=1), integrator)
    chosen = [getattr(plain, name) for name in MAPS]
    assert all(torch.equal(a, getattr(again, name)) for a, name in zip(chosen, MAPS, strict=True))


@INTEGRATORS
def test_what_is_chosen_does_not_depend_on_batching_threads_or_rounds_together(integrator: type, monkeypatch: pytest.MonkeyPatch) -> None:
    mesh, settings = rough_metal_and_paint(), IntegratorSettings(SampleCounts(4, 2, 3), 2, 5, True, candidates=CANDIDATES)
    points, starts = points_on(mesh)
    light = environment_light(build_environment_table(lamps()))
    rounds = (torch.arange(len(points.pixel)) % 3 + 2).int()
    whole = integrator(EmbreeTracer(mesh)).shade(points, starts, light, settings, rounds)
    monkeypatch.setattr("drgs.render.integrate.fused_embree.RAYS_A_SLICE", 600)
    monkeypatch.setattr("drgs.render.integrate.fused_embree.RAYS_A_CHUNK", 48)
    monkeypatch.setattr("drgs.render.integrate.wavefront.RAYS_A_BATCH", 600)
    monkeypatch.setenv("DRGS_THREADS", "1")
    for round_ in (2, 3, 4):
        alone = integrator(EmbreeTracer(mesh)).shade(points, starts, light, settings, round_)
        for name in MAPS:
            assert torch.equal(getattr(whole, name)[rounds == round_], getattr(alone, name)[rounds == round_]), name


# ---- frames ---------------------------------------------------------------------------------------------------------------


def metal_under_lamps(seed: int = 0, samples: int = 64) -> FrameState:
    mesh = sphere_mesh(3, roughness=0.3, metallic=1.0)
    return start_frame(PosedScene(None, mesh, lamps()), front_camera(24), RenderSettings(samples_per_pixel=samples, seed=seed))


def test_passes_together_are_those_one_by_one() -> None:
    """Slices that take several passes at once read the pools of all of them."""
    state = metal_under_lamps()
    assert state.plan.candidates == CANDIDATES
    together, apart = refine_frame(state, 24), state
    for _ in range(24):
        apart = refine_frame(apart)
    torch.testing.assert_close(together.sums.specular, apart.sums.specular)


@pytest.mark.slow
def test_the_variance_falls_with_the_number_of_passes() -> None:
    """As with fresh samples: pools that came back would stop it. The median over pixels, since a pixel's variance has a long tail."""

    def scatter(passes: int) -> float:
        states = (metal_under_lamps(seed) for seed in range(8))
        even = (replace(state, plan=replace(state.plan, spread_places=False)) for state in states)
        means = [refine_frame(state, passes).sums.specular / passes for state in even]
        return float(torch.stack(means).double().var(0).mean(-1).median())

    assert scatter(80) < 1.4 * scatter(4) / 20


def test_a_moved_camera_finds_the_pools_of_the_frame_before() -> None:
    state = refine_frame(metal_under_lamps())
    again = start_frame(state.inputs.scene, front_camera(24, distance=5.0), state.inputs.settings, previous=state)
    assert again.traced.environment_light is state.traced.environment_light
    bright = replace(state.inputs.scene, environment_intensity=2.0)
    assert start_frame(bright, front_camera(24), state.inputs.settings, previous=state).traced.environment_light.intensity == 2.0
