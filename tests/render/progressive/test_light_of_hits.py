"""Light that surfaces are known to send: rays that meet them bring it, others trace on, and what is known is what is kept."""

import dataclasses
import math

import pytest
import torch

from drgs.reference import kept_light as reference
from drgs.render.integrate.environment_table import build_environment_table, environment_light
from drgs.render.integrate.fused_embree import FusedEmbreeIntegrator
from drgs.render.integrate.integrator import IntegratorSettings
from drgs.render.integrate.plan import KEPT_HITS, KEPT_LIGHT
from drgs.render.integrate.surface_light import SurfaceLight
from drgs.render.integrate.wavefront import WavefrontIntegrator
from drgs.render.intersect.trace_rays import build_tracer
from drgs.render.progressive.kept_light.kept_light import no_light
from drgs.render.progressive.kept_light.light_of_hits import WIDEST, light_of_hits
from drgs.render.progressive.refine import refine_frame
from drgs.render.progressive.start_frame import start_frame
from drgs.render.records import RayStarts, RenderSettings, SampleCounts, ShadedPoints, ShadingPoints
from drgs.scene.mesh import TriangleMesh
from drgs.scene.posed_scene import PosedScene
from tests.render.closed_form_scenes import constant_sky, front_camera, on_device, sphere_mesh, sunny_sky, two_spheres

INTEGRATORS = pytest.mark.parametrize("integrator", [FusedEmbreeIntegrator, WavefrontIntegrator])
HOW = IntegratorSettings(SampleCounts(7, 3, 5), bounces=1, seed=3, split_indirect=True)
MAPS = ("diffuse", "specular", "indirect", "visibility")


def shaded(mesh: TriangleMesh, integrator: type, known: SurfaceLight | None, sky_value: float | None = None) -> ShadedPoints:
    """The vertices, seen from straight above."""
    pixel = torch.arange(len(mesh.vertices), device=mesh.vertices.device).int()
    points = ShadingPoints(mesh.vertices, mesh.normals, mesh.normals, mesh.albedo, mesh.roughness, mesh.metallic, pixel)
    sky = sunny_sky(sun=20.0) if sky_value is None else constant_sky(sky_value)
    sky = dataclasses.replace(sky, radiance=sky.radiance.to(mesh.vertices.device))
    starts = RayStarts(mesh.vertices + 1e-3 * mesh.normals, mesh.normals)
    light = environment_light(build_environment_table(sky))
    return integrator(build_tracer(mesh)).shade(points, starts, light, HOW, known=known)


def normals_of(mesh: TriangleMesh) -> torch.Tensor:
    return build_tracer(mesh).face_normals.clone()


def same_everywhere(mesh: TriangleMesh, color: tuple[float, float, float]) -> SurfaceLight:
    vertex = torch.tensor([*color, 1.0], device=mesh.vertices.device).expand(len(mesh.vertices), 4)
    return surface_light(vertex.contiguous(), normals_of(mesh))


def surface_light(vertex: torch.Tensor, face_normal: torch.Tensor) -> SurfaceLight:
    return SurfaceLight(vertex, face_normal, torch.zeros(len(vertex), dtype=torch.bool, device=vertex.device))


@INTEGRATORS
def test_surfaces_that_send_what_the_sky_does_leave_points_as_bright_as_in_the_open(integrator: type) -> None:
    """White furnace: whatever a ray meets, it brings 1."""
    mesh = two_spheres(albedo=1.0)
    found = shaded(mesh, integrator, same_everywhere(mesh, (1.0, 1.0, 1.0)), sky_value=1.0)
    open_sky = shaded(sphere_mesh(3, albedo=1.0), integrator, None, sky_value=1.0)
    assert float(found.visibility.min()) < 0.8 and found.indirect is not None and float(found.indirect.max()) > 0.2
    assert abs(float(found.diffuse.mean() / open_sky.diffuse.mean()) - 1) < 0.01
    assert abs(float(found.specular.mean() / open_sky.specular.mean()) - 1) < 0.02


@INTEGRATORS
def test_where_nothing_is_known_all_is_traced_to_the_bit(integrator: type) -> None:
    mesh = two_spheres()
    known = same_everywhere(mesh, (9.0, 9.0, 9.0))
    traced = shaded(mesh, integrator, None)
    unknown = (
        dataclasses.replace(known, vertex=torch.zeros_like(known.vertex)),
        dataclasses.replace(known, face_normal=torch.zeros_like(known.face_normal)),
    )
    for nothing in unknown:
        found = shaded(mesh, integrator, nothing)
        assert all(torch.equal(getattr(found, name), getattr(traced, name)) for name in MAPS)


def test_both_integrators_read_the_same_where_a_part_is_known() -> None:
    mesh = two_spheres()
    vertex = torch.rand(len(mesh.vertices), 4, generator=torch.Generator().manual_seed(1))
    vertex[:, 3] = (vertex[:, 3] < 0.9).float()
    normal = torch.where(torch.rand(len(mesh.faces), 1, generator=torch.Generator().manual_seed(2)) < 0.8, normals_of(mesh), 0.0)
    a, b = (shaded(mesh, integrator, surface_light(vertex, normal)) for integrator in (FusedEmbreeIntegrator, WavefrontIntegrator))
    traced = shaded(mesh, FusedEmbreeIntegrator, None)
    for name in MAPS:
        x, y = getattr(a, name), getattr(b, name)
        error = (x - y).abs() / (y.abs() + 1e-3 * y.abs().mean())
        assert float((error < 2e-3).float().mean()) > 0.99, name
    assert a.indirect is not None and traced.indirect is not None
    assert float((a.indirect - traced.indirect).abs().max()) > 0.01


@INTEGRATORS
def test_the_back_of_a_triangle_sends_nothing(integrator: type) -> None:
    mesh = two_spheres()
    known = same_everywhere(mesh, (5.0, 5.0, 5.0))
    found = shaded(mesh, integrator, dataclasses.replace(known, face_normal=-known.face_normal))
    assert found.indirect is not None and float(found.indirect.abs().max()) == 0


def test_vertices_send_what_the_reference_says(device: str) -> None:
    mesh, numbers = sphere_mesh(3), torch.Generator().manual_seed(6)
    count = len(mesh.vertices)
    mesh = dataclasses.replace(mesh, albedo=torch.rand(count, 3, generator=numbers), metallic=0.4 * torch.rand(count, generator=numbers))
    rounds = torch.randint(0, 3, (count,), generator=numbers, dtype=torch.int32)
    direct = torch.rand(count, 3, generator=numbers) * rounds[:, None]
    there = on_device(mesh, device)
    kept = dataclasses.replace(no_light(there), direct=direct.to(device), rounds=rounds.to(device))
    found = light_of_hits(kept, build_tracer(there)).vertex.cpu().double()
    wanted = [
        reference.sent_by_vertex(direct[v].double(), int(rounds[v]), mesh.albedo[v].double(), float(mesh.metallic[v])) for v in range(count)
    ]
    torch.testing.assert_close(found, torch.stack(wanted), rtol=1e-5, atol=1e-6)
    assert [int((found[:, 3] == verdict).sum()) > 0.1 * count for verdict in (-1, 0, 1)] == [True] * 3


def test_wide_and_bent_faces_are_left_to_rays() -> None:
    fine, coarse = sphere_mesh(5), sphere_mesh(1)
    assert bool((light_of_hits(no_light(fine), build_tracer(fine)).face_normal.norm(dim=-1) > 0.999).all())
    assert not bool(light_of_hits(no_light(coarse), build_tracer(coarse)).face_normal.any())
    tracer = build_tracer(fine)
    side = (fine.vertices[fine.faces[:, 0].long()] - fine.vertices[fine.faces[:, 1].long()]).norm(dim=-1)
    assert float(side.max()) < WIDEST * tracer.extent < 2 * math.pi / 5 / 8  # what fine and coarse mean here
    turned = dataclasses.replace(fine, normals=fine.normals.roll(1, 1))
    assert not bool(light_of_hits(no_light(turned), build_tracer(turned)).face_normal.any(-1).all())


def test_a_moving_picture_reads_its_hits_with_one_bounce_and_says_so() -> None:
    scene = PosedScene(None, two_spheres(), sunny_sky(sun=20.0))
    for bounces in (0, 1, 2):
        settings, state = RenderSettings(samples_per_pass=16, denoise="svgf", keep_light=True, bounces=bounces), None
        for k in range(3):
            state = refine_frame(start_frame(scene, front_camera(48, distance=8 - 0.05 * k), settings, previous=state))
        assert state is not None and state.is_quick and KEPT_LIGHT in state.plan.skips
        assert (KEPT_HITS in state.plan.skips) == (bounces == 1)
        assert KEPT_HITS not in refine_frame(state).plan.skips
