"""Tiles that a mesh may be seen in: all that are hit, and hardly more."""

import pytest
import torch

from drgs.render.intersect.trace_rays import build_tracer
from drgs.render.visible.image_tiles import pixels_of_tiles, tile_grid, tile_of_pixels, tiles_of_box, tiles_of_mesh
from drgs.render.visible.trace_primary import trace_primary_points
from drgs.scene.camera import Camera
from tests.render.closed_form_scenes import front_camera, sphere_mesh, two_spheres


def shifted(camera: Camera, x: float, y: float) -> Camera:
    intrinsics = camera.intrinsics.clone()
    intrinsics[0, 2] += x
    intrinsics[1, 2] += y
    return Camera(camera.camera_from_world, intrinsics, camera.width, camera.height)


@pytest.mark.parametrize("shift", [(0.0, 0.0), (37.3, -50.1), (500.0, 0.0)])
def test_no_ray_of_a_tile_left_out_meets_the_mesh(shift: tuple[float, float]) -> None:
    mesh, camera = two_spheres(), shifted(front_camera(100, distance=12), *shift)
    tiles = tiles_of_mesh(mesh, camera)
    everywhere = torch.arange(100 * 100, dtype=torch.int32)
    hit = torch.zeros(len(tiles), dtype=torch.bool)
    for index in range(4):
        points = trace_primary_points(build_tracer(mesh), camera, 1, index, pixels=everywhere).points
        hit[tile_of_pixels(points.pixel, 100)] = True
    assert not bool((hit & ~tiles).any())
    assert int((tiles & ~hit).sum()) <= 0.25 * int(tiles.sum()) + 1


def test_tiles_are_those_of_the_triangles_boxes() -> None:
    mesh, camera = two_spheres(), shifted(front_camera(100, distance=5), 30.0, -20.0)
    in_camera = mesh.vertices.double() @ camera.camera_from_world[:3, :3].T.double() + camera.camera_from_world[:3, 3].double()
    on_screen = in_camera @ camera.intrinsics.double().T
    corners = (on_screen[:, :2] / on_screen[:, 2:])[mesh.faces.long()]
    expected = torch.zeros(7, 7, dtype=torch.bool)
    for low, high in zip((corners.amin(1) / 16).floor().int().tolist(), (corners.amax(1) / 16).floor().int().tolist(), strict=True):
        expected[max(low[1], 0) : max(high[1] + 1, 0), max(low[0], 0) : max(high[0] + 1, 0)] = True
    assert torch.equal(tiles_of_mesh(mesh, camera), expected.reshape(-1))


def test_a_mesh_around_the_camera_may_be_seen_anywhere_and_one_behind_nowhere() -> None:
    assert bool(tiles_of_mesh(sphere_mesh(), front_camera(40, distance=0.5)).all())
    assert not bool(tiles_of_mesh(sphere_mesh(), front_camera(40, distance=-4.0)).any())


@pytest.mark.parametrize("shift", [(0.0, 0.0), (37.3, -50.1), (500.0, 0.0)])
def test_the_tiles_of_a_meshs_box_are_a_rectangle_around_its_own(shift: tuple[float, float]) -> None:
    mesh, camera = two_spheres(), shifted(front_camera(100, distance=12), *shift)
    tiles, wider = tiles_of_mesh(mesh, camera), tiles_of_box(mesh, camera)
    assert not bool((tiles & ~wider).any()) and int(wider.sum()) <= int(tiles.sum()) + 8
    rows, columns = (wider.view(7, 7).any(axis) for axis in (1, 0))
    assert torch.equal(wider.view(7, 7), rows[:, None] & columns)
    assert bool(tiles_of_box(mesh, front_camera(40, distance=0.5)).all())


def test_pixels_of_tiles_cover_an_image_that_is_no_multiple_of_them() -> None:
    across, down = tile_grid(37, 50)
    assert (across, down) == (3, 4)
    tiles = torch.zeros(12, dtype=torch.bool)
    tiles[5] = tiles[11] = True
    pixels = pixels_of_tiles(tiles, 37, 50)
    assert set(tile_of_pixels(pixels, 37).tolist()) == {5, 11} and len(pixels) == 5 * 16 + 5 * 2
    assert torch.equal(pixels, pixels.sort().values)
