"""What a moving picture sees through the middles of pixels: sixteen rays at once are the rays one by one, and tiles without a surface are told."""

from dataclasses import replace

import pytest
import torch

from drgs.render.intersect.tracer import AbstractTracer
from drgs.render.intersect.tracer_embree import EmbreeTracer
from drgs.render.intersect.tracer_warp import WarpTracer
from drgs.render.progressive.see_middles import Middles, see_middles
from drgs.render.visible.image_tiles import pixels_of_tiles, tile_grid, tile_of_pixels
from drgs.render.visible.trace_primary import trace_primary_points
from drgs.scene.camera import Camera
from drgs.scene.mesh import TriangleMesh
from tests.render.closed_form_scenes import crumpled_mesh, front_camera, two_spheres


def camera_of(width: int, height: int, aside: float = 0.0) -> Camera:
    """Whose picture is no multiple of tiles, nor of blocks of four, and may show a part of what stands before it."""
    camera = front_camera(max(width, height), distance=7.0)
    intrinsics = camera.intrinsics.clone()
    intrinsics[0, 2] += aside
    return Camera(camera.camera_from_world, intrinsics, width, height)


class RayByRay(EmbreeTracer):
    """Final. Without a way to take neighbours at once."""

    kernel_query = replace(EmbreeTracer.kernel_query, block_fn=None)


def seen_both_ways(mesh: TriangleMesh, camera: Camera) -> tuple[Middles, Middles]:
    everywhere = all_tiles(camera)
    return see_middles(EmbreeTracer(mesh), camera, everywhere), see_middles(RayByRay(mesh), camera, everywhere)


def all_tiles(camera: Camera) -> torch.Tensor:
    across, down = tile_grid(camera.width, camera.height)
    return torch.ones(across * down, dtype=torch.bool)


def assert_close(found: object, wanted: object) -> None:
    for name, values in vars(wanted).items():
        if isinstance(values, torch.Tensor):
            torch.testing.assert_close(getattr(found, name), values, rtol=1e-5, atol=1e-5, msg=lambda said, name=name: f"{name}: {said}")


@pytest.mark.parametrize("mesh", [two_spheres(), crumpled_mesh()], ids=["spheres", "crumpled"])
@pytest.mark.parametrize(("width", "height", "aside"), [(64, 64, 0.0), (45, 70, 11.3), (30, 21, -16.0)])
def test_sixteen_rays_at_once_see_what_single_rays_see(mesh: TriangleMesh, width: int, height: int, aside: float) -> None:
    at_once, one_by_one = seen_both_ways(mesh, camera_of(width, height, aside))
    assert torch.equal(at_once.primary.points.pixel, one_by_one.primary.points.pixel) and len(at_once.primary.depth) > 50
    # Two faces' common edge belongs to either of them.
    same = at_once.primary.starts.face == one_by_one.primary.starts.face
    assert float(same.float().mean()) > 0.98
    assert_close(at_once.primary.points, one_by_one.primary.points)
    assert_close(at_once.surface, one_by_one.surface)
    torch.testing.assert_close(at_once.primary.depth, one_by_one.primary.depth, rtol=1e-5, atol=1e-5)
    for name in ("origin_world", "surface_normal_world"):
        found, wanted = (getattr(seen.primary.starts, name)[same] for seen in (at_once, one_by_one))
        torch.testing.assert_close(found, wanted, rtol=1e-5, atol=1e-5)
    assert torch.equal(at_once.tiles, one_by_one.tiles) and at_once.window == one_by_one.window


@pytest.mark.parametrize("tracer", [RayByRay(crumpled_mesh()), WarpTracer(crumpled_mesh())], ids=["embree", "warp"])
def test_single_rays_are_those_of_a_picture_without_jitter(tracer: AbstractTracer) -> None:
    camera = camera_of(45, 70, 11.3)
    seen = see_middles(tracer, camera, all_tiles(camera)).primary
    wanted = trace_primary_points(
        tracer, camera, 0, 0, jitter=False, pixels=pixels_of_tiles(all_tiles(camera), camera.width, camera.height)
    )
    assert torch.equal(seen.points.pixel, wanted.points.pixel) and len(seen.depth) > 50
    assert torch.equal(seen.starts.face, wanted.starts.face)
    assert_close(seen.points, wanted.points)
    assert_close(seen.starts, wanted.starts)
    torch.testing.assert_close(seen.depth, wanted.depth)


def test_tiles_that_show_something_are_told_and_places_are_the_points_numbers() -> None:
    camera = camera_of(45, 70, 11.3)
    for seen in seen_both_ways(two_spheres(), camera):
        shows = torch.zeros_like(seen.tiles)
        shows[tile_of_pixels(seen.primary.points.pixel, camera.width)] = True
        assert torch.equal(seen.tiles, shows) and not bool(shows.all())
        covered = seen.surface.coverage > 0
        assert seen.place.shape == covered.shape == seen.window.shape
        assert torch.equal(seen.place[covered], torch.arange(1, len(seen.primary.depth) + 1, dtype=torch.int32))
        rows, columns = torch.nonzero(covered).unbind(-1)
        pixel = (rows + seen.window.rows.start) * camera.width + columns + seen.window.columns.start
        assert torch.equal(pixel.int(), seen.primary.points.pixel)


def test_where_nothing_is_seen_one_tile_says_so() -> None:
    for seen in seen_both_ways(two_spheres(), camera_of(40, 40, 500.0)):
        assert len(seen.primary.depth) == 0 and int(seen.tiles.sum()) == 1
        assert seen.surface.coverage.shape == (16, 16) and not bool(seen.surface.coverage.any())
        assert bool(seen.surface.depth.isinf().all())
