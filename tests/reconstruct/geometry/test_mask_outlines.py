"""Outlines of masks to a fraction of a pixel, and of meshes against them, on spheres whose outlines are known."""

import dataclasses
import math

import torch

from drgs.reconstruct.geometry.mask_outlines import mask_outline, outline_rays, outline_residuals
from drgs.render.intersect.trace_rays import build_tracer, trace_rays
from drgs.scene.camera import Camera, pixel_rays_world, scaled_camera
from tests.render.closed_form_scenes import front_camera, sphere_mesh, two_spheres

SIZE, DISTANCE, FIELD = 96, 4.0, 0.7


def camera() -> Camera:
    return front_camera(SIZE, DISTANCE, FIELD)


def outline_radius(radius: float = 1.0) -> float:
    """Of a sphere at the origin in camera()'s picture [pixels]."""
    return float(camera().intrinsics[0, 0]) * radius / math.sqrt(DISTANCE**2 - radius**2)


def disc_mask(radius: float, samples: int = 8) -> torch.Tensor:
    """(SIZE, SIZE) share of each pixel inside a circle about the picture's middle."""
    fine = (torch.arange(SIZE * samples) + 0.5) / samples - SIZE / 2
    inside = (fine[:, None] ** 2 + fine**2 < radius**2).float()
    return torch.nn.functional.avg_pool2d(inside[None, None], samples)[0, 0]


def residuals(mesh, mask):
    tracer = build_tracer(mesh)
    return outline_residuals(tracer, outline_rays((camera(),), [mask_outline(mask)], tracer.mesh.faces.device))


def test_an_outline_lies_on_the_circle_to_a_seventh_of_a_pixel_everywhere_and_a_thirtieth_in_the_mean():
    outline = mask_outline(disc_mask(30.3))
    assert outline is not None
    away = outline.points - SIZE / 2
    error = away.norm(dim=1) - 30.3
    assert float(error.abs().max()) < 0.15 and abs(float(error.mean())) < 0.03
    assert float((torch.nn.functional.normalize(away, dim=1) * outline.normals).sum(1).min()) > 0.98


def test_a_mask_without_an_outline_has_none():
    assert mask_outline(torch.zeros(16, 16)) is None
    empty = residuals(sphere_mesh(), torch.zeros(SIZE, SIZE))
    assert empty.corners.shape == empty.weights.shape == empty.gradient.shape == (0, 3) and len(empty.distance) == len(empty.length) == 0


def test_the_mesh_of_the_true_sphere_lies_on_its_mask():
    found = residuals(sphere_mesh(subdivisions=4), disc_mask(outline_radius()))
    assert float(found.length.sum()) > 0.95 * 2 * math.pi * outline_radius()
    assert abs(float(found.distance.mean())) < 0.04 and float(found.distance.abs().max()) < 0.3


def test_a_mesh_that_is_too_small_lies_inside_by_the_difference_in_pixels():
    found = residuals(sphere_mesh(subdivisions=4, radius=0.95), disc_mask(outline_radius()))
    assert abs(float(found.distance.mean()) - (outline_radius(0.95) - outline_radius())) < 0.08


def test_a_mesh_of_uneven_faces_ends_where_its_rays_do():
    """Its edges between faces that look here and away lie inside its outline: they are no measure of it. The area that it covers is."""
    even = sphere_mesh(subdivisions=3)
    shifted = even.vertices + 0.04 * torch.randn(even.vertices.shape, generator=torch.Generator().manual_seed(0))
    mesh = dataclasses.replace(even, vertices=torch.nn.functional.normalize(shifted, dim=1))
    found = residuals(mesh, disc_mask(outline_radius()))
    fine = 8
    there = scaled_camera(camera(), fine)
    origin, directions = pixel_rays_world(there)
    direction = directions.reshape(-1, 3).contiguous()
    area = float(trace_rays(origin.expand_as(direction), direction, build_tracer(mesh)).hit.sum()) / fine**2
    inside = (area - math.pi * outline_radius() ** 2) / (2 * math.pi * outline_radius())
    assert inside < -0.05  # chords
    assert abs(float((found.distance * found.length).sum() / found.length.sum()) - inside) < 0.02


def test_the_gradient_is_that_of_finite_differences():
    mesh, mask = sphere_mesh(subdivisions=4), disc_mask(outline_radius())
    found, step = residuals(mesh, mask), 0.02
    for axis in range(3):
        moved = dataclasses.replace(mesh, vertices=mesh.vertices + step * torch.eye(3)[axis])
        again = residuals(moved, mask)
        assert len(again.distance) == len(found.distance)  # of the same places of the mask
        error = ((again.distance - found.distance) / step - found.gradient[:, axis]).abs()
        assert float(error.quantile(0.9)) < 0.1 * float(found.gradient.norm(dim=1).mean())


def test_weights_name_the_place_where_the_mesh_ends():
    mesh = sphere_mesh(subdivisions=4)
    found = residuals(mesh, disc_mask(outline_radius()))
    place = (mesh.vertices[found.corners] * found.weights[..., None]).sum(1)
    at = place @ camera().camera_from_world[:3, :3].T + camera().camera_from_world[:3, 3]
    pixel = at @ camera().intrinsics.T
    radius = (pixel[:, :2] / pixel[:, 2:] - SIZE / 2).norm(dim=1)
    assert float((radius - outline_radius() - found.distance).abs().max()) < 0.2


def test_an_outline_before_another_part_of_the_object_is_none_of_the_masks():
    # One sphere stands before the other: only the union's outline may be compared with the mask.
    pair = two_spheres()
    turned = dataclasses.replace(pair, vertices=pair.vertices[:, [1, 0, 2]] * torch.tensor([1.0, 1.0, 1.0]), faces=pair.faces.flip(1))
    near = float(camera().intrinsics[0, 0]) / math.sqrt((DISTANCE - 1.02) ** 2 - 1)
    found = residuals(turned, disc_mask(near))
    assert len(found.distance) > 20 and float(turned.vertices[found.corners][..., 1].max()) < 0  # the near sphere's alone


def test_a_mask_that_ends_with_the_picture_says_nothing_there():
    mask = disc_mask(outline_radius())
    mask[:, SIZE // 2 :] = 1.0
    ball = sphere_mesh(subdivisions=4)
    beside = (SIZE / 2 - 3 - outline_radius()) * DISTANCE / float(camera().intrinsics[0, 0])  # it ends three pixels before the border
    right = camera().camera_from_world[:3, :3].T[:, 0]
    found = residuals(dataclasses.replace(ball, vertices=ball.vertices + beside * right), mask)
    place = (ball.vertices[found.corners] * found.weights[..., None]).sum(1) @ right
    assert float(place.max()) < 0.5


def test_a_mesh_that_ends_nowhere_near_the_mask_says_nothing():
    far = residuals(sphere_mesh(radius=0.3), disc_mask(outline_radius()))
    cut = torch.zeros(SIZE, SIZE)
    cut[:, :1] = 1.0  # its outline lies within the margin, all of it
    for nothing in (far, residuals(sphere_mesh(), cut)):
        assert nothing.corners.shape == nothing.gradient.shape == (0, 3) and len(nothing.distance) == len(nothing.length) == 0
