"""Outlines of masks to a fraction of a pixel, and of meshes against them, on spheres whose outlines are known."""

import dataclasses
import math

import torch

from drgs.reconstruct.geometry.mask_outlines import mask_outline, outline_residuals
from drgs.reconstruct.geometry.mesh_edges import mesh_edges
from drgs.render.intersect.trace_rays import build_tracer
from drgs.scene.camera import Camera
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
    return outline_residuals(mesh_edges(mesh.faces), tracer, (camera(),), [mask_outline(mask)])


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
    assert len(empty.edge) == len(empty.distance) == 0 and empty.gradient.shape == (0, 3)


def test_the_mesh_of_the_true_sphere_lies_on_its_mask():
    found = residuals(sphere_mesh(subdivisions=4), disc_mask(outline_radius()))
    assert len(found.edge) > 50
    assert abs(float(found.distance.mean())) < 0.06 and float(found.distance.abs().max()) < 0.3


def test_a_mesh_that_is_too_small_lies_inside_by_the_difference_in_pixels():
    found = residuals(sphere_mesh(subdivisions=4, radius=0.95), disc_mask(outline_radius()))
    assert abs(float(found.distance.mean()) - (outline_radius(0.95) - outline_radius())) < 0.08


def test_the_gradient_is_that_of_finite_differences():
    mesh, mask = sphere_mesh(subdivisions=3), disc_mask(outline_radius())
    found = residuals(mesh, mask)
    edges = mesh_edges(mesh.faces)
    step = 2e-3
    for axis in range(3):
        moved = dataclasses.replace(mesh, vertices=mesh.vertices + step * torch.eye(3)[axis])
        again = residuals(moved, mask)
        both, here, there = [], {int(e): k for k, e in enumerate(found.edge)}, {int(e): k for k, e in enumerate(again.edge)}
        for edge in here.keys() & there.keys():
            measured = (again.distance[there[edge]] - found.distance[here[edge]]) / step
            both.append(abs(float(measured - found.gradient[here[edge], axis])))
        assert len(both) > 20 and sorted(both)[int(0.9 * len(both))] < 0.05 * float(found.gradient.norm(dim=1).mean())
    assert int(found.edge.max()) < len(edges.vertices)


def test_an_outline_before_another_part_of_the_object_is_none_of_the_masks():
    # One sphere stands before the other: only the union's outline may be compared with the mask.
    pair = two_spheres()
    turned = dataclasses.replace(pair, vertices=pair.vertices[:, [1, 0, 2]] * torch.tensor([1.0, 1.0, 1.0]), faces=pair.faces.flip(1))
    near = float(camera().intrinsics[0, 0]) / math.sqrt((DISTANCE - 1.02) ** 2 - 1)
    found = residuals(turned, disc_mask(near))
    middle = 0.5 * (turned.vertices[mesh_edges(turned.faces).vertices[found.edge]].sum(1))
    assert len(found.edge) > 20 and float(middle[:, 1].max()) < 0  # the near sphere's alone
