"""The share of the sky's irradiance that arrives at vertices: against a sum over all of the sky, under an even sky and under a lamp."""

import dataclasses

import pytest
import torch

from drgs.reconstruct.fit.light.mesh_light import SHARE_LIFT, MeshLight, irradiance_share, light_of_rays, mirrored_light, radiance_along
from drgs.reconstruct.fit.light.split_sum import ENVIRONMENT_SIZE, filter_environment, texel_directions, texel_solid_angles
from drgs.render.intersect.trace_rays import build_tracer, trace_rays
from drgs.render.intersect.tracer import AbstractTracer
from drgs.scene.environment import Environment
from drgs.scene.mesh import TriangleMesh
from tests.reconstruct.fit.convex_rays import assert_only_the_sky_is_seen, rays_of_convex
from tests.render.closed_form_scenes import sphere_mesh

LAMP = 3000.0
"""Of a few texels, times the sky: seven times the sky's light in all, and one direction in six hundred."""


def black_spheres(distance: float) -> TriangleMesh:
    """Two of radius 1, side by side along x; what they meet sends almost nothing back."""
    one = sphere_mesh(subdivisions=2)
    moved = one.vertices + torch.tensor([distance, 0.0, 0.0])
    both = {name: torch.cat([getattr(one, name)] * 2) for name in ("normals", "albedo", "roughness", "metallic")}
    both["albedo"], both["roughness"] = 0 * both["albedo"], torch.ones_like(both["roughness"])
    return TriangleMesh(torch.cat([one.vertices, moved]), torch.cat([one.faces, one.faces + len(one.vertices)]), **both)


def lamp_sky() -> Environment:
    """A grey sky with a lamp where x is largest and z is positive."""
    radiance = torch.ones(*ENVIRONMENT_SIZE, 3)
    direction = texel_directions(ENVIRONMENT_SIZE[0])
    radiance[(direction * torch.tensor([0.8, 0.0, 0.6])).sum(-1) > 0.9985] = LAMP
    return Environment(radiance)


def summed_share(tracer: AbstractTracer, environment: Environment, vertex: int) -> float:
    """Over all texels; what is met sends nothing."""
    direction = texel_directions(ENVIRONMENT_SIZE[0]).reshape(-1, 3)
    normal = tracer.mesh.normals[vertex]
    angle = texel_solid_angles(ENVIRONMENT_SIZE[0]).repeat_interleave(ENVIRONMENT_SIZE[1])
    arrives = angle * (direction @ normal).clamp(min=0) * environment.radiance[..., 0].flatten()
    origin = tracer.mesh.vertices[vertex] + SHARE_LIFT * tracer.lift * normal
    hit = trace_rays(origin.expand_as(direction).contiguous(), direction.contiguous(), tracer).hit
    return float((arrives * ~hit).double().sum() / arrives.double().sum())


def shares(tracer: AbstractTracer, environment: Environment, rays: int) -> torch.Tensor:
    open_share = torch.zeros_like(tracer.mesh.vertices)
    tables = filter_environment(environment.radiance)
    return irradiance_share(tracer, environment, MeshLight(tables, open_share), rays, torch.Generator().manual_seed(1))


@pytest.mark.parametrize("sky", ["even", "lamp"])
def test_the_share_is_that_of_a_sum_over_the_whole_sky(sky: str) -> None:
    tracer = build_tracer(black_spheres(2.5))
    environment = lamp_sky() if sky == "lamp" else Environment(torch.ones(*ENVIRONMENT_SIZE, 3))
    found = shares(tracer, environment, 48)[:, 0]
    chosen = range(0, len(found), 9)
    error = torch.tensor([float(found[vertex]) - summed_share(tracer, environment, vertex) for vertex in chosen])
    # Vertices from which the lamp is half hidden have the most.
    assert float(error.abs().mean()) < 0.02 and float(error.abs().max()) < 0.15 and abs(float(error.mean())) < 0.006


def test_where_nothing_is_met_all_arrives() -> None:
    one = sphere_mesh(subdivisions=2)
    found = shares(build_tracer(dataclasses.replace(one, albedo=torch.ones_like(one.albedo))), lamp_sky(), 8)
    torch.testing.assert_close(found, torch.ones_like(found))


def test_on_a_convex_surface_rays_above_it_see_the_sky_and_others_bring_nothing():
    mesh = sphere_mesh(subdivisions=3)
    points, rays = rays_of_convex(mesh)
    light = MeshLight(filter_environment(torch.ones(*ENVIRONMENT_SIZE, 3)), torch.ones_like(mesh.vertices))
    tracer = build_tracer(mesh)
    starts = points.position_world + tracer.lift * points.normal_world
    found = light_of_rays(tracer, starts, points.normal_world, rays.direction_world, rays.weight, light)
    assert_only_the_sky_is_seen(points, rays, *found)


@pytest.mark.parametrize("turned", [False, True])
def test_several_rays_a_point_find_what_rays_one_by_one_do(turned: bool) -> None:
    """Of two coloured spheres under a lamp, from points of the first."""
    random = torch.Generator().manual_seed(2)
    mesh = black_spheres(2.2)
    mesh = dataclasses.replace(
        mesh, albedo=torch.rand(mesh.albedo.shape, generator=random), metallic=torch.rand(len(mesh.vertices), generator=random)
    )
    tracer, count, samples = build_tracer(mesh), 40, 30
    turn = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]) if turned else None
    light = MeshLight(filter_environment(lamp_sky().radiance), torch.rand(mesh.vertices.shape, generator=random), turn)
    up = mesh.normals[:count].contiguous()
    origins = 1.001 * up
    directions = torch.nn.functional.normalize(torch.randn(count, samples, 3, generator=random), dim=-1)
    weight = (torch.rand(count, samples, generator=random) - 0.2).clamp(min=0)
    transmittance, met = light_of_rays(tracer, origins, up, directions, weight, light)

    counts = (weight > 0) & ((directions * up[:, None]).sum(-1) > 0)
    alone = radiance_along(tracer, origins[:, None].expand_as(directions)[counts].contiguous(), directions[counts].contiguous(), light)
    assert 0.2 < float(counts.float().mean()) < 0.6 and 0.03 < float((alone[0] == 0).float().mean()) < 0.9
    assert float(transmittance[~counts].abs().max()) == 0 and float(met[~counts].abs().max()) == 0
    torch.testing.assert_close(transmittance[counts], alone[0])
    torch.testing.assert_close(met[counts], alone[1])


def facing_mirrors(albedo: float) -> TriangleMesh:
    """Two large metal squares, face to face, at z = 0 and z = 1."""
    corners = torch.tensor([[-9.0, -9, 0], [9, -9, 0], [9, 9, 0], [-9, 9, 0]])
    vertices = torch.cat([corners, corners + torch.tensor([0.0, 0, 1])])
    faces = torch.tensor([[0, 1, 2], [0, 2, 3], [4, 6, 5], [4, 7, 6]], dtype=torch.int32)
    up = torch.tensor([0.0, 0, 1]).expand(4, 3)
    ones = torch.ones(8)
    return TriangleMesh(vertices, faces, torch.cat([up, -up]), torch.full((8, 3), albedo), 0.1 * ones, ones)


@pytest.mark.parametrize("mirrors", [0, 1, 2])
def test_what_a_mirror_shows_of_another_mirrors_the_object_as_often_as_it_is_said(mirrors: int) -> None:
    """Under an even sky of 1: each mirror leaves its albedo of what it shows, and after the last one the sky is shown."""
    albedo, count = 0.8, 256
    mesh = facing_mirrors(albedo)
    light = MeshLight(filter_environment(torch.ones(*ENVIRONMENT_SIZE, 3)), torch.zeros_like(mesh.vertices))
    face, weights = torch.zeros(count, dtype=torch.long), torch.tensor([0.5, 0.0, 0.5]).expand(count, 3)  # its longest side's middle
    towards = torch.nn.functional.normalize(torch.tensor([0.1, 0, 1.0]), dim=0).expand(count, 3)
    transmittance, met = mirrored_light(build_tracer(mesh), face, weights, towards, light, torch.Generator().manual_seed(1), mirrors)
    assert float(transmittance.max()) == 0
    assert abs(float(met.mean()) / albedo ** (mirrors + 1) - 1) < 0.02
