"""Positions from normals: a wrong sphere becomes the right one, by its normals and the outlines of its masks."""

import dataclasses
import math

import pytest
import torch
import trimesh

from drgs.reconstruct.geometry.integrate_normals import IntegrationSettings, Places, integrate_normals
from drgs.reconstruct.geometry.mask_outlines import MaskOutline, mask_outline, outline_rays, outline_residuals
from drgs.reconstruct.geometry.mesh_edges import mesh_edges
from drgs.render.intersect.trace_rays import build_tracer
from drgs.scene.camera import Camera
from drgs.scene.mesh import TriangleMesh, vertex_normals
from tests.render.closed_form_scenes import front_camera, sphere_mesh

SIZE = 96


def views_of_a_unit_sphere(count: int = 12) -> tuple[tuple[Camera, ...], list[MaskOutline | None]]:
    """Around it, with the outline that it has in each."""
    base = front_camera(SIZE, 4.0, 0.7)
    radius = float(base.intrinsics[0, 0]) / math.sqrt(15)
    fine = (torch.arange(SIZE * 8) + 0.5) / 8 - SIZE / 2
    mask = torch.nn.functional.avg_pool2d((fine[:, None] ** 2 + fine**2 < radius**2).float()[None, None], 8)[0, 0]
    cameras = []
    for k in range(count):
        a, b = 2 * math.pi * k / count, 0.6 * math.sin(2.4 * k)
        about_z = torch.tensor([[math.cos(a), -math.sin(a), 0, 0], [math.sin(a), math.cos(a), 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
        about_x = torch.tensor([[1, 0, 0, 0], [0, math.cos(b), -math.sin(b), 0], [0, math.sin(b), math.cos(b), 0], [0, 0, 0, 1]])
        cameras.append(dataclasses.replace(base, camera_from_world=base.camera_from_world @ (about_x @ about_z).float()))
    return tuple(cameras), [mask_outline(mask)] * count


def solved(mesh: TriangleMesh, wanted: torch.Tensor, settings: IntegrationSettings, rounds: int = 4) -> torch.Tensor:
    cameras, outlines = views_of_a_unit_sphere()
    edges = mesh_edges(mesh.faces)
    for _ in range(rounds):
        residuals = outline_residuals(build_tracer(mesh), outline_rays(cameras, outlines, mesh.faces.device))
        vertices = integrate_normals(mesh.vertices, mesh.faces, wanted, edges, residuals, settings)
        mesh = dataclasses.replace(mesh, vertices=vertices, normals=vertex_normals(vertices, mesh.faces))
    return mesh.vertices


@pytest.mark.slow
def test_a_sphere_that_is_too_small_and_bumpy_becomes_the_sphere_of_its_normals_and_masks():
    true = sphere_mesh(subdivisions=4)
    bumps = 0.02 * torch.sin(9 * true.vertices).prod(1, keepdim=True)
    wrong = dataclasses.replace(true, vertices=true.vertices * (0.96 + bumps))
    radii = solved(wrong, true.normals, IntegrationSettings()).norm(dim=1)
    assert abs(float(radii.mean()) - 1) < 2e-3 and float(radii.std()) < 0.2 * float((0.96 + bumps).std())


@pytest.mark.slow
def test_the_true_sphere_stays_where_it_is():
    true = sphere_mesh(subdivisions=4)
    assert float((solved(true, true.normals, IntegrationSettings()) - true.vertices).norm(dim=1).max()) < 4e-3


def test_creases_of_a_surface_that_has_its_normals_stay():
    """A cube, whose corners move by half a triangle's side in one solve if sides of triangles are laid across the mean of their ends' normals."""
    cube = trimesh.creation.box().subdivide().subdivide().subdivide()
    vertices, faces = torch.from_numpy(cube.vertices).float(), torch.from_numpy(cube.faces).int()
    edges, own = mesh_edges(faces), vertex_normals(vertices, faces)
    none = outline_residuals(build_tracer(sphere_mesh(subdivisions=1)), outline_rays((), [], faces.device))
    turned = torch.nn.functional.normalize(own + torch.tensor([0.02, 0.0, 0.0]), dim=-1)
    moved = [
        float((integrate_normals(vertices, faces, wanted, edges, none, IntegrationSettings()) - vertices).norm(dim=1).max())
        for wanted in (own, turned)
    ]
    assert moved[0] < 1e-6 and moved[1] > 1e-3


@pytest.mark.parametrize("anchor", [1e-3, 1e3])
def test_the_anchor_holds_what_nothing_pulls(anchor: float):
    true = sphere_mesh(subdivisions=3)
    shrunk = dataclasses.replace(true, vertices=0.97 * true.vertices)
    moved = (solved(shrunk, true.normals, IntegrationSettings(anchor=anchor), rounds=1) - shrunk.vertices).norm(dim=1)
    assert (float(moved.mean()) > 0.015) == (anchor < 1)


def test_what_nothing_holds_goes_home():
    """The same normals everywhere: a sheet may lie at any depth, and lies where it began."""
    true = sphere_mesh(subdivisions=3)
    edges = mesh_edges(true.faces)
    none = outline_residuals(build_tracer(true), outline_rays((), [], true.faces.device))
    radii = []
    for homeward in (None, -0.03 * true.vertices):
        vertices = true.vertices
        for _ in range(6):
            homes = None if homeward is None else Places(homeward, torch.ones(len(vertices)))
            moved = integrate_normals(vertices, true.faces, true.normals, edges, none, IntegrationSettings(home=1e-2), homes)
            homeward = None if homeward is None else homeward + vertices - moved
            vertices = moved
        radii.append(float(vertices.norm(dim=1).mean()))
    assert abs(radii[0] - 1) < 2e-3 and abs(radii[1] - 0.97) < 5e-3, radii


def test_texture_that_lies_deeper_is_followed_though_half_of_it_is_noise():
    """Places three hundredths deeper, each off by as much again and half of the vertices without any: the surface sinks evenly."""
    true = sphere_mesh(subdivisions=4)
    edges, count = mesh_edges(true.faces), len(true.vertices)
    none = outline_residuals(build_tracer(true), outline_rays((), [], true.faces.device))
    generator = torch.Generator().manual_seed(0)
    depth = 0.03 + 0.03 * torch.randn(count, 1, generator=generator)
    places, weight = true.vertices * (1 - depth), (torch.rand(count, generator=generator) > 0.5).float()
    vertices = true.vertices
    for _ in range(4):
        texture = Places(places - vertices, weight)
        vertices = integrate_normals(vertices, true.faces, true.normals, edges, none, IntegrationSettings(), texture=texture)
    radii = vertices.norm(dim=1)
    assert abs(float(radii.mean()) - 0.97) < 3e-3 and float(radii.std()) < 0.01, (radii.mean(), radii.std())


def test_a_mesh_of_any_size_is_moved_in_proportion():
    true = sphere_mesh(subdivisions=3)
    bumpy = true.vertices * (1 + 0.02 * torch.sin(9 * true.vertices).prod(1, keepdim=True))
    edges = mesh_edges(true.faces)
    none = outline_residuals(build_tracer(true), outline_rays((), [], true.faces.device))
    results = [
        integrate_normals(scale * bumpy, true.faces, true.normals, edges, none, IntegrationSettings()) / scale for scale in (1.0, 1e3)
    ]
    torch.testing.assert_close(results[0], results[1], atol=1e-4, rtol=0)
