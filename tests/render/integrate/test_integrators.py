"""The integrators against closed forms, the float64 references, each other, and themselves under other strategies."""

import dataclasses
import math

import pytest
import torch

from drgs.maths.brdf import evaluate_brdf
from drgs.reference import shade as reference
from drgs.render.integrate.choose_integrator import choose_integrator
from drgs.render.integrate.environment_table import build_environment_table, environment_light
from drgs.render.integrate.fused_embree import FusedEmbreeIntegrator
from drgs.render.integrate.integrator import IntegratorSettings
from drgs.render.integrate.wavefront import WavefrontIntegrator
from drgs.render.intersect.ray_memory import RayMemory
from drgs.render.intersect.trace_rays import build_tracer
from drgs.render.intersect.tracer_embree import EmbreeTracer
from drgs.render.intersect.tracer_warp import WarpTracer
from drgs.render.records import RayStarts, SampleCounts, ShadedPoints, ShadingPoints
from drgs.scene.environment import Environment, direction_from_uv
from drgs.scene.mesh import TriangleMesh
from tests.render.closed_form_scenes import constant_sky, crumpled_mesh, on_device, points_seen_at, sphere_mesh, sunny_sky, two_spheres

FAR_AWAY = sphere_mesh(subdivisions=1, radius=1e-3)
"""A mesh that occludes nothing that matters."""
INTEGRATORS = pytest.mark.parametrize("integrator", [FusedEmbreeIntegrator, WavefrontIntegrator])
MAPS = ("diffuse", "specular", "variance", "visibility")


def shade_points(
    points: ShadingPoints,
    environment: Environment,
    counts: SampleCounts,
    mesh: TriangleMesh | None = None,
    bounces: int = 0,
    seed: int = 0,
    samples_round: int = 0,
    lift: float = 100.0,
    memory: RayMemory | None = None,
    integrator: type | None = None,
) -> ShadedPoints:
    light = environment_light(build_environment_table(environment))
    starts = RayStarts(points.position_world + lift * points.normal_world, points.normal_world)
    tracer = build_tracer(FAR_AWAY if mesh is None else mesh)
    chosen = choose_integrator(tracer) if integrator is None else integrator(tracer)
    return chosen.shade(points, starts, light, IntegratorSettings(counts, bounces, seed), samples_round, memory)


def points_on(mesh: TriangleMesh) -> ShadingPoints:
    """The vertices, seen from straight above."""
    pixel = torch.arange(len(mesh.vertices), device=mesh.vertices.device).int()
    return ShadingPoints(mesh.vertices, mesh.normals, mesh.normals, mesh.albedo, mesh.roughness, mesh.metallic, pixel)


def reflected_share(points: ShadingPoints) -> torch.Tensor:
    """(point,) specular albedo of points under a sky of 1, by quadrature in float64."""
    v = (torch.arange(512, dtype=torch.float64) + 0.5) / 512
    u = (torch.arange(1024, dtype=torch.float64) + 0.5) / 1024
    v, u = torch.meshgrid(v, u, indexing="ij")
    wi = direction_from_uv(torch.stack([u, v], -1)).reshape(-1, 3)
    solid_angle = (torch.sin(v * math.pi) * 2 * math.pi**2 / v.numel()).reshape(-1)
    shares = []
    for k in range(len(points.pixel)):
        n, wo = points.normal_world[k].double(), points.wo_world[k].double()
        one = torch.ones(len(wi), dtype=torch.float64)
        _, specular = evaluate_brdf(
            wi,
            wo.expand_as(wi),
            n.expand_as(wi),
            points.albedo[k].double().expand_as(wi),
            points.roughness[k] * one,
            points.metallic[k] * one,
        )
        shares.append((specular[:, 0] * (wi @ n).clamp(min=0) * solid_angle).sum())
    return torch.stack(shares)


@pytest.mark.slow
def test_furnace_returns_albedo_and_specular_share() -> None:
    points = points_seen_at([0.0, 45.0, 80.0], albedo=1.0, roughness=0.6)
    result = shade_points(points, constant_sky(), SampleCounts(2048, 1024, 1024))
    torch.testing.assert_close(result.diffuse, torch.ones_like(result.diffuse), atol=2e-3, rtol=0)
    torch.testing.assert_close(result.specular[:, 0].double(), reflected_share(points), atol=1e-3, rtol=5e-3)


@pytest.mark.parametrize("roughness", [0.0, 0.1, 0.3, 1.0])
def test_white_metal_furnace_never_gains_energy(roughness: float) -> None:
    points = points_seen_at([0.0, 40.0, 70.0, 85.0, 89.0], albedo=1.0, roughness=roughness, metallic=1.0)
    result = shade_points(points, constant_sky(), SampleCounts(256, 1024, 256))
    assert float(result.specular.max()) <= 1 + 1e-3
    if roughness <= 0.1:  # a mirror loses nothing
        assert float(result.specular[0].min()) > 0.99
    assert float(result.diffuse.max()) == 0.0


@pytest.mark.parametrize("alone", [SampleCounts(64, 0, 0), SampleCounts(0, 64, 0), SampleCounts(0, 0, 64)])
def test_each_strategy_alone_agrees_with_all_together(alone: SampleCounts) -> None:
    points = points_seen_at([50.0], roughness=0.7, metallic=1.0, copies=300)
    sky = sunny_sky(sun=4.0)
    single = shade_points(points, sky, alone).specular.mean(-1)
    together = shade_points(points, sky, SampleCounts(32, 16, 16), seed=1).specular.mean(-1)
    error = math.sqrt(float(single.var() + together.var()) / len(single))
    assert abs(float(single.mean() - together.mean())) < 4 * error + 1e-3 * float(together.mean())


def test_a_sun_of_one_texel_is_found_at_once() -> None:
    """Without environment sampling the spread over pixels is of the order of the mean; with it, far below."""
    points = points_seen_at([30.0], roughness=0.8, copies=200)
    result = shade_points(points, sunny_sky(sun=1e5), SampleCounts(16, 8, 8))
    luminance = (result.diffuse + result.specular).mean(-1)
    assert float(luminance.std() / luminance.mean()) < 0.4


def test_a_half_space_below_the_surface_is_dark() -> None:
    """A shading normal tilted 60 degrees off its triangle sees only the sky above the triangle."""
    points = points_seen_at([0.0], albedo=1.0, roughness=1.0, copies=50)
    n = points.normal_world
    across = torch.nn.functional.normalize(torch.linalg.cross(n, torch.tensor([1.0, 0.0, 0.0]).expand_as(n)), dim=-1)
    triangle = math.cos(math.pi / 3) * n + math.sin(math.pi / 3) * across
    light = environment_light(build_environment_table(constant_sky()))
    starts, integrator = RayStarts(points.position_world + 100 * n, triangle), choose_integrator(build_tracer(FAR_AWAY))
    result = integrator.shade(points, starts, light, IntegratorSettings(SampleCounts(64, 8, 8)))
    assert abs(float(result.diffuse.mean()) - 0.75) < 0.01  # (1 + cos 60) / 2


def test_convex_mesh_has_no_indirect_light(device: str) -> None:
    mesh = on_device(sphere_mesh(), device)
    points = points_on(mesh)
    sky = Environment(sunny_sky().radiance.to(device))
    direct, bounced = (shade_points(points, sky, SampleCounts(4, 2, 2), mesh, bounces, lift=1e-3) for bounces in (0, 1))
    torch.testing.assert_close(direct.diffuse, bounced.diffuse)
    torch.testing.assert_close(direct.specular, bounced.specular)


def test_one_bounce_off_a_sphere_returns_its_directional_albedo() -> None:
    """Under a sky of 1 a ray that meets a lone convex sphere brings back diffuse albedo + specular share there."""
    mesh = sphere_mesh(subdivisions=5, albedo=0.6, roughness=0.5)
    # A mirror below the sphere sends its narrow lobe up into the sphere at a known angle of incidence.
    down = torch.tensor([0.0, 0.0, 1.0])
    count = 400
    points = ShadingPoints(
        torch.tensor([0.5, 0.0, -3.0]).expand(count, 3).contiguous(), down.expand(count, 3).contiguous(), down.expand(count, 3).contiguous(),
        torch.ones(count, 3), torch.zeros(count), torch.ones(count), torch.arange(count).int(),
    )  # fmt: skip
    result = shade_points(points, constant_sky(), SampleCounts(0, 16, 0), mesh, bounces=1, lift=0.0)
    met = points_seen_at([30.0], albedo=0.6, roughness=0.5)  # sin(30 degrees) = 0.5
    expected = 0.6 + float(reflected_share(met))
    error = float(result.specular[:, 0].std()) / math.sqrt(count)
    assert error < 0.01
    assert abs(float(result.specular[:, 0].mean()) - expected) < 4 * error + 3e-3


def test_more_bounces_add_light_and_approach_the_furnace_from_below() -> None:
    mesh = two_spheres(albedo=1.0, roughness=1.0, metallic=1.0)
    facing = torch.nonzero((mesh.vertices[:, 0] < 0) & (mesh.vertices[:, 0] > -0.3)).squeeze(-1)
    points = ShadingPoints(
        mesh.vertices[facing], mesh.normals[facing], mesh.normals[facing], mesh.albedo[facing], mesh.roughness[facing],
        mesh.metallic[facing], facing.int(),
    )  # fmt: skip
    means = [
        float(shade_points(points, constant_sky(), SampleCounts(256, 64, 64), mesh, bounces, lift=1e-3).specular.mean())
        for bounces in (0, 1, 2, 6)
    ]
    assert means[0] + 0.02 < means[1] and means[1] + 0.002 < means[2] <= means[3] + 0.002
    assert means[3] < 1


@INTEGRATORS
def test_light_does_not_depend_on_batching_or_threads(integrator: type, monkeypatch: pytest.MonkeyPatch) -> None:
    mesh = two_spheres()
    whole = shade_points(points_on(mesh), sunny_sky(), SampleCounts(4, 2, 2), mesh, 2, lift=1e-3, integrator=integrator)
    monkeypatch.setattr("drgs.render.integrate.fused_embree.RAYS_A_SLICE", 600)
    monkeypatch.setattr("drgs.render.integrate.fused_embree.RAYS_A_CHUNK", 48)
    monkeypatch.setattr("drgs.render.integrate.wavefront.RAYS_A_BATCH", 600)
    monkeypatch.setenv("DRGS_THREADS", "1")
    pieces = shade_points(points_on(mesh), sunny_sky(), SampleCounts(4, 2, 2), mesh, 2, lift=1e-3, integrator=integrator)
    for name in MAPS:
        assert torch.equal(getattr(whole, name), getattr(pieces, name)), name


@INTEGRATORS
@pytest.mark.parametrize("bounces", [0, 1])
def test_remembered_rays_bring_what_they_brought(bounces: int, integrator: type) -> None:
    mesh, counts, memory = two_spheres(), SampleCounts(7, 3, 5), RayMemory()

    def estimate() -> ShadedPoints:
        return shade_points(points_on(mesh), sunny_sky(), counts, mesh, bounces, lift=1e-3, memory=memory, integrator=integrator)

    first, again = estimate(), estimate()
    for name in MAPS:
        assert torch.equal(getattr(first, name), getattr(again, name)), name
    # The other way round: answers that are wrong are believed.
    assert memory.rays is not None
    memory.rays.hit.fill_(False)
    assert float(estimate().visibility.min()) == 1 > float(first.visibility.min())


@INTEGRATORS
@pytest.mark.parametrize("bounces", [0, 1])
def test_some_of_the_points_know_what_all_of_them_met(bounces: int, integrator: type) -> None:
    """In another order, of another roughness; and what is remembered stays."""
    mesh, memory = two_spheres(metallic=0.3), RayMemory()
    points, starts = points_on(mesh), RayStarts(mesh.vertices + 1e-3 * mesh.normals, mesh.normals)
    light, chosen = environment_light(build_environment_table(sunny_sky())), integrator(EmbreeTracer(mesh))
    how = IntegratorSettings(SampleCounts(3, 2, 2), bounces, 3, by_material=True)
    chosen.shade(points, starts, light, how, memory=memory)
    rays = memory.rays
    assert rays is not None
    rougher = dataclasses.replace(points, roughness=(points.roughness + 0.1).clamp(max=1))
    order = torch.randperm(len(mesh.vertices), generator=torch.Generator().manual_seed(1))[:200].int()
    alone, knowing = (chosen.shade(rougher, starts, light, how, memory=known, order=order) for known in (None, memory))
    for name in MAPS:
        assert torch.equal(getattr(alone, name), getattr(knowing, name)), name
    assert memory.rays is rays
    # The other way round: answers that are wrong are believed.
    rays.hit.fill_(False)
    believing = chosen.shade(points, starts, light, how, memory=memory, order=order)
    assert float(believing.visibility[order.long()].min()) == 1 > float(alone.visibility[order.long()].min())


@INTEGRATORS
def test_no_points_give_no_light(integrator: type) -> None:
    assert len(shade_points(points_seen_at([]), constant_sky(), SampleCounts(), integrator=integrator).diffuse) == 0


def test_the_tracer_decides_which_integrator_shades() -> None:
    assert isinstance(choose_integrator(EmbreeTracer(FAR_AWAY)), FusedEmbreeIntegrator)
    assert isinstance(choose_integrator(WarpTracer(FAR_AWAY)), WavefrontIntegrator)


# The float64 reference, and both integrators against each other, on the same random numbers.


def crumpled_scene() -> tuple[TriangleMesh, ShadingPoints, RayStarts]:
    """A ball with bumps and points on it of all materials, some seen at grazing angles or from behind, and some on no known face."""
    numbers = torch.Generator().manual_seed(4)
    mesh = crumpled_mesh()
    face = torch.randint(len(mesh.faces), (900,), generator=numbers)
    corners, weights = mesh.faces[face].long(), torch.distributions.Dirichlet(torch.ones(3)).sample((900,))

    def blend(values: torch.Tensor) -> torch.Tensor:
        return torch.einsum("pc,pc...->p...", weights, values[corners])

    normal = torch.nn.functional.normalize(blend(mesh.normals), dim=-1)
    a, b, c = mesh.vertices[corners].unbind(1)
    surface_normal = torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a), dim=-1)
    wo = torch.nn.functional.normalize(normal + 0.9 * torch.randn(900, 3, generator=numbers), dim=-1)
    position = blend(mesh.vertices)
    points = ShadingPoints(position, normal, wo, blend(mesh.albedo), blend(mesh.roughness), blend(mesh.metallic), torch.arange(900).int())
    known = torch.where(torch.arange(900) % 5 > 0, face, -1).int()
    return mesh, points, RayStarts(position + 1e-4 * surface_normal, surface_normal, known)


def relative_error(found: torch.Tensor, truth: torch.Tensor) -> torch.Tensor:
    found, truth = found.cpu().double(), truth.cpu().double()
    return (found - truth).abs() / (truth.abs() + 1e-3 * truth.abs().mean() + 1e-6)


@pytest.mark.parametrize(
    ("integrator", "tracer_class"),
    [(FusedEmbreeIntegrator, EmbreeTracer), (WavefrontIntegrator, EmbreeTracer), (WavefrontIntegrator, WarpTracer)],
)
@pytest.mark.parametrize("by_material", [False, True])
@pytest.mark.parametrize("bounces", [0, 1, 3])
def test_an_integrator_shades_as_the_reference_does(
    integrator: type, tracer_class: type, bounces: int, by_material: bool, device: str
) -> None:
    if tracer_class is EmbreeTracer and device != "cpu":
        pytest.skip("Embree traces on the CPU")
    mesh, points, starts = crumpled_scene()
    sky, settings = sunny_sky(sun=20.0), IntegratorSettings(SampleCounts(7, 3, 5), bounces, 3, by_material)
    exact = Environment(sky.radiance.double())
    double = ShadingPoints(*(t.double() if t.is_floating_point() else t for t in vars(points).values()))
    diffuse, specular = reference.shade(double, starts, exact, build_environment_table(exact), EmbreeTracer(mesh), settings, 4)
    there = ShadingPoints(*(t.to(device) for t in vars(points).values()))
    starts_there = RayStarts(starts.origin_world.to(device), starts.surface_normal_world.to(device))
    light = environment_light(build_environment_table(Environment(sky.radiance.to(device))))
    result = integrator(tracer_class(on_device(mesh, device))).shade(there, starts_there, light, settings, 4)
    for found, truth in ((result.diffuse, diffuse), (result.specular, specular)):
        error = relative_error(found, truth)
        assert float(error.quantile(0.97)) < 5e-3  # a ray at a silhouette may fall to either side
        assert float(error.median()) < 1e-5
    assert float(diffuse.mean()) > 0.05 and float(specular.mean()) > 0.05


@pytest.mark.slow
@pytest.mark.parametrize("bounces", [0, 1, 2, 3])
@pytest.mark.parametrize("by_material", [False, True])
@pytest.mark.parametrize("sky", [constant_sky(), sunny_sky(sun=1e4), constant_sky(0.0)], ids=["even", "sunny", "black"])
def test_both_integrators_bring_the_same_light(bounces: int, by_material: bool, sky: Environment) -> None:
    """Under a sky that is turned and strong, with horizons that let some rays off, partial groups of sixteen included."""
    mesh, points, starts = crumpled_scene()
    horizon = 2 * torch.rand(len(mesh.faces), 8, generator=torch.Generator().manual_seed(1))
    light = environment_light(build_environment_table(sky), rotation_degrees=70.0, intensity=2.0)
    settings, tracer = IntegratorSettings(SampleCounts(7, 3, 5), bounces, 11, by_material), EmbreeTracer(mesh)
    memories = RayMemory(), RayMemory()
    fused, wavefront = (
        integrator(tracer).shade(points, starts, light, settings, 3, memory, horizon)
        for integrator, memory in zip((FusedEmbreeIntegrator, WavefrontIntegrator), memories, strict=True)
    )
    for name in MAPS:
        error = relative_error(getattr(fused, name), getattr(wavefront, name))
        assert float((error < 2e-3).float().mean()) > 0.99, name
        assert float(error.median()) < 1e-5, name
    a, b = (memory.rays for memory in memories)
    assert a is not None and b is not None
    traced = ~torch.isnan(a.direction_world[:, 0])
    assert float((traced == ~torch.isnan(b.direction_world[:, 0])).float().mean()) > 0.998
    if bounces > 0 or float(sky.radiance.max()) > 0:
        assert 0.1 < float(traced.float().mean()) < 0.9  # the others lie above a horizon, or below the surface
        both = traced & ~torch.isnan(b.direction_world[:, 0])
        assert float((a.direction_world - b.direction_world)[both].norm(dim=-1).quantile(0.99)) < 1e-4
        assert float((a.hit == b.hit)[both].float().mean()) > 0.998
    else:
        assert not bool(traced.any())


@INTEGRATORS
def test_some_of_the_points_get_what_they_get_among_all_and_the_others_keep_theirs(integrator: type, device: str) -> None:
    mesh = on_device(two_spheres(metallic=0.3), device)
    points, starts = points_on(mesh), RayStarts(mesh.vertices + 1e-3 * mesh.normals, mesh.normals)
    light = environment_light(build_environment_table(Environment(sunny_sky(sun=20.0).radiance.to(device))))
    if device != "cpu" and integrator is FusedEmbreeIntegrator:
        integrator = WavefrontIntegrator  # Embree's is the CPU's
    chosen, how = integrator(build_tracer(mesh)), IntegratorSettings(SampleCounts(3, 2, 2), 1, 3, by_material=True)
    whole = chosen.shade(points, starts, light, how)
    order = torch.randperm(len(mesh.vertices), generator=torch.Generator().manual_seed(1))[:200].int().to(device)
    other = torch.ones(len(mesh.vertices), dtype=torch.bool, device=device)
    other[order.long()] = False
    some = chosen.shade(points, starts, light, how, order=order)
    before = ShadedPoints(*(torch.full_like(getattr(whole, name), 7.0) for name in MAPS))
    onto = chosen.shade(points, starts, light, how, order=order, onto=before)
    assert onto is before
    for name in MAPS:
        wanted = getattr(whole, name)
        assert torch.equal(getattr(some, name)[~other], wanted[~other]) and not bool(getattr(some, name)[other].any())
        assert torch.equal(getattr(onto, name)[~other], wanted[~other]) and bool((getattr(onto, name)[other] == 7).all())


@INTEGRATORS
@pytest.mark.parametrize("bounces", [0, 1, 3])
def test_the_light_of_other_surfaces_is_what_bounces_add(integrator: type, bounces: int) -> None:
    mesh = two_spheres(metallic=0.3)
    points, starts = points_on(mesh), RayStarts(mesh.vertices + 1e-3 * mesh.normals, mesh.normals)
    light, tracer = environment_light(build_environment_table(sunny_sky(sun=20.0))), EmbreeTracer(mesh)
    split, plain, direct = (
        integrator(tracer).shade(points, starts, light, IntegratorSettings(SampleCounts(7, 3, 5), count, 3, split_indirect=asked))
        for count, asked in ((bounces, True), (bounces, False), (0, False))
    )
    assert plain.indirect is None and all(torch.equal(getattr(split, name), getattr(plain, name)) for name in MAPS)
    added = split.diffuse + split.specular - direct.diffuse - direct.specular
    torch.testing.assert_close(split.indirect, added, rtol=1e-4, atol=1e-5 * float(split.diffuse.max()))
    added = split.diffuse - direct.diffuse
    torch.testing.assert_close(split.indirect_diffuse, added, rtol=1e-4, atol=1e-5 * float(split.diffuse.max()))
    assert float(split.indirect.mean()) > 0.01 * float(split.diffuse.mean()) if bounces else not bool(split.indirect.any())
