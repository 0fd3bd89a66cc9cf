"""The readable path integrator against closed forms; then what the renderer finds, against it."""

import math
from functools import cache

import pytest
import torch
import trimesh

from drgs.reference.mesh_surface import Surfaces, mesh_in, surfaces_at
from drgs.reference.path_integrator import LitMesh, first_hits, incoming_radiance, outgoing_radiance
from drgs.render.integrate.environment_table import build_environment_table, environment_light
from drgs.render.integrate.fused_embree import FusedEmbreeIntegrator
from drgs.render.integrate.integrator import IntegratorSettings
from drgs.render.integrate.wavefront import WavefrontIntegrator
from drgs.render.intersect.tracer_embree import EmbreeTracer
from drgs.render.records import RayStarts, SampleCounts, ShadingPoints
from drgs.scene.environment import Environment, environment_radiance
from drgs.scene.mesh import TriangleMesh
from tests.render.closed_form_scenes import constant_sky, mesh_of, sphere_mesh, sunny_sky

LIFT = 1e-4


def lit(mesh: TriangleMesh, sky: Environment) -> LitMesh:
    exact = Environment(sky.radiance.double())
    return LitMesh(mesh_in(torch.float64, mesh), exact, build_environment_table(exact), LIFT)


def spheres_that_see_each_other(albedo: float, roughness: float, metallic: float) -> TriangleMesh:
    """Two coarse unit spheres, nearly touching."""
    halves = [trimesh.creation.icosphere(1), trimesh.creation.icosphere(1)]
    halves[0].apply_translation([-1.02, 0, 0])
    halves[1].apply_translation([1.02, 0, 0])
    return mesh_of(trimesh.util.concatenate(halves), albedo, roughness, metallic)


def repeated(x: Surfaces, count: int) -> Surfaces:
    return Surfaces(*(values.repeat_interleave(count, 0) for values in vars(x).values()))


def estimates(scene: LitMesh, x: Surfaces, wo: torch.Tensor, bounces: int, count: int, seed: int = 0) -> torch.Tensor:
    """(point, count, 3)."""
    random = torch.Generator().manual_seed(seed)
    return outgoing_radiance(scene, repeated(x, count), wo.repeat_interleave(count, 0), bounces, random).view(len(wo), count, 3)


def places_in_the_gap(mesh: TriangleMesh) -> tuple[torch.Tensor, torch.Tensor]:
    """Faces of the left sphere that look at the right one, and places on them."""
    middle = mesh.vertices[mesh.faces.long()].mean(1)
    face = torch.nonzero((middle[:, 0] < -0.05) & (middle[:, 0] > -0.55)).squeeze(-1)
    return face, torch.tensor([0.3, 0.25], dtype=torch.float64).expand(len(face), 2)


def shade_surfaces(integrator: type, mesh: TriangleMesh, x: Surfaces, sky: Environment, counts: SampleCounts, bounces: int) -> torch.Tensor:
    """(point,) mean of the channels of what an integrator finds, seen along the normals."""
    position, normal, face_normal, albedo, roughness, metallic = (values.float() for values in vars(x).values())
    points = ShadingPoints(position, normal, normal, albedo, roughness, metallic, torch.arange(len(position)).int())
    starts = RayStarts((x.position + LIFT * x.face_normal).float(), face_normal)
    light = environment_light(build_environment_table(sky))
    result = integrator(EmbreeTracer(mesh)).shade(points, starts, light, IntegratorSettings(counts, bounces, 7))
    return (result.diffuse + result.specular).double().mean(-1)


def test_rays_meet_the_triangles_that_embree_finds() -> None:
    mesh, numbers = spheres_that_see_each_other(0.5, 0.5, 0.0), torch.Generator().manual_seed(1)
    origin = 3 * torch.randn(2000, 3, generator=numbers)
    direction = torch.nn.functional.normalize(torch.randn(2000, 3, generator=numbers) - origin, dim=-1)
    face, barycentric = first_hits(mesh_in(torch.float64, mesh), origin.double(), direction.double())
    hits = EmbreeTracer(mesh).closest_hits(origin, direction)
    same = face == hits.face
    assert int(hits.hit.sum()) > 500 and float(same.double().mean()) > 0.998
    torch.testing.assert_close(barycentric[same & hits.hit].float(), hits.barycentric[same & hits.hit], atol=1e-4, rtol=0)


def test_what_a_ray_brings_is_the_sky_or_a_surface_and_the_back_of_one_is_black() -> None:
    scene, random = lit(sphere_mesh(1), sunny_sky()), torch.Generator()
    up = torch.tensor([[0.1, 0.2, 0.97]], dtype=torch.float64)
    up = up / up.norm()
    assert torch.equal(incoming_radiance(scene, 2 * up, up, 3, random), environment_radiance(scene.environment, up))
    assert float(incoming_radiance(scene, 2 * up, -up, 0, random).max()) == 0  # no bounce left
    assert any(float(incoming_radiance(scene, 2 * up, -up, 1, random).max()) > 0 for _ in range(10))
    assert all(float(incoming_radiance(scene, 0 * up, up, 3, random).max()) == 0 for _ in range(10))  # from inside


@pytest.mark.parametrize("bounces", [0, 1, 3])
def test_a_convex_body_is_lit_directly_only(bounces: int) -> None:
    """And under an even sky of 1 returns its albedo and what the broad lobe of a dielectric adds."""
    mesh = sphere_mesh(1, albedo=0.6, roughness=1.0)
    scene = lit(mesh, constant_sky())
    x = surfaces_at(scene.mesh, torch.arange(6), torch.full((6, 2), 0.3, dtype=torch.float64))
    means = estimates(scene, x, x.normal, bounces, 1000)
    assert torch.equal(means, estimates(scene, x, x.normal, 0, 1000))
    assert 0.6 < float(means.mean()) < 0.68


MIRRORS = spheres_that_see_each_other(1.0, 0.0, 1.0)
"""Bare metal that loses nothing: whatever a path meets before it escapes, it brings the radiance of an even sky."""


@pytest.mark.slow
def test_a_closed_furnace_returns_the_light_that_comes_in() -> None:
    scene = lit(MIRRORS, constant_sky(0.8))
    x = surfaces_at(scene.mesh, *places_in_the_gap(scene.mesh))
    direct, all_light = (estimates(scene, x, x.normal, bounces, 1500)[..., 0] for bounces in (0, 12))
    assert float(direct.mean()) < 0.9 * 0.8  # some of what a place in the gap sees is the other sphere
    error = float(all_light.std()) / math.sqrt(all_light.numel())
    assert error < 0.01 and abs(float(all_light.mean()) - 0.8) < 4 * error + 0.004  # the lobe's tail ends at the horizon


@pytest.mark.parametrize("integrator", [FusedEmbreeIntegrator, WavefrontIntegrator])
def test_a_closed_furnace_shades_as_bright_as_the_sky(integrator: type) -> None:
    exact = mesh_in(torch.float64, MIRRORS)
    x = repeated(surfaces_at(exact, *places_in_the_gap(exact)), 20)
    direct, all_light = (shade_surfaces(integrator, MIRRORS, x, constant_sky(0.8), SampleCounts(1, 14, 1), bounces) for bounces in (0, 12))
    assert float(direct.mean()) < 0.9 * 0.8
    assert abs(float(all_light.mean()) - 0.8) < 0.006
    assert float(all_light.std()) < 0.05


@cache
def truth_in_the_gap(roughness: float, metallic: float, bounces: int) -> torch.Tensor:
    """(place, estimate) mean of the channels under a sun, of paths as the equation has them."""
    scene = lit(spheres_that_see_each_other(0.8, roughness, metallic), sunny_sky(sun=30.0))
    x = surfaces_at(scene.mesh, *places_in_the_gap(scene.mesh))
    return estimates(scene, x, x.normal, bounces, 1000).mean(-1)


@pytest.mark.slow
@pytest.mark.parametrize("integrator", [FusedEmbreeIntegrator, WavefrontIntegrator])
@pytest.mark.parametrize("bounces", [0, 1, 3])
@pytest.mark.parametrize(("roughness", "metallic"), [(0.5, 0.0), (0.3, 1.0)], ids=["paint", "metal"])
def test_an_integrator_finds_what_the_equation_says(integrator: type, bounces: int, roughness: float, metallic: float) -> None:
    """Between two spheres that see each other, under a sun: z-tests place by place, and of the mean over all."""
    mesh, sky, copies = spheres_that_see_each_other(0.8, roughness, metallic), sunny_sky(sun=30.0), 64
    truth = truth_in_the_gap(roughness, metallic, bounces)
    exact = mesh_in(torch.float64, mesh)
    many = repeated(surfaces_at(exact, *places_in_the_gap(exact)), copies)
    found = shade_surfaces(integrator, mesh, many, sky, SampleCounts(8, 4, 4), bounces).view(len(truth), copies)

    error = ((truth.var(1) / truth.shape[1]) + (found.var(1) / copies)).sqrt()
    z = (found.mean(1) - truth.mean(1)) / error
    assert float(z.abs().max()) < 4.5
    assert abs(float(z.mean())) < 4 / math.sqrt(len(z))
    assert float((error / truth.mean(1)).median()) < 0.05  # the test can tell


@pytest.mark.slow
def test_more_bounces_bring_more_light_between_the_spheres() -> None:
    mesh = spheres_that_see_each_other(0.9, 1.0, 0.0)
    scene = lit(mesh, constant_sky())
    x = surfaces_at(scene.mesh, *places_in_the_gap(scene.mesh))
    means = [float(estimates(scene, x, x.normal, bounces, 300, seed=bounces).mean()) for bounces in (0, 1, 3)]
    assert means[0] + 0.02 < means[1] and means[1] + 0.01 < means[2]
