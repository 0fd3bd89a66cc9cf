"""The light-transport estimate against closed forms, its float64 twin, and itself under other strategies."""

import math

import pytest
import torch
import trimesh
import warp as wp

from drgs.maths.brdf import evaluate_brdf
from drgs.reference import shade as reference
from drgs.render.environment_table import build_environment_table, environment_light
from drgs.render.ray_memory import RayMemory
from drgs.render.records import ShadingPoints
from drgs.render.sample_rays import SampleCounts, point_arrays, sample_set
from drgs.render.shade import PointLight, RayStarts, shade, start_rays, start_rays_simd
from drgs.render.trace_indirect import mesh_arrays, scatter_hits, scatter_hits_simd
from drgs.render.trace_rays import build_tracer
from drgs.scene.environment import Environment, direction_from_uv
from drgs.scene.mesh import TriangleMesh
from drgs.warp_torch import warp_array
from tests.render.closed_form_scenes import constant_sky, mesh_of, on_device, points_seen_at, sphere_mesh, sunny_sky, two_spheres

FAR_AWAY = sphere_mesh(subdivisions=1, radius=1e-3)
"""A mesh that occludes nothing that matters."""


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
) -> PointLight:
    light = environment_light(build_environment_table(environment))
    starts = RayStarts(points.position_world + lift * points.normal_world, points.normal_world)
    tracer = build_tracer(FAR_AWAY if mesh is None else mesh)
    return shade(points, starts, light, tracer, counts, bounces, seed, samples_round, memory=memory)


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


def test_kernel_shades_as_the_reference_does(device: str) -> None:
    points = points_seen_at([10.0, 60.0, 80.0], roughness=0.4, metallic=0.3, copies=30)
    moved = ShadingPoints(
        points.position_world + torch.tensor([0.0, 0.0, -1.3]), points.normal_world, points.wo_world, points.albedo,
        points.roughness, points.metallic, points.pixel,
    )  # fmt: skip
    starts = RayStarts(moved.position_world, moved.normal_world)
    mesh, sky, counts = sphere_mesh(radius=0.5), sunny_sky(sun=20.0), SampleCounts(16, 8, 8)
    exact = Environment(sky.radiance.double())
    double = ShadingPoints(*(t.double() if t.is_floating_point() else t for t in vars(moved).values()))
    starts64 = RayStarts(starts.origin_world.double(), starts.surface_normal_world.double())
    diffuse, specular = reference.shade(double, starts64, exact, build_environment_table(exact), build_tracer(mesh), counts, 4)
    there = {k: v.to(device) for k, v in vars(moved).items()}
    sky_there = Environment(sky.radiance.to(device))
    result = shade(
        ShadingPoints(**there), RayStarts(there["position_world"], there["normal_world"]),
        environment_light(build_environment_table(sky_there)), build_tracer(on_device(mesh, device)), counts, 0, 4,
    )  # fmt: skip
    for ours, twin in ((result.diffuse, diffuse), (result.specular, specular)):
        difference = (ours.cpu().double() - twin).abs() / (twin.abs() + 1e-2)
        assert float(difference.quantile(0.97)) < 5e-3
        assert float(difference.mean()) < 2e-2  # a ray at a silhouette may fall to either side


def test_a_half_space_below_the_surface_is_dark() -> None:
    """A shading normal tilted 60 degrees off its triangle sees only the sky above the triangle."""
    points = points_seen_at([0.0], albedo=1.0, roughness=1.0, copies=50)
    n = points.normal_world
    across = torch.nn.functional.normalize(torch.linalg.cross(n, torch.tensor([1.0, 0.0, 0.0]).expand_as(n)), dim=-1)
    triangle = math.cos(math.pi / 3) * n + math.sin(math.pi / 3) * across
    sky = constant_sky()
    light = environment_light(build_environment_table(sky))
    result = shade(
        points, RayStarts(points.position_world + 100 * n, triangle), light, build_tracer(FAR_AWAY), SampleCounts(64, 8, 8), 0, 0
    )
    assert abs(float(result.diffuse.mean()) - 0.75) < 0.01  # (1 + cos 60) / 2


def test_convex_mesh_has_no_indirect_light(device: str) -> None:
    mesh = on_device(sphere_mesh(), device)
    points = ShadingPoints(
        mesh.vertices, mesh.normals, mesh.normals, mesh.albedo, mesh.roughness, mesh.metallic,
        torch.arange(len(mesh.vertices), device=device).int(),
    )  # fmt: skip
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


def test_light_does_not_depend_on_batching_or_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    mesh = two_spheres()
    points = ShadingPoints(
        mesh.vertices, mesh.normals, mesh.normals, mesh.albedo, mesh.roughness, mesh.metallic, torch.arange(len(mesh.vertices)).int()
    )
    whole = shade_points(points, sunny_sky(), SampleCounts(4, 2, 2), mesh, 2, lift=1e-3)
    monkeypatch.setattr("drgs.render.shade.RAYS_A_SLICE", 600)
    monkeypatch.setattr("drgs.render.shade_embree.RAYS_A_CHUNK", 48)
    monkeypatch.setenv("DRGS_THREADS", "1")
    pieces = shade_points(points, sunny_sky(), SampleCounts(4, 2, 2), mesh, 2, lift=1e-3)
    assert torch.equal(whole.diffuse, pieces.diffuse) and torch.equal(whole.specular, pieces.specular)


@pytest.mark.parametrize("bounces", [0, 1, 2])
def test_rays_asked_about_as_they_start_bring_the_light_of_rays_written_down(bounces: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Answers are the same but for rounding, here and there a ray's at an edge."""
    mesh, counts = two_spheres(), SampleCounts(7, 3, 5)
    points = ShadingPoints(
        mesh.vertices, mesh.normals, mesh.normals, mesh.albedo, mesh.roughness, mesh.metallic, torch.arange(len(mesh.vertices)).int()
    )
    at_once = shade_points(points, sunny_sky(), counts, mesh, bounces, lift=1e-3)
    monkeypatch.setattr("drgs.render.shade.EmbreeTracer", type("NoTracer", (), {}))
    written = shade_points(points, sunny_sky(), counts, mesh, bounces, lift=1e-3)
    assert float((at_once.visibility < 1).float().mean()) > 0.01
    for name in ("diffuse", "specular", "variance", "visibility"):
        a, b = getattr(at_once, name), getattr(written, name)
        error = (a - b).abs() / (b.abs() + 1e-3 * b.abs().mean() + 1e-6)
        assert float((error < 1e-4).float().mean()) > 0.998, name


@pytest.mark.parametrize("bounces", [0, 1])
@pytest.mark.parametrize("steps", ["in one kernel", "one after the other"])
def test_remembered_answers_are_the_answers(bounces: int, steps: str, monkeypatch: pytest.MonkeyPatch) -> None:
    mesh, counts = two_spheres(), SampleCounts(7, 3, 5)
    points = ShadingPoints(
        mesh.vertices, mesh.normals, mesh.normals, mesh.albedo, mesh.roughness, mesh.metallic, torch.arange(len(mesh.vertices)).int()
    )
    if steps == "one after the other":
        monkeypatch.setattr("drgs.render.shade.EmbreeTracer", type("NoTracer", (), {}))
    memory = RayMemory()
    first, again = (shade_points(points, sunny_sky(), counts, mesh, bounces, lift=1e-3, memory=memory) for _ in range(2))
    for name in ("diffuse", "specular", "variance", "visibility"):
        assert torch.equal(getattr(first, name), getattr(again, name)), name
    # The other way round: answers that are wrong are believed.
    assert memory.rays is not None
    memory.rays.hit.fill_(False)
    believed = shade_points(points, sunny_sky(), counts, mesh, bounces, lift=1e-3, memory=memory)
    assert float(believed.visibility.min()) == 1 > float(first.visibility.min())


def test_no_points_give_no_light() -> None:
    empty = points_seen_at([])
    assert len(shade_points(empty, constant_sky(), SampleCounts()).diffuse) == 0


@pytest.mark.parametrize("by_material", [False, True])
@pytest.mark.parametrize("sky", [constant_sky(), sunny_sky(sun=1e4), constant_sky(0.0)])
def test_sixteen_rays_at_once_are_the_rays_one_by_one(by_material: bool, sky: Environment) -> None:
    """The hand-vectorised CPU kernel against the plain one, last partial group, grazing and backward views included."""
    parts = [
        points_seen_at([0.0, 45.0, 89.5, 95.0], roughness=r, metallic=m, copies=13)
        for r, m in ((0.0, 1.0), (0.2, 0.5), (0.9, 0.0), (0.1, 1.0))
    ]
    points = ShadingPoints(*(torch.cat([getattr(p, name) for p in parts]) for name in vars(parts[0])))
    surface = torch.nn.functional.normalize(points.normal_world + 0.3 * torch.randn(points.normal_world.shape), dim=-1)
    counts, first = SampleCounts(7, 3, 5), 45
    rays = (len(points.pixel) - first // counts.total) * counts.total - 6
    light = environment_light(build_environment_table(sky), rotation_degrees=70.0, intensity=2.0)
    inputs = [
        first, point_arrays(points), warp_array(points.position_world, wp.vec3), warp_array(surface, wp.vec3),
        warp_array(torch.arange(len(surface)).int()), warp_array(2 * torch.rand(8 * len(surface))), light, sample_set(counts, 11, 3, by_material), 0,
    ]  # fmt: skip
    results = []
    for kernel, dim, extra in ((start_rays, rays, []), (start_rays_simd, -(-rays // 16), [rays])):
        out = (
            [torch.full((rays, 3), -7.0) for _ in range(2)] + [torch.full((rays,), -7.0)] + [torch.full((rays, 3), -7.0) for _ in range(2)]
        )
        outputs = [warp_array(t, wp.vec3 if t.dim() == 2 else None) for t in out]
        wp.launch(kernel, dim=dim, inputs=[*extra, *inputs], outputs=outputs, device="cpu")
        results.append(out)
    plain, vector = results
    live = (plain[2] > 0) & (vector[2] > 0)
    assert float(((plain[2] > 0) == (vector[2] > 0)).float().mean()) > 0.995
    if float(sky.radiance.max()) == 0:
        assert not bool(live.any())
        return
    # Rays above their point's horizon leave from outside, in both kernels but for those right at it.
    assert float((plain[0] == vector[0])[live].all(-1).float().mean()) > 0.995
    assert 0.1 < float((vector[0][live][:, 0].abs() > 1e14).float().mean()) < 0.9
    assert float((plain[1] - vector[1])[live].norm(dim=-1).quantile(0.99)) < 1e-4
    for a, b in zip(plain[2:], vector[2:], strict=True):
        error = (a - b)[live].abs() / (a[live].abs() + 1e-3 * a[live].abs().mean() + 1e-6)
        assert float(error.quantile(0.97)) < 5e-3


@pytest.mark.parametrize("depth", [0, 1])
@pytest.mark.parametrize("sky", [sunny_sky(sun=1e3), constant_sky(0.0)])
def test_sixteen_paths_at_once_are_the_paths_one_by_one(depth: int, sky: Environment) -> None:
    """Where paths go on from a hit: the hand-vectorised CPU kernel against the plain one, surfaces seen from behind included."""
    mesh = crumpled_mesh()
    paths = 16 * 40 - 5
    numbers = torch.Generator().manual_seed(4)
    face = torch.randint(len(mesh.faces), (paths,), generator=numbers, dtype=torch.int32)
    barycentric = torch.rand(paths, 2, generator=numbers) * 0.5
    normal = torch.nn.functional.normalize(mesh.vertices[mesh.faces[face.long()].long()].mean(1), dim=-1)
    arriving = torch.nn.functional.normalize(-normal + 1.2 * torch.randn(paths, 3, generator=numbers), dim=-1)
    throughput = torch.rand(paths, 3, generator=numbers)
    counts, points = SampleCounts(7, 3, 5), points_seen_at([0.0, 45.0], roughness=0.3, metallic=0.4, copies=40)
    path_ray = torch.sort(torch.randint((len(points.pixel) - 3) * counts.total, (paths,), generator=numbers)).values
    light = environment_light(build_environment_table(sky), rotation_degrees=70.0, intensity=2.0)
    inputs = [
        warp_array(path_ray), warp_array(face), warp_array(barycentric, wp.vec2), warp_array(arriving, wp.vec3),
        warp_array(throughput, wp.vec3), 3, depth, paths, point_arrays(points), light,
        mesh_arrays(mesh, 1e-4, 2 * torch.rand(len(mesh.faces), 8, generator=numbers)), sample_set(counts, 11, 3, True),
    ]  # fmt: skip
    results = []
    for kernel, dim in ((scatter_hits, paths), (scatter_hits_simd, -(-paths // 16))):
        out = [torch.full((count, 3), -7.0) for count in (2 * paths, 2 * paths, 2 * paths, paths)]
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=[warp_array(t, wp.vec3) for t in out], device="cpu")
        results.append(out)
    plain, vector = results
    same = (plain[1] - vector[1]).norm(dim=-1) < 1e-3
    assert float(same.float().mean()) > 0.99
    turned = same & ((plain[1] - 0.57735).abs().amax(-1) > 1e-3)
    assert 0.2 < float(turned.float().mean()) < 0.95
    outside = vector[0][turned][:, 0].abs() > 1e14
    assert 0.1 < float(outside.float().mean()) < 0.9
    assert float((outside == (plain[0][turned][:, 0].abs() > 1e14)).float().mean()) > 0.995
    near = plain[0][turned].abs().amax(-1) < 1e14
    assert float((plain[0] - vector[0])[turned][near & ~outside].abs().max()) < 1e-5
    for a, b, chosen in ((plain[2], vector[2], same), (plain[3], vector[3], same[paths:])):
        error = (a - b)[chosen].abs() / (a[chosen].abs() + 1e-3 * a[chosen].abs().mean() + 1e-6)
        assert float(error.quantile(0.97)) < 5e-3
    assert (float(plain[2].abs().max()) > 0) == (float(sky.radiance.max()) > 0)


def crumpled_mesh() -> TriangleMesh:
    """A ball with bumps, its materials all different."""
    shape = trimesh.creation.icosphere(2)
    numbers = torch.Generator().manual_seed(3)
    shape.vertices *= (1 + 0.2 * torch.rand(len(shape.vertices), 1, generator=numbers)).numpy()
    mesh = mesh_of(shape, 0.7, 0.5, 0.0)
    count = len(mesh.vertices)
    albedo, roughness, metallic = (
        torch.rand(count, 3, generator=numbers),
        torch.rand(count, generator=numbers),
        torch.rand(count, generator=numbers),
    )
    return TriangleMesh(mesh.vertices, mesh.faces, mesh.normals, albedo, roughness, metallic)
