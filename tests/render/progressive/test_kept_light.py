"""Light kept on the mesh: what is kept is right, it is read where that is good enough, moving pictures are no worse, pictures at rest the same."""

import dataclasses
from collections.abc import Callable

import pytest
import torch
import trimesh

from drgs.maths.constants import F0
from drgs.reference import kept_light as reference
from drgs.reference.mesh_surface import mesh_in
from drgs.reference.path_integrator import LitMesh
from drgs.render.film.resolve_frame import resolve_frame
from drgs.render.integrate.choose_integrator import choose_integrator
from drgs.render.integrate.environment_table import build_environment_table, environment_light
from drgs.render.integrate.fused_embree import FusedEmbreeIntegrator
from drgs.render.integrate.integrator import IntegratorSettings
from drgs.render.integrate.plan import KEPT_LIGHT
from drgs.render.integrate.wavefront import WavefrontIntegrator
from drgs.render.intersect.trace_rays import build_tracer
from drgs.render.progressive import start_frame as start_module
from drgs.render.progressive.frame_state import FrameState
from drgs.render.progressive.kept_light.gather_light import MOST_ROUNDS, gather_light, vertices_to_light
from drgs.render.progressive.kept_light.kept_light import A_ROUND, KeptLight, faces_around, no_light
from drgs.render.progressive.kept_light.read_light import READ, TRACED, WANTED, read_light
from drgs.render.progressive.kept_light.shade_moving import only_specular, rays_to_keep, specular_counts
from drgs.render.progressive.refine import refine_frame
from drgs.render.progressive.start_frame import start_frame
from drgs.render.records import PrimaryPoints, RenderSettings, SampleCounts
from drgs.render.visible.trace_primary import trace_primary_points
from drgs.scene.camera import Camera
from drgs.scene.environment import Environment
from drgs.scene.mesh import TriangleMesh
from drgs.scene.posed_scene import PosedScene
from tests.render.closed_form_scenes import constant_sky, front_camera, mesh_of, on_device, sphere_mesh, sunny_sky, two_spheres

SETTINGS = RenderSettings(samples_per_pass=16, denoise="svgf", keep_light=True, bounces=1)
HOW = IntegratorSettings(SampleCounts(8, 4, 4), bounces=1)
SUNNY = sunny_sky(sun=20.0)


def gathered(mesh: TriangleMesh, sky: Environment, rounds: int, bounces: int = 1, integrator: type | None = None) -> KeptLight:
    """That many rounds at every vertex."""
    tracer = build_tracer(mesh)
    chosen = choose_integrator(tracer) if integrator is None else integrator(tracer)
    device = mesh.vertices.device
    light = environment_light(build_environment_table(Environment(sky.radiance.to(device))))
    kept, everywhere = no_light(mesh), torch.arange(len(mesh.vertices), device=device)
    for _ in range(rounds):
        kept = gather_light(kept, everywhere, chosen, light, dataclasses.replace(HOW, bounces=bounces))
    return kept


def mean_light(kept: KeptLight) -> tuple[torch.Tensor, torch.Tensor]:
    """(vertex, 3) direct and indirect."""
    return kept.direct / kept.rounds[:, None], kept.indirect / kept.indirect_rounds[:, None]


def gap_between_spheres() -> TriangleMesh:
    """Two coarse spheres, nearly touching, of several colours."""
    halves = [trimesh.creation.icosphere(1), trimesh.creation.icosphere(1)]
    halves[0].apply_translation([-1.02, 0, 0])
    halves[1].apply_translation([1.02, 0, 0])
    mesh = mesh_of(trimesh.util.concatenate(halves), 0.8, 0.5, 0.0)
    return dataclasses.replace(mesh, albedo=torch.rand(mesh.albedo.shape, generator=torch.Generator().manual_seed(2)))


# ---- what is kept --------------------------------------------------------------------------------------------------------


def test_white_paint_in_the_open_sends_what_an_even_sky_does(device: str) -> None:
    kept = gathered(on_device(sphere_mesh(3), device), constant_sky(), 16)
    direct, indirect = mean_light(kept)
    assert not bool(indirect.any()) and float((direct.mean() - 1).abs()) < 5e-3
    # A corner's normal lies a little above the planes around it, which block what comes from below them.
    assert float(direct.min()) > 0.9 and float(direct.max()) < 1.1 and float((kept.visibility / kept.rounds).min()) == 1.0


@pytest.mark.slow
@pytest.mark.parametrize("bounces", [0, 1])
def test_what_is_kept_is_what_the_path_integrator_finds(bounces: int) -> None:
    mesh = gap_between_spheres()
    middle = mesh.vertices[:, 0].abs()
    chosen = torch.argsort(middle)[:6]  # in the gap, where much is hidden
    kept = gathered(mesh, SUNNY, 120, bounces)
    direct, indirect = (light[chosen].double() for light in mean_light(kept))
    exact = Environment(SUNNY.radiance.double())
    scene, random = LitMesh(mesh_in(torch.float64, mesh), exact, build_environment_table(exact), build_tracer(mesh).lift), torch.Generator()
    around, copies = faces_around(mesh), 2000
    vertex = chosen.repeat_interleave(copies)
    turn = torch.arange(copies).repeat(len(chosen))
    degree = around.first[vertex + 1] - around.first[vertex]
    face = around.face[(around.first[vertex] + turn % degree).long()]
    for found, count in ((direct, 0), (direct + indirect, bounces)):
        truth = reference.white_paint_at(scene, vertex, face, count, random.manual_seed(count)).view(len(chosen), copies, 3)
        error = truth.std(1) / copies**0.5 + 0.01 * truth.mean(1)
        assert float(((found - truth.mean(1)).abs() / error).max()) < 4.5
    assert bool(indirect.any()) == (bounces > 0)


def test_both_integrators_keep_the_same_light() -> None:
    a, b = (gathered(two_spheres(), SUNNY, 2, 1, integrator) for integrator in (FusedEmbreeIntegrator, WavefrontIntegrator))
    for name in ("direct", "indirect", "visibility", "variance"):
        x, y = getattr(a, name), getattr(b, name)
        error = (x - y).abs() / (y.abs() + 1e-3 * y.abs().mean())
        assert float((error < 2e-3).float().mean()) > 0.99, name


def test_each_face_around_a_vertex_is_found_once() -> None:
    mesh = two_spheres()
    around = faces_around(mesh)
    for vertex in (0, 7, len(mesh.vertices) - 1):
        faces = around.face[int(around.first[vertex]) : int(around.first[vertex + 1])]
        assert set(faces.tolist()) == set(torch.nonzero((mesh.faces == vertex).any(1)).squeeze(-1).tolist()) and len(faces) in (5, 6)


def test_rays_go_where_fewest_went_and_stop_at_a_bound() -> None:
    kept = no_light(sphere_mesh(1))
    rounds = torch.arange(42, dtype=torch.int32) % 20
    kept = dataclasses.replace(kept, rounds=rounds, indirect_rounds=rounds)
    wanted = torch.arange(42) >= 2
    chosen = vertices_to_light(kept, wanted, 5 * A_ROUND.total + 1)
    assert chosen.tolist() == [20, 40, 21, 41, 2]
    everything = vertices_to_light(kept, wanted, 1 << 20)
    assert bool((rounds[everything] < MOST_ROUNDS).all()) and len(everything) == int((wanted & (rounds < MOST_ROUNDS)).sum())
    assert len(vertices_to_light(kept, wanted, 0)) == 0
    assert rays_to_keep(32, 100, 0, 1000) == 3200 and rays_to_keep(32, 0, 100, 1000) == 200 and rays_to_keep(4, 100, 100, 1000) == 450
    # What is not read for other reasons than that too little is known asks for nothing.
    assert rays_to_keep(32, 100, 0, 3) == 3 * A_ROUND.total and rays_to_keep(32, 100, 100, 0) == 200


# ---- where it is read ----------------------------------------------------------------------------------------------------


def seen_points(mesh: TriangleMesh, camera: Camera) -> PrimaryPoints:
    return trace_primary_points(build_tracer(mesh), camera, 0, 0)


def footprint_of(camera: Camera) -> float:
    return 1 / float(camera.intrinsics[0, 0])


@pytest.mark.slow
def test_points_are_judged_and_read_as_the_reference_does() -> None:
    """Of all kinds: metal and paint, wide and bent faces, known and unknown corners, even and uneven light."""
    numbers = torch.Generator().manual_seed(3)
    shape = trimesh.creation.icosphere(3)
    shape.vertices *= (1 + 0.01 * torch.rand(len(shape.vertices), 1, generator=numbers)).numpy()
    mesh, count = mesh_of(shape, 0.7, 0.5, 0.0), len(shape.vertices)
    mesh = dataclasses.replace(mesh, metallic=(torch.rand(count, generator=numbers) < 0.1).float())
    light = 0.7 + 0.6 * torch.rand(count, 3, generator=numbers) ** 8
    rounds = (torch.rand(count, generator=numbers) < 0.95).int() * torch.randint(1, 5, (count,), generator=numbers).int()
    further = torch.minimum(rounds, torch.randint(1, 5, (count,), generator=numbers).int())
    kept = KeptLight(
        light * rounds[:, None], 0.2 * light * further[:, None], 0.5 * rounds.float(), 0.01 * rounds.float(), rounds, further, faces_around(mesh)
    )  # fmt: skip
    camera = front_camera(60, distance=4.0)
    primary = seen_points(mesh, camera)
    assert primary.starts.face is not None and primary.barycentric is not None
    found = read_light(kept, primary, build_tracer(mesh), footprint_of(camera))
    points, corners = primary.points, mesh.faces[primary.starts.face.long()].long()
    whole = (1 + 0.2) * light.double()
    part = 0.2 / 1.2
    variance = 0.01 * ((1 - part) / rounds.clamp(min=1) + part / further.clamp(min=1)).double()
    base = points.albedo.amax(-1)
    diffuse = (1 - points.metallic) * base
    share = diffuse / (diffuse + F0 * (1 - points.metallic) + points.metallic * base)
    for i in range(len(points.pixel)):
        k = corners[i]
        verdict, there, error = reference.read_between(
            mesh.vertices[k].double(), mesh.normals[k].double(), whole[k], variance[k], further[k] > 0, primary.barycentric[i].double(),
            float(share[i]), footprint_of(camera) * float(primary.depth[i]),
        )  # fmt: skip
        assert int(found.verdict[i]) == verdict
        if verdict == READ:
            torch.testing.assert_close(found.light[i].double(), there, rtol=1e-5, atol=1e-6)
            torch.testing.assert_close(found.variance[i].double(), error, rtol=1e-4, atol=1e-9)
            assert float(found.visibility[i]) == pytest.approx(0.5)
            assert float(found.samples[i]) == A_ROUND.total * int(further[k].min())
        else:
            assert float(found.samples[i]) == 0
    for verdict in (TRACED, WANTED, READ):
        assert int((found.verdict == int(verdict)).sum()) > 20
    wanted = torch.zeros(count, dtype=torch.bool)
    wanted[corners[found.verdict != int(TRACED)].unique()] = True
    assert torch.equal(found.wanted, wanted)


def test_the_edge_of_a_shadow_is_left_to_rays() -> None:
    mesh, camera = sphere_mesh(4), front_camera(60)
    lit = (mesh.vertices[:, 2] > 0.1).float()[:, None].expand(-1, 3) + 0.05
    one = torch.ones(len(lit), dtype=torch.int32)
    kept = dataclasses.replace(no_light(mesh), direct=lit.contiguous(), rounds=one, indirect_rounds=one)
    primary = seen_points(mesh, camera)
    verdict = read_light(kept, primary, build_tracer(mesh), footprint_of(camera)).verdict
    assert primary.starts.face is not None
    side = lit[:, 0][mesh.faces[primary.starts.face.long()].long()]
    on_edge = side.amin(1) < side.amax(1)
    assert (
        int(on_edge.sum()) > 10
        and bool((verdict[on_edge] != int(READ)).all())
        and bool((verdict[~on_edge] == int(READ)).float().mean() > 0.9)
    )


def test_points_without_their_diffuse_part_shine_as_before() -> None:
    mesh = dataclasses.replace(two_spheres(metallic=0.3), albedo=torch.rand(2 * 642, 3, generator=torch.Generator().manual_seed(1)))
    primary = seen_points(mesh, front_camera(16, distance=8))
    tracer, light = build_tracer(mesh), environment_light(build_environment_table(SUNNY))
    shade = choose_integrator(tracer).shade
    how = dataclasses.replace(HOW, counts=SampleCounts(0, 8, 8))
    whole, specular = (shade(points, primary.starts, light, how) for points in (primary.points, only_specular(primary.points)))
    torch.testing.assert_close(specular.specular, whole.specular, rtol=1e-4, atol=1e-5)
    assert not bool(specular.diffuse.any()) and float(whole.diffuse.mean()) > 0.05


def test_a_point_that_is_read_pays_three_eighths_for_its_gloss() -> None:
    assert specular_counts(SampleCounts(8, 4, 4)) == SampleCounts(0, 3, 3)
    assert specular_counts(SampleCounts(2, 1, 1)) == SampleCounts(0, 1, 1)
    assert specular_counts(SampleCounts(12, 4, 0)) == SampleCounts(0, 6, 0)


# ---- moving pictures -----------------------------------------------------------------------------------------------------


def cameras(count: int, device: str = "cpu") -> list[Camera]:
    """That come nearer."""
    return [front_camera(48, distance=8 - 0.05 * k).to(device) for k in range(count)]


def scene_of(mesh: TriangleMesh, sky: Environment = SUNNY) -> PosedScene:
    return PosedScene(None, mesh, Environment(sky.radiance.to(mesh.vertices.device)))


def fine_spheres() -> TriangleMesh:
    """Two spheres that see each other, with faces of about a pixel."""
    halves = [trimesh.creation.icosphere(4), trimesh.creation.icosphere(4)]
    halves[0].apply_translation([-1.02, 0, 0])
    halves[1].apply_translation([1.02, 0, 0])
    return mesh_of(trimesh.util.concatenate(halves), 0.7, 0.6, 0.0)


def moved_through(scene: PosedScene, path: list[Camera], settings: RenderSettings) -> FrameState:
    state = None
    for camera in path:
        state = refine_frame(start_frame(scene, camera, settings, previous=state))
    assert state is not None
    return state


@pytest.mark.slow
def test_a_moving_picture_is_read_named_and_no_worse_than_with_all_its_rays(device: str) -> None:
    scene, path = scene_of(on_device(fine_spheres(), device)), cameras(24, device)
    kept, traced = (moved_through(scene, path, dataclasses.replace(SETTINGS, keep_light=keep)) for keep in (True, False))
    truth = resolve_frame(refine_frame(start_frame(scene, path[-1], RenderSettings(samples_per_pass=16, seed=5)), 64))
    inside = (truth.gbuffer.coverage == 1) & (resolve_frame(kept).gbuffer.coverage == 1)

    def error(state: FrameState) -> float:
        difference = (resolve_frame(state).radiance_linear - truth.radiance_linear)[inside].square().mean(-1)
        return float((difference / (truth.radiance_linear[inside].square().mean(-1) + 1e-2)).mean())

    assert kept.kept_samples is not None and float((kept.kept_samples[inside.flatten()] > 0).float().mean()) > 0.7
    assert error(kept) < error(traced)
    shown = resolve_frame(kept).radiance_linear[inside].mean()
    assert float((shown / truth.radiance_linear[inside].mean() - 1).abs()) < 0.02
    assert KEPT_LIGHT in kept.plan.skips and KEPT_LIGHT not in traced.plan.skips
    seen = resolve_frame(kept).radiance.visibility[inside]
    torch.testing.assert_close(seen.mean(), truth.radiance.visibility[inside].mean(), rtol=0.02, atol=0)


def test_a_picture_at_rest_holds_nothing_that_was_kept() -> None:
    """Its sums are, to the bit, those of a frame that was traced from the beginning."""
    scene, path = scene_of(fine_spheres()), cameras(6)
    moving = moved_through(scene, path, SETTINGS)
    assert moving.kept_samples is not None and bool(moving.kept_samples.any())
    rested, fresh = refine_frame(moving, 3), refine_frame(start_frame(scene, path[-1], SETTINGS), 3)
    assert rested.passes == 3 and rested.kept_samples is None and KEPT_LIGHT not in rested.plan.skips
    for name, sums in vars(fresh.sums).items():
        assert sums is None or torch.equal(getattr(rested.sums, name), sums), name
    assert rested.kept_light is moving.kept_light
    one_by_one = refine_frame(refine_frame(refine_frame(moving)))
    assert torch.equal(one_by_one.sums.diffuse, fresh.sums.diffuse)
    # What the moving picture showed is worth something until the frame has samples of its own.
    assert rested.reprojected is not None and float(rested.reprojected.samples.max()) > 0


@pytest.mark.parametrize(
    "change",
    [{"keep_light": False}, {"skip": False}, {"denoise": "none"}, {"split_indirect": True}, {"counts": SampleCounts(8, 4, 4)}],
    ids=lambda change: next(iter(change)),
)
def test_nothing_is_kept_where_it_was_not_asked_for(change: dict) -> None:
    settings = dataclasses.replace(SETTINGS, **change)
    state = moved_through(scene_of(fine_spheres()), cameras(4), settings)
    assert state.kept_light is None and state.kept_samples is None and not state.plan.kept_light
    assert KEPT_LIGHT not in state.plan.skips
    without = moved_through(scene_of(fine_spheres()), cameras(4), dataclasses.replace(settings, keep_light=False))
    assert torch.equal(state.sums.diffuse, without.sums.diffuse)


def test_a_first_picture_several_passes_and_a_moved_shape_trace_all_their_rays() -> None:
    scene, path = scene_of(fine_spheres()), cameras(5)
    first = refine_frame(start_frame(scene, path[0], SETTINGS))
    assert first.kept_light is None and first.kept_samples is None
    state = moved_through(scene, path[:4], SETTINGS)
    twice = refine_frame(start_frame(scene, path[4], SETTINGS, previous=state), 2)
    assert twice.kept_samples is None and twice.passes == 2
    longer = dataclasses.replace(scene.mesh, vertices=scene.mesh.vertices * torch.tensor([1.0, 1.0, 1.1]))
    bent = refine_frame(start_frame(dataclasses.replace(scene, mesh=longer), path[4], SETTINGS, previous=state))
    assert bent.kept_light is None and bent.kept_samples is None


def test_a_mesh_of_too_many_vertices_and_one_all_of_metal_keep_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    metal = dataclasses.replace(fine_spheres(), metallic=torch.ones(2 * 2562))
    assert moved_through(scene_of(metal), cameras(3), SETTINGS).kept_light is None
    monkeypatch.setattr(start_module, "MOST_VERTICES", 100)
    assert moved_through(scene_of(fine_spheres()), cameras(3), SETTINGS).kept_light is None


def test_a_black_sky_is_no_reason_to_look_for_light() -> None:
    state = moved_through(scene_of(fine_spheres(), constant_sky(0.0)), cameras(3), SETTINGS)
    assert state.kept_samples is None and float(state.sums.diffuse.max()) == 0


# ---- edits ---------------------------------------------------------------------------------------------------------------


def new_albedo(scene: PosedScene) -> PosedScene:
    return dataclasses.replace(scene, mesh=dataclasses.replace(scene.mesh, albedo=0.5 * scene.mesh.albedo))


def turned_sky(scene: PosedScene) -> PosedScene:
    return dataclasses.replace(scene, environment_rotation_degrees=30.0)


def stronger_sky(scene: PosedScene) -> PosedScene:
    return dataclasses.replace(scene, environment_intensity=3.0)


def new_sky(scene: PosedScene) -> PosedScene:
    return dataclasses.replace(scene, environment=constant_sky())


@pytest.mark.parametrize(
    ("edit", "direct", "indirect"),
    [(new_albedo, 1.0, None), (turned_sky, None, None), (stronger_sky, 3.0, 3.0), (new_sky, None, None), (lambda scene: scene, 1.0, 1.0)],
)
def test_an_edit_empties_what_it_changes(edit: Callable, direct: float | None, indirect: float | None) -> None:
    """Each part: times a factor, or emptied."""
    scene, path = scene_of(fine_spheres()), cameras(5)
    before = moved_through(scene, path[:4], SETTINGS)
    at_rest = start_frame(edit(scene), path[3], SETTINGS, previous=before)
    old, kept = before.kept_light, at_rest.kept_light
    assert old is not None and kept is not None and bool(old.direct.any()) and bool(old.indirect.any())
    for name, rounds, factor in (("direct", "rounds", direct), ("indirect", "indirect_rounds", indirect)):
        assert bool(getattr(kept, rounds).any()) == (factor is not None)
        torch.testing.assert_close(getattr(kept, name), (factor or 0.0) * getattr(old, name))
    if direct is not None:
        torch.testing.assert_close(kept.variance, direct**2 * old.variance)
    assert kept.around is old.around
    moving = refine_frame(start_frame(edit(scene), path[4], SETTINGS, previous=at_rest))
    assert moving.kept_light is not None and bool(moving.kept_light.indirect_rounds.any())


def test_other_bounces_empty_what_surfaces_send_and_another_size_nothing() -> None:
    scene, path = scene_of(fine_spheres()), cameras(4)
    before = moved_through(scene, path, SETTINGS)
    further = start_frame(scene, path[3], dataclasses.replace(SETTINGS, bounces=2), previous=before).kept_light
    smaller = start_frame(scene, front_camera(30, distance=8), SETTINGS, previous=before).kept_light
    assert before.kept_light is not None and further is not None
    assert torch.equal(further.direct, before.kept_light.direct) and not bool(further.indirect_rounds.any())
    assert smaller is before.kept_light


def test_the_same_path_keeps_the_same_bits_and_leaves_what_it_was_given() -> None:
    scene, path = scene_of(fine_spheres()), cameras(4)
    before = moved_through(scene, path[:3], SETTINGS)
    assert before.kept_light is not None
    copies = {name: values.clone() for name, values in vars(before.kept_light).items() if isinstance(values, torch.Tensor)}
    started = start_frame(scene, path[3], SETTINGS, previous=before)
    a, b = refine_frame(started), refine_frame(started)
    assert torch.equal(a.sums.diffuse, b.sums.diffuse) and a.kept_light is not None and b.kept_light is not None
    assert torch.equal(a.kept_light.direct, b.kept_light.direct) and int(a.kept_light.rounds.sum()) > int(copies["rounds"].sum())
    assert all(torch.equal(getattr(before.kept_light, name), values) for name, values in copies.items())
