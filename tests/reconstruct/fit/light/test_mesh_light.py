"""The share of the sky's irradiance that arrives at vertices: against a sum over all of the sky, under an even sky and under a lamp."""

import dataclasses

import pytest
import torch

from drgs.reconstruct.fit.light.mesh_light import SHARE_LIFT, MeshLight, irradiance_share
from drgs.reconstruct.fit.light.split_sum import ENVIRONMENT_SIZE, filter_environment, texel_directions, texel_solid_angles
from drgs.render.intersect.trace_rays import build_tracer, trace_rays
from drgs.render.intersect.tracer import AbstractTracer
from drgs.scene.environment import Environment
from drgs.scene.mesh import TriangleMesh
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
