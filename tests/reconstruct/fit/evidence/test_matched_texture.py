"""Depths that several photographs agree on, of a floor whose pattern, place and photographs are known in closed form."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

import drgs.reconstruct.fit.evidence.matched_texture as module
from drgs.reconstruct.fit.evidence.matched_texture import matched_texture
from drgs.reconstruct.geometry.mesh_edges import mesh_edges
from drgs.render.intersect.trace_rays import build_tracer
from drgs.scene.camera import Camera
from drgs.scene.mesh import TriangleMesh
from drgs.scene.views import Views

SIZE, FOCAL, FAR = 128, 240.0, 4.0
DEPTH = 0.04
RADIUS = 2.0
"""Of what the floor is a part of."""


def pattern(x: Tensor, y: Tensor) -> Tensor:
    """0..1, finer than a patch and without period: a sum of waves whose lengths have no common multiple."""
    waves = [(31.0, 7.0, 0.3), (-11.0, 29.0, 1.1), (19.3, 23.7, 2.0), (41.0, -17.0, 0.7), (-13.1, -37.3, 2.9), (5.3, 47.1, 1.7)]
    return 0.5 + sum(torch.sin(a * x + b * y + c) for a, b, c in waves) / (2 * len(waves))


def cameras_above(count: int = 9) -> tuple[Camera, ...]:
    """At 12 to 30 degrees from the z axis, looking at the origin."""
    cameras = []
    intrinsics = torch.tensor([[FOCAL, 0, SIZE / 2], [0, FOCAL, SIZE / 2], [0, 0, 1]])
    for k in range(count):
        tilt, turn = math.radians(12 + 18 * (k % 3) / 2), 2 * math.pi * k / count
        back = torch.tensor([math.sin(tilt) * math.cos(turn), math.sin(tilt) * math.sin(turn), math.cos(tilt)])
        right = torch.nn.functional.normalize(torch.linalg.cross(torch.tensor([0.0, 1.0, 0.0]), back), dim=0)
        rotation = torch.stack([right, -torch.linalg.cross(back, right), -back])
        pose = torch.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation, -rotation @ (FAR * back)
        cameras.append(Camera(pose, intrinsics, SIZE, SIZE, f"{k}"))
    return tuple(cameras)


def photographs_of_a_floor(kind: str) -> Views:
    """A floor at z = -DEPTH."""
    cameras, images = cameras_above(), []
    row, column = torch.meshgrid(torch.arange(SIZE) + 0.5, torch.arange(SIZE) + 0.5, indexing="ij")
    for number, camera in enumerate(cameras):
        rotation, center = camera.camera_from_world[:3, :3], camera.center_world
        ray = torch.stack([(column - SIZE / 2) / FOCAL, (row - SIZE / 2) / FOCAL, torch.ones_like(row)], -1) @ rotation
        at = center + ray * ((-DEPTH - center[2]) / ray[..., 2:])
        if kind == "patterned":
            value = pattern(at[..., 0], at[..., 1])
        elif kind == "mirror":  # each view sees another part of far surroundings
            value = pattern(ray[..., 0] * 9 + 3.0 * number, ray[..., 1] * 9 - 5.0 * number)
        else:
            value = 0.5 + 0.1 * at[..., 0]
        # As bright as another exposure and a veil make it.
        images.append(((0.1 + (0.7 + 0.02 * number) * value)[..., None].expand(-1, -1, 3) * 255).round().to(torch.uint8))
    coverage = tuple(torch.full((SIZE, SIZE), 255, dtype=torch.uint8) for _ in cameras)
    return Views(cameras, tuple(images), coverage, None, None, True, "test")


def sheet(side: int = 24) -> TriangleMesh:
    """At z = 0 over [-0.6, 0.6] squared."""
    axis = torch.linspace(-0.6, 0.6, side)
    x, y = torch.meshgrid(axis, axis, indexing="ij")
    vertices = torch.stack([x.flatten(), y.flatten(), torch.zeros(side * side)], -1)
    corner = (torch.arange(side - 1)[:, None] * side + torch.arange(side - 1)).flatten()
    faces = torch.cat(
        [torch.stack([corner, corner + side, corner + side + 1], -1), torch.stack([corner, corner + side + 1, corner + 1], -1)]
    ).int()
    count = len(vertices)
    normals = torch.tensor([0.0, 0.0, 1.0]).expand(count, 3).contiguous()
    return TriangleMesh(vertices, faces, normals, torch.full((count, 3), 0.5), torch.full((count,), 0.5), torch.zeros(count))


def depths_found(kind: str, metal: float = 0.0):
    mesh = sheet()
    return mesh, matched_texture(
        build_tracer(mesh),
        mesh.normals,
        torch.full((len(mesh.vertices),), metal),
        mesh_edges(mesh.faces),
        photographs_of_a_floor(kind),
        RADIUS,
    )


def test_a_pattern_is_found_at_its_depth_whatever_the_exposure():
    mesh, found = depths_found("patterned")
    believed = found.weight > 0.2
    assert float(believed.float().mean()) > 0.4, float(believed.float().mean())
    off = found.places[believed, 2] + DEPTH
    assert abs(float(off.median())) < 0.002 and float(off.abs().quantile(0.9)) < 0.01, (off.median(), off.abs().quantile(0.9))
    unsaid = found.weight == 0
    assert torch.equal(found.places[unsaid], mesh.vertices[unsaid])


@pytest.mark.parametrize(("kind", "metal"), [("plain", 0.0), ("mirror", 0.0), ("patterned", 1.0)])
def test_plain_floors_mirrors_and_metal_say_nothing(kind: str, metal: float):
    mesh, found = depths_found(kind, metal)
    assert not found.weight.any() and torch.equal(found.places, mesh.vertices)


@pytest.mark.parametrize(("views", "radius"), [(1, 1.0), (2, 1.0), (9, 0.02), (9, 1e-6)])
def test_one_view_two_and_an_object_of_a_pixel_say_nothing(views: int, radius: float):
    mesh, all_views = sheet(), photographs_of_a_floor("patterned")
    few = replace(
        all_views, cameras=all_views.cameras[:views], images_srgb=all_views.images_srgb[:views], coverage=all_views.coverage[:views]
    )
    found = matched_texture(build_tracer(mesh), mesh.normals, torch.zeros(len(mesh.vertices)), mesh_edges(mesh.faces), few, radius)
    assert not found.weight.any() and torch.equal(found.places, mesh.vertices)


TUBE = 0.2
"""Radius, 12 pixels: a patch is as wide."""


def photographs_of_a_tube() -> Views:
    """Along x, through the origin; nothing behind it."""
    cameras, images, coverage = cameras_above(), [], []
    row, column = torch.meshgrid(torch.arange(SIZE) + 0.5, torch.arange(SIZE) + 0.5, indexing="ij")
    for camera in cameras:
        rotation, center = camera.camera_from_world[:3, :3], camera.center_world
        ray = torch.stack([(column - SIZE / 2) / FOCAL, (row - SIZE / 2) / FOCAL, torch.ones_like(row)], -1) @ rotation
        a, half_b = ray[..., 1:].square().sum(-1), (ray[..., 1:] * center[1:]).sum(-1)
        root = half_b.square() - a * (center[1:].square().sum() - TUBE**2)
        at = center + ray * ((-half_b - root.clamp(min=0).sqrt()) / a)[..., None]
        value = pattern(at[..., 0], TUBE * torch.atan2(at[..., 1], at[..., 2]))
        images.append(((root > 0) * (0.1 + 0.8 * value) * 255)[..., None].expand(-1, -1, 3).round().to(torch.uint8))
        coverage.append(((root > 0) * 255).to(torch.uint8))
    return Views(cameras, tuple(images), tuple(coverage), None, None, True, "test")


def mesh_of_rings(vertices: Tensor, normals: Tensor, around: int) -> TriangleMesh:
    """Of rings of `around` vertices, one after the other."""
    ring, place = torch.meshgrid(torch.arange(len(vertices) // around - 1), torch.arange(around), indexing="ij")
    here, beside = (ring * around + place).flatten(), (ring * around + (place + 1) % around).flatten()
    faces = torch.cat([torch.stack([here, here + around, beside], -1), torch.stack([beside, here + around, beside + around], -1)]).int()
    count = len(vertices)
    return TriangleMesh(vertices, faces, normals, torch.full((count, 3), 0.5), torch.full((count,), 0.5), torch.zeros(count))


def tube(along: int = 49, around: int = 96) -> TriangleMesh:
    """The surface itself over x in [-0.6, 0.6]."""
    x, turn = torch.meshgrid(torch.linspace(-0.6, 0.6, along), torch.arange(around) * (2 * math.pi / around), indexing="ij")
    normals = torch.stack([torch.zeros_like(x), turn.sin(), turn.cos()], -1).reshape(-1, 3)
    vertices = torch.stack([x, TUBE * turn.sin(), TUBE * turn.cos()], -1).reshape(-1, 3)
    return mesh_of_rings(vertices, normals, around)


def test_a_tube_as_wide_as_patches_that_lies_right_is_left_there():
    mesh = tube()
    nothing = torch.zeros(len(mesh.vertices))
    found = matched_texture(build_tracer(mesh), mesh.normals, nothing, mesh_edges(mesh.faces), photographs_of_a_tube(), 1.0)
    pixel = FAR / FOCAL
    # What the cameras look down on: farther round they all look from one side, and not at all of a patch.
    asked = (mesh.normals[:, 2] > math.cos(math.radians(30))) & (mesh.vertices[:, 0].abs() < 0.4)
    believed = asked & (found.weight > 0.1)
    off = ((found.places - mesh.vertices) * mesh.normals).sum(-1)[believed] / pixel
    assert float(believed.sum() / asked.sum()) > 0.8
    assert abs(float(off.median())) < 0.2 and float(off.abs().quantile(0.95)) < 0.5, (off.median(), off.abs().quantile(0.95))


BALL = 0.4
"""Radius; an image of far surroundings lies half of it below a mirror's surface."""


def photographs_of_a_mirror() -> Views:
    """A ball around the origin under a pattern that is infinitely far."""
    cameras, images, coverage = cameras_above(), [], []
    row, column = torch.meshgrid(torch.arange(SIZE) + 0.5, torch.arange(SIZE) + 0.5, indexing="ij")
    for camera in cameras:
        rotation, center = camera.camera_from_world[:3, :3], camera.center_world
        ray = torch.stack([(column - SIZE / 2) / FOCAL, (row - SIZE / 2) / FOCAL, torch.ones_like(row)], -1) @ rotation
        ray = torch.nn.functional.normalize(ray, dim=-1)
        half_b = (ray * center).sum(-1)
        root = half_b.square() - (center.square().sum() - BALL**2)
        normal = (center + ray * (-half_b - root.clamp(min=0).sqrt())[..., None]) / BALL
        mirrored = torch.nn.functional.normalize(ray - 2 * (ray * normal).sum(-1, keepdim=True) * normal, dim=-1)
        value = pattern(0.3 * mirrored[..., 0], 0.3 * mirrored[..., 1])
        images.append(((root > 0) * (0.1 + 0.8 * value) * 255)[..., None].expand(-1, -1, 3).round().to(torch.uint8))
        coverage.append(((root > 0) * 255).to(torch.uint8))
    return Views(cameras, tuple(images), tuple(coverage), None, None, True, "test")


def ball(along: int = 64, around: int = 96) -> TriangleMesh:
    """The surface itself, without its poles."""
    tilt, turn = torch.meshgrid(torch.linspace(0.02, 1.4, along), torch.arange(around) * (2 * math.pi / around), indexing="ij")
    normals = torch.stack([tilt.sin() * turn.cos(), tilt.sin() * turn.sin(), tilt.cos()], -1).reshape(-1, 3)
    return mesh_of_rings(BALL * normals, normals, around)


def test_the_image_that_a_ball_mirrors_is_not_believed(monkeypatch: pytest.MonkeyPatch):
    mesh, nothing = ball(), torch.zeros(64 * 96)

    def found():
        return matched_texture(build_tracer(mesh), mesh.normals, nothing, mesh_edges(mesh.faces), photographs_of_a_mirror(), 2.0)

    assert not found().weight.any()
    monkeypatch.setattr(module, "NEAR", 1.0)
    depth = ((found().places - mesh.vertices) * mesh.normals).sum(-1)[found().weight > 0.1]
    assert len(depth) > 500 and abs(float(depth.median()) + BALL / 2) < 0.1 * BALL, (len(depth), depth.median())
