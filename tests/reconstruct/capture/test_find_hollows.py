"""A bowl beside a ball: the bowl's hull is a drum, and only what is painted on its floor tells that it is hollow."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from torch import Tensor

from drgs.reconstruct.capture import find_hollows as module
from drgs.reconstruct.capture.find_hollows import CHOSEN_MESH, FIELD_MESH, HollowSettings, find_hollows
from drgs.reconstruct.capture.initial_points import initial_points
from drgs.reconstruct.capture.radiance_grid import RadianceGrid, RadianceGridSettings, Rays, fit_radiance_grid
from drgs.reconstruct.capture.turning_light import with_light_of_camera
from drgs.reconstruct.capture.visual_hull import VisualHull, VisualHullSettings, visual_hull
from drgs.reference.ray_costs import samples_along
from drgs.render.intersect.trace_rays import build_tracer, trace_rays
from drgs.render.intersect.tracer import AbstractTracer
from drgs.scene.camera import Camera, pixel_rays_world
from drgs.scene.mesh import TriangleMesh, vertex_normals
from drgs.scene.views import Views
from tests.reconstruct.tiny_capture import camera_positions, look_at

SIDE = 72
CPU = torch.device("cpu")
SETTINGS = HollowSettings(
    RadianceGridSettings(levels=((24, 60), (40, 70)), rays_a_step=512),
    pixels=3000,
    field_mesh=replace(FIELD_MESH, resolution=64),
    chosen_mesh=replace(CHOSEN_MESH, resolution=80),
    rounds=1,
)
FEWER = replace(SETTINGS, grid=replace(SETTINGS.grid, levels=((20, 40), (32, 50)), rays_a_step=384), pixels=1500)
"""Enough for a mirror: the field lies far below its surface all the same, and would empty all of it were it believed."""
RIM, FLOOR = 0.35, -0.05
"""Heights; the bowl's inner radius is 0.45."""
BALL = (0.9, 0.0, 0.0)
BALL_RADIUS = 0.15


def tracer_of(mesh: trimesh.Trimesh) -> AbstractTracer:
    vertices, faces = torch.from_numpy(np.asarray(mesh.vertices, np.float32)), torch.from_numpy(np.asarray(mesh.faces, np.int32))
    plain = torch.zeros(len(vertices))
    return build_tracer(TriangleMesh(vertices, faces, vertex_normals(vertices, faces), plain[:, None].repeat(1, 3), plain, plain))


def bowl_and_ball() -> AbstractTracer:
    wall = trimesh.creation.annulus(r_min=0.45, r_max=0.65, height=2 * RIM)
    floor = trimesh.creation.cylinder(radius=0.5, height=RIM + FLOOR)
    floor.apply_translation([0, 0, (FLOOR - RIM) / 2])
    ball = trimesh.creation.icosphere(3, radius=BALL_RADIUS)
    ball.apply_translation(BALL)
    return tracer_of(trimesh.util.concatenate([wall, floor, ball]))


def paint(place: Tensor, normal: Tensor, direction: Tensor) -> Tensor:
    """Alike from all sides."""
    return 0.5 + 0.35 * torch.sin(9 * place + torch.tensor([0.0, 1.0, 2.0]))


def mirror(place: Tensor, normal: Tensor, direction: Tensor) -> Tensor:
    """Of a room with stripes."""
    reflected = direction - 2 * (direction * normal).sum(-1, keepdim=True) * normal
    return 0.5 + 0.35 * torch.sin(7 * reflected + torch.tensor([0.0, 1.0, 2.0]))


def lit_from_the_camera(place: Tensor, normal: Tensor, direction: Tensor) -> Tensor:
    """Paint under a lamp above the camera, which turns with it."""
    lamp = torch.nn.functional.normalize(torch.tensor([0.0, 0.0, 0.7]) - direction, dim=-1)
    return (0.25 + 0.75 * (normal * lamp).sum(-1, keepdim=True).clamp(min=0)) * paint(place, normal, direction)


def photographed(object_: AbstractTracer, shade: Callable[[Tensor, Tensor, Tensor], Tensor], count: int = 48, side: int = SIDE) -> Views:
    cameras, images, masks = [], [], []
    for position in camera_positions(count):
        position = position * np.array([1, 1, 0.8])
        pose = torch.from_numpy(look_at(position)).float()
        focal = 100 * side / SIDE
        intrinsics = torch.tensor([[focal, 0, side / 2], [0, focal, side / 2], [0, 0, 1]])
        camera = Camera(pose, intrinsics, side, side, str(len(cameras)))
        origin, directions = pixel_rays_world(camera)
        direction = torch.nn.functional.normalize(directions.reshape(-1, 3), dim=-1).contiguous()
        hits = trace_rays(origin.expand_as(direction).contiguous(), direction, object_)
        place = origin + hits.distance.nan_to_num(posinf=0.0)[:, None] * direction
        color = shade(place, object_.face_normals[hits.face.long().clamp(min=0)], direction)
        images.append((255 * color.clamp(0, 1)).to(torch.uint8).reshape(side, side, 3))
        masks.append((255 * hits.hit).to(torch.uint8).reshape(side, side))
        cameras.append(camera)
    return Views(tuple(cameras), tuple(images), tuple(masks), None, None, True, "nerf-synthetic")


def height_inside(vertices: np.ndarray, faces: np.ndarray) -> float:
    """Of the surface, looked at from above within the bowl, in the median."""
    angle, radius = np.meshgrid(np.linspace(0, 2 * np.pi, 24), np.linspace(0.02, 0.35, 8))
    above = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full_like(radius, 2.0)], -1).reshape(-1, 3)
    rays = torch.from_numpy(above.astype(np.float32))
    down = torch.tensor([0.0, 0, -1]).expand_as(rays).contiguous()
    hits = trace_rays(rays, down, tracer_of(trimesh.Trimesh(vertices, faces, process=False)))
    return float((2 - hits.distance).median())


@pytest.fixture(scope="module")
def painted() -> Views:
    return photographed(bowl_and_ball(), paint)


@pytest.fixture(scope="module")
def drum(painted: Views) -> VisualHull:
    """The hull of what is painted."""
    hull = visual_hull(painted)
    assert hull is not None
    return hull


@pytest.mark.slow
def test_a_painted_hollow_is_found_and_points_start_in_it(painted: Views, drum: VisualHull) -> None:
    filled = height_inside(drum.vertices_world, drum.faces)
    assert filled > RIM - 0.1
    told: list[float] = []
    found = find_hollows(painted, drum, SETTINGS, 0, CPU, told.append)
    assert found is not None
    assert told and told == sorted(told) and told[-1] <= 1
    emptied = height_inside(found.vertices_world, found.faces)
    assert abs(emptied - FLOOR) < 0.25 * (filled - FLOOR)
    # What hangs apart stays.
    from_ball = np.linalg.norm(found.vertices_world - np.array(BALL), axis=1)
    assert (np.abs(from_ball - BALL_RADIUS) < 0.04).sum() > 100
    points = initial_points(painted, 2000, 0, found).points_world
    within = (points[:, :2].norm(dim=1) < 0.35) & (points[:, 2] > FLOOR - 0.15)
    assert float(points[within, 2].median()) < FLOOR + 0.15


@pytest.mark.slow
def test_a_painted_hollow_is_found_under_light_that_turns_with_the_camera(drum: VisualHull) -> None:
    turned = photographed(bowl_and_ball(), lit_from_the_camera)
    found = find_hollows(with_light_of_camera(turned), drum, SETTINGS, 0, CPU)
    assert found is not None
    filled = height_inside(drum.vertices_world, drum.faces)
    assert abs(height_inside(found.vertices_world, found.faces) - FLOOR) < 0.25 * (filled - FLOOR)


@pytest.mark.slow
def test_a_mirror_keeps_its_hull() -> None:
    ball = photographed(tracer_of(trimesh.creation.icosphere(4, radius=0.6)), mirror, 24)
    hull = visual_hull(ball, VisualHullSettings(fine_cells=96))
    assert hull is not None
    assert find_hollows(ball, hull, FEWER, 0, CPU) is hull


@pytest.mark.slow
def test_a_search_that_is_stopped_finds_nothing(painted: Views, drum: VisualHull) -> None:
    assert find_hollows(painted, drum, SETTINGS, 0, CPU, should_stop=lambda: True) is None


@pytest.mark.slow
def test_photographs_in_which_nothing_is_solid_keep_the_hull(painted: Views, drum: VisualHull) -> None:
    assert find_hollows(replace(painted, coverage=tuple(mask // 2 for mask in painted.coverage)), drum, SETTINGS, 0, CPU) is drum


@pytest.mark.parametrize(("founds", "looks", "last"), [("ab", 2, "b"), ("aa", 2, "a"), ("0", 1, "0"), ("abc", 3, "c"), ("aN", 2, None)])
def test_behind_what_was_found_is_looked_again(
    monkeypatch: pytest.MonkeyPatch, painted: Views, founds: str, looks: int, last: str | None
) -> None:
    hulls = {name: VisualHull(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int64), 1.0) for name in "0abc"}
    asked: list[tuple[VisualHull, int]] = []
    told: list[float] = []

    def look(
        views: Views, hull: VisualHull, settings: HollowSettings, seed: int, device: torch.device, report: Callable, _: None
    ) -> VisualHull | None:
        asked.append((hull, seed))
        report(0.5)
        return hulls.get(founds[len(asked) - 1])

    monkeypatch.setattr(module, "_look_behind", look)
    rounds = max(2, len(founds))
    found = find_hollows(painted, hulls["0"], replace(SETTINGS, rounds=rounds), 7, CPU, told.append)
    assert found is (None if last is None else hulls[last])
    assert [hull is hulls[name] for hull, name in zip((hull for hull, _ in asked), "0" + founds, strict=False)] == looks * [True]
    assert [seed for _, seed in asked] == list(range(7, 7 + looks))
    assert told == [(k + 0.5) / rounds for k in range(looks)]


def constant_grid(density: float, inside: float = 1.0) -> RadianceGrid:
    cells = 9
    return RadianceGrid(
        torch.full((3,), -1.0),
        0.25,
        torch.full((cells,) * 3, density),
        torch.full((cells,) * 3, inside),
        torch.zeros(2, 12),
        torch.ones(cells**3, dtype=torch.long),
    )


def test_light_falls_off_by_beer_s_law_and_the_median_depth_follows() -> None:
    density = 1.3
    grid = constant_grid(float(torch.tensor(density).expm1().log()))  # softplus of it, a cell
    rays = Rays(torch.tensor([[-0.5, 0.0, 0.0]]), torch.tensor([[1.0, 0, 0]]), torch.tensor([0.25]), torch.tensor([0.75]))
    offsets = (torch.arange(400) + 0.5)[None] / 400
    distance, places, weights = samples_along(grid, rays, offsets)
    length = 0.5 + 2 * 0.25  # a cell longer at both ends
    assert float(weights.sum()) == pytest.approx(1 - np.exp(-density * length / 0.25), rel=1e-3)
    assert torch.allclose(places[0, :, 0], distance[0] - 0.5)
    median, spread = grid.depths(rays)
    assert float(median) == pytest.approx(np.log(2) / density * 0.25, abs=length / 160)
    assert 0 < float(spread) < length
    assert torch.isinf(constant_grid(-20.0).depths(rays)[0]).all()
    assert torch.isinf(constant_grid(5.0, inside=0.0).depths(rays)[0]).all()


@pytest.mark.slow
def test_what_is_told_is_deterministic(painted: Views) -> None:
    settings = replace(SETTINGS.grid, levels=((12, 6), (16, 4)), rays_a_step=64)
    generator = torch.Generator().manual_seed(3)
    direction = torch.nn.functional.normalize(torch.randn(200, 3, generator=generator), dim=-1)
    rays = Rays(-2 * direction, direction, torch.full((200,), 1.4), torch.full((200,), 2.6))
    box = torch.full((3,), -0.6), torch.full((3,), 0.6)
    grids = [fit_radiance_grid(rays, 0.5 + 0.4 * direction, box, lambda p: p.norm(dim=1) < 0.6, settings, seed) for seed in (1, 1, 2)]
    first, again, other = (grid.density for grid in grids if grid is not None)
    assert torch.equal(first, again) and not torch.equal(first, other)
