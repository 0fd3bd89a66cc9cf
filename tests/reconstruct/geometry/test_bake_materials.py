"""From surfels to vertices and to harmonics: constants stay constants, borders stay where they are, known radiance comes out."""

import dataclasses
import math

import pytest
import torch

from drgs.maths.frames import rotation_from_quat_wxyz
from drgs.maths.spherical_harmonics import radiance_from_sh
from drgs.reconstruct.fit.light.split_sum import ENVIRONMENT_SIZE, brdf_table
from drgs.reconstruct.geometry.bake_materials import (
    average_surfels,
    bake_materials,
    bake_outgoing_radiance,
    outward_normals,
    vertex_weights,
)
from drgs.scene.environment import Environment
from tests.reconstruct.surfel_spheres import constant_sh, joined, surfel_sphere
from tests.render.closed_form_scenes import sphere_mesh


def black_sky() -> Environment:
    return Environment(torch.zeros(*ENVIRONMENT_SIZE, 3))


def test_constant_materials_bake_to_the_same_constants():
    surfels = surfel_sphere(300)
    count = len(surfels.centers)
    surfels = dataclasses.replace(
        surfels,
        albedo=torch.tensor([0.7, 0.2, 0.4]).expand(count, 3).contiguous(),
        roughness=torch.full((count,), 0.3),
        metallic=torch.full((count,), 0.8),
    )
    mesh = sphere_mesh()
    baked = bake_materials(mesh, surfels)
    vertices = len(mesh.vertices)
    torch.testing.assert_close(baked.albedo, torch.tensor([0.7, 0.2, 0.4]).expand(vertices, 3))
    torch.testing.assert_close(baked.roughness, torch.full((vertices,), 0.3))
    torch.testing.assert_close(baked.metallic, torch.full((vertices,), 0.8))
    assert baked.vertices is mesh.vertices and baked.faces is mesh.faces and baked.normals is mesh.normals


def test_a_two_coloured_sphere_bakes_with_its_border_in_place():
    surfels = surfel_sphere(2000)
    red, blue = torch.tensor([0.8, 0.1, 0.1]), torch.tensor([0.1, 0.1, 0.8])
    upper = surfels.centers[:, 2] > 0.2
    surfels = dataclasses.replace(surfels, albedo=torch.where(upper[:, None], red, blue), metallic=upper.float())
    baked = bake_materials(sphere_mesh(subdivisions=4), surfels)
    height = baked.vertices[:, 2]
    torch.testing.assert_close(baked.albedo[height > 0.3], red.expand(int((height > 0.3).sum()), 3), atol=0.03, rtol=0)
    torch.testing.assert_close(baked.albedo[height < 0.1], blue.expand(int((height < 0.1).sum()), 3), atol=0.03, rtol=0)
    # The surfel edge lies half a spacing on either side of 0.2; baked values cross one half there too.
    band = (height > 0.15) & (height < 0.25)
    assert int(band.sum()) > 30
    assert bool(((baked.metallic > 0.5) == (height > 0.2))[(height - 0.2).abs() > 0.03].all())


def test_a_see_through_surfel_counts_little_and_one_that_stands_across_less():
    surfels = surfel_sphere(400)
    across = surfel_sphere(400)
    turn = torch.tensor([math.cos(math.pi / 4), math.sin(math.pi / 4), 0.0, 0.0])  # a quarter turn about t_u, on the right of R
    w, x, y, z = across.quats_wxyz.unbind(-1)
    c, s = turn[0], turn[1]
    standing = torch.stack([w * c - x * s, x * c + w * s, y * c + z * s, z * c - y * s], -1)
    normals = rotation_from_quat_wxyz(standing)[:, :, 2]
    assert float((normals * across.centers).sum(-1).abs().max()) < 1e-4  # they do stand across
    faint = dataclasses.replace(surfels, opacity_logits=torch.full((400,), -6.0), albedo=torch.ones(400, 3))
    across = dataclasses.replace(across, quats_wxyz=standing, albedo=torch.ones(400, 3))
    mesh = sphere_mesh()
    for disturbance in (faint, across):
        baked = bake_materials(mesh, joined(surfels, disturbance))
        torch.testing.assert_close(baked.albedo, torch.full_like(baked.albedo, 0.5), atol=0.02, rtol=0)


def test_weights_sum_to_one_also_far_from_every_surfel():
    surfels = surfel_sphere(100)
    far = torch.tensor([[50.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    indices, weights = vertex_weights(far, torch.tensor([[1.0, 0, 0], [1.0, 0, 0]]), surfels)
    torch.testing.assert_close(weights.sum(1), torch.ones(2))
    values = average_surfels(surfels.centers, indices, weights)
    assert float(values[0, 0]) > 0.5  # the nearest surfels are those on the +x side


def test_normals_are_turned_to_the_outside():
    surfels = surfel_sphere(200)
    w, x, y, z = surfels.quats_wxyz.unbind(-1)
    inside = torch.stack([-x, w, z, -y], -1)  # half a turn about t_u
    quats = torch.where((torch.arange(200) % 2 == 0)[:, None], inside, surfels.quats_wxyz)
    turned = dataclasses.replace(surfels, quats_wxyz=quats)
    assert float((rotation_from_quat_wxyz(quats)[:, :, 2] * surfels.centers).sum(-1).min()) < -0.9
    torch.testing.assert_close(outward_normals(turned, sphere_mesh()), surfels.centers, atol=1e-4, rtol=0)


def directions_seen_from(normals: torch.Tensor, seed: int = 0) -> torch.Tensor:
    """A direction of each hemisphere, not at grazing angles."""
    noise = torch.nn.functional.normalize(torch.randn(normals.shape, generator=torch.Generator().manual_seed(seed)), dim=-1)
    return torch.nn.functional.normalize(normals + 0.8 * noise, dim=-1)


def test_under_a_black_sky_only_the_surfels_own_radiance_is_left():
    surfels = surfel_sphere(60)
    normals = surfels.centers
    own = torch.rand(60, 3, generator=torch.Generator().manual_seed(1))
    sh = constant_sh(own + 0.5)  # the residual has no offset
    baked = bake_outgoing_radiance(surfels, sh, normals, black_sky())
    wo = directions_seen_from(normals)
    torch.testing.assert_close(radiance_from_sh(baked, -wo), own, atol=0.02, rtol=0)


@pytest.mark.parametrize("sky", [0.4, 2.0])
def test_a_purely_diffuse_radiance_is_reproduced_under_a_constant_sky(sky: float):
    surfels = surfel_sphere(60)
    normals = surfels.centers
    # Rough enough that the dielectric's four per cent hardly depend on the view.
    surfels = dataclasses.replace(surfels, albedo=torch.full((60, 3), 0.6), roughness=torch.ones(60))
    baked = bake_outgoing_radiance(surfels, torch.zeros(60, 16, 3), normals, Environment(torch.full((*ENVIRONMENT_SIZE, 3), sky)))
    wo = directions_seen_from(normals)
    f1, f2 = brdf_table(32)[:, 31, 24]
    torch.testing.assert_close(
        radiance_from_sh(baked, -wo), torch.full((60, 3), sky * (0.6 + 0.04 * float(f1) + float(f2))), rtol=0.03, atol=0
    )


def test_a_metal_shows_the_sky_in_its_tint_and_no_diffuse_light():
    surfels = surfel_sphere(60)
    normals = surfels.centers
    tint = torch.tensor([0.9, 0.6, 0.2])
    surfels = dataclasses.replace(
        surfels, albedo=tint.expand(60, 3).contiguous(), roughness=torch.full((60,), 0.1), metallic=torch.ones(60)
    )
    radiance = torch.zeros(*ENVIRONMENT_SIZE, 3)
    radiance[:64] = 2.0  # a bright upper half
    baked = bake_outgoing_radiance(surfels, torch.zeros(60, 16, 3), normals, Environment(radiance))
    up, down = normals[:, 2] > 0.9, normals[:, 2] < -0.9
    seen = radiance_from_sh(baked, -normals)
    torch.testing.assert_close(seen[up], (2.0 * tint).expand(int(up.sum()), 3), rtol=0.1, atol=0)
    assert float(seen[down].max()) < 0.1
