"""Both kinds of incident light on a scene that sees itself, and under an open sky."""

import dataclasses

import pytest
import torch
import trimesh

from drgs.reconstruct.fit.surfels.incident_light import build_incident_light
from tests.reconstruct.surfel_spheres import constant_sh, fibonacci_sphere, joined, surfel_sphere
from tests.render.closed_form_scenes import mesh_of, on_device, sphere_mesh

LEFT, RIGHT = (0.2, 0.4, 0.6), (0.9, 0.5, 0.1)
PLACE = 1.15
"""The unit spheres' centres on x; the gap between them is wider than what vertices average over."""


def two_spheres():
    shapes = [trimesh.creation.icosphere(3) for _ in range(2)]
    for shape, x in zip(shapes, (-PLACE, PLACE), strict=True):
        shape.apply_translation([x, 0, 0])
    return mesh_of(trimesh.util.concatenate(shapes), 0.5, 0.5, 0.0)


def on(device: str, gaussians):
    return type(gaussians)(*(getattr(gaussians, f.name).to(device) for f in dataclasses.fields(gaussians)))


def rays_from_the_left_sphere(count: int = 3000) -> tuple[torch.Tensor, torch.Tensor]:
    """Origins just outside the left sphere directions leaving it."""
    normals = fibonacci_sphere(count)
    other = torch.nn.functional.normalize(torch.randn(count, 3, generator=torch.Generator().manual_seed(0)), dim=-1)
    directions = torch.nn.functional.normalize(normals + 0.95 * other, dim=-1)
    return 1.03 * normals + torch.tensor([-PLACE, 0.0, 0.0]), directions


def meets_right_sphere(origins: torch.Tensor, directions: torch.Tensor, radius: float) -> torch.Tensor:
    offset = origins - torch.tensor([PLACE, 0.0, 0.0])
    b = (offset * directions).sum(-1)
    return (b < 0) & (b * b - ((offset * offset).sum(-1) - radius**2) > 0)


@pytest.mark.parametrize("kind", ["mesh", "surfels"])
def test_rays_bring_back_the_other_spheres_radiance_or_the_sky(kind: str, device: str):
    spheres = [surfel_sphere(1500, center=(x, 0, 0), opacity=0.99, radiance=c) for x, c in ((-PLACE, LEFT), (PLACE, RIGHT))]
    light = build_incident_light(kind, on_device(two_spheres(), device), on(device, joined(*spheres)))
    origins, directions = rays_from_the_left_sphere()
    transmittance, hit_radiance = (x.cpu() for x in light.incident(origins.to(device), directions.to(device)))
    inside, outside = meets_right_sphere(origins, directions, 0.97), ~meets_right_sphere(origins, directions, 1.1)
    assert int(inside.sum()) > 100 and int(outside.sum()) > 1000
    assert float(transmittance[outside].mean()) > 0.99 and float(transmittance[inside].mean()) < 0.03
    assert float(hit_radiance[outside].abs().mean()) < 0.01
    torch.testing.assert_close(hit_radiance[inside].mean(0), torch.tensor(RIGHT), rtol=0.04, atol=0.01)


def test_mesh_and_surfels_agree():
    spheres = [surfel_sphere(1500, center=(x, 0, 0), opacity=0.99) for x in (-PLACE, PLACE)]
    surfels = joined(*spheres)
    generator = torch.Generator().manual_seed(3)
    sh = constant_sh(0.6 + 0.3 * surfels.centers[:, [2, 1, 1]].sin())
    sh[:, 1:4] += 0.1 * torch.randn(3, 3, generator=generator)  # depends on the direction, too
    surfels = dataclasses.replace(surfels, sh=sh)
    origins, directions = rays_from_the_left_sphere()
    results = [build_incident_light(kind, two_spheres(), surfels).incident(origins, directions) for kind in ("mesh", "surfels")]
    assert float((results[0][0] - results[1][0]).abs().mean()) < 0.02
    assert float((results[0][1] - results[1][1]).abs().mean()) < 0.02
    both = (results[0][0] == 0) & (results[1][0] < 0.05)
    difference = (results[0][1] - results[1][1])[both].abs()
    assert int(both.sum()) > 100 and float(difference.quantile(0.95)) < 0.1


@pytest.mark.parametrize("kind", ["mesh", "surfels"])
def test_outside_a_convex_object_the_sky_is_open(kind: str):
    light = build_incident_light(kind, sphere_mesh(), surfel_sphere(500))
    normals = fibonacci_sphere(200)
    transmittance, hit_radiance = light.incident(1.1 * normals, normals)
    assert float(transmittance.min()) == 1.0 and float(hit_radiance.abs().max()) == 0.0
    transmittance, hit_radiance = light.incident(torch.zeros(0, 3), torch.zeros(0, 3))
    assert transmittance.shape == (0,) and hit_radiance.shape == (0, 3)


def test_a_half_opaque_surface_lets_half_of_the_sky_through_and_gives_half_its_radiance():
    # Many faint surfels: what is hit_radiance is already times 1 - transmittance.
    light = build_incident_light("surfels", sphere_mesh(), surfel_sphere(800, opacity=0.25, overlap=1.2, radiance=RIGHT))
    directions = fibonacci_sphere(300)
    transmittance, hit_radiance = light.incident(torch.zeros(300, 3), directions)
    assert 0.1 < float(transmittance.mean()) < 0.9
    torch.testing.assert_close(hit_radiance, (1 - transmittance)[:, None] * torch.tensor(RIGHT), atol=2e-3, rtol=0)


def test_an_unknown_kind_is_refused_with_what_is_possible():
    with pytest.raises(ValueError, match="'mesh' or 'surfels'; found 'voxels'"):
        build_incident_light("voxels", sphere_mesh(), surfel_sphere(10))
