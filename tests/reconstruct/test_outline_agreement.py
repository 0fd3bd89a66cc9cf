"""Masks of a ball against balls of other sizes, whose agreement is a ratio of areas."""

import dataclasses

import pytest
import torch

from drgs.reconstruct.outline_agreement import complaint, outline_agreement
from drgs.scene.camera import pixel_rays_world
from drgs.scene.views import Views
from tests.reconstruct.geometry.test_extract_mesh import orbit_camera, sphere_directions
from tests.render.closed_form_scenes import sphere_mesh


def masks_of_a_ball() -> Views:
    cameras = tuple(orbit_camera(5 * direction) for direction in sphere_directions(30))
    coverage = []
    for camera in cameras:
        origin, direction = pixel_rays_world(camera)
        nearest = torch.linalg.cross(direction, origin.expand_as(direction)).norm(dim=-1)
        coverage.append(((nearest < 1) * 255).to(torch.uint8))
    pictures = tuple(mask[..., None].repeat(1, 1, 3) for mask in coverage)
    return Views(cameras, pictures, tuple(coverage), None, None, has_masks=True, source="made")


@pytest.mark.parametrize("radius", [1.0, 0.8, 0.5])
def test_agreement_is_the_ratio_of_areas(radius: float) -> None:
    mesh = sphere_mesh(subdivisions=5)
    sine = [r / 5 for r in (radius, 1.0)]  # of the cone about a ball seen from five radii away
    expected = torch.tensor([s * s / (1 - s * s) for s in sine])
    found = outline_agreement(dataclasses.replace(mesh, vertices=radius * mesh.vertices), masks_of_a_ball())
    assert abs(found - float(expected[0] / expected[1])) < 0.02


def test_a_mesh_elsewhere_agrees_with_nothing_and_is_complained_of() -> None:
    mesh = sphere_mesh(subdivisions=3)
    found = outline_agreement(dataclasses.replace(mesh, vertices=mesh.vertices + 1000), masks_of_a_ball())
    assert found == 0.0
    assert "0%" in (complaint(found) or "")
    assert complaint(0.97) is None
