"""A cup whose inside is plain is a drum to its silhouettes, and what is seen through its rim tells that it is none; curved mirrors, that show things behind
themselves as well, stay what they are.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from scipy import ndimage
from torch import Tensor

from drgs.reconstruct import stages
from drgs.reconstruct.capture import open_vessels as module
from drgs.reconstruct.capture.find_hollows import HollowSettings
from drgs.reconstruct.capture.initial_points import InitialPoints, initial_points
from drgs.reconstruct.capture.open_vessels import VesselSettings, open_vessels
from drgs.reconstruct.capture.radiance_grid import RadianceGridSettings
from drgs.reconstruct.capture.visual_hull import VisualHull, VisualHullSettings, visual_hull
from drgs.reconstruct.presets import PRESETS
from drgs.reconstruct.report_progress import BuildReporter
from drgs.render.intersect.trace_rays import trace_rays
from drgs.render.intersect.tracer import AbstractTracer
from drgs.scene.views import Views
from tests.reconstruct.capture.test_find_hollows import CPU, photographed, tracer_of

HEIGHT, INNER, OUTER, FLOOR = 0.9, 0.42, 0.55, 0.1
FLOOR_Z = FLOOR - HEIGHT / 2
HULL = VisualHullSettings(fine_cells=96)
SETTINGS = VesselSettings(nodes=56)
LAMPS = torch.nn.functional.normalize(torch.tensor([[1.0, 0.2, 0.7], [-0.3, 0.8, 0.5], [-0.6, -0.7, 0.4], [0.1, -0.2, 1.0]]), dim=1)
POWERS = torch.tensor([[0.5, 0.45, 0.4], [0.2, 0.25, 0.3], [0.25, 0.2, 0.2], [0.3, 0.3, 0.3]])

Shade = Callable[[Tensor, Tensor, Tensor], Tensor]


def cup() -> trimesh.Trimesh:
    wall = trimesh.creation.annulus(r_min=INNER, r_max=OUTER, height=HEIGHT)
    floor = trimesh.creation.cylinder(radius=INNER + 0.05, height=FLOOR)
    floor.apply_translation([0, 0, (FLOOR - HEIGHT) / 2])
    return trimesh.util.concatenate([wall, floor])


def plain(object_: AbstractTracer) -> Shade:
    """White, alike from all sides, under a sky with a bright side, as far as the object itself does not hide it."""
    sky = torch.nn.functional.normalize(torch.randn(24, 3, generator=torch.Generator().manual_seed(5)), dim=1)
    power = (0.3 + 0.7 * (1 + sky @ torch.tensor([[0.6, 0.3, 0.2], [0.3, 0.4, 0.2], [0.6, 0.7, 0.8]])).clamp(min=0)) / 24

    def shade(place: Tensor, normal: Tensor, direction: Tensor) -> Tensor:
        start = (place + 1e-3 * normal).contiguous()
        light = torch.full_like(place, 0.1)
        for toward, radiance in zip(sky, power, strict=True):
            free = ~trace_rays(start, toward.expand_as(place).contiguous(), object_).hit
            light = light + (free * (normal @ toward).clamp(min=0))[:, None] * radiance
        return light

    return shade


def satin(place: Tensor, normal: Tensor, direction: Tensor) -> Tensor:
    """Metal that mirrors the lamps as wide lobes."""
    reflected = direction - 2 * (direction * normal).sum(-1, keepdim=True) * normal
    return 0.1 + 2 * torch.exp(6 * ((reflected @ LAMPS.T) - 1)) @ POWERS


def heights(vertices: np.ndarray, faces: np.ndarray, radii: tuple[float, ...]) -> np.ndarray:
    """Of the surface from above, median around the axis at each radius."""
    surface = tracer_of(trimesh.Trimesh(vertices, faces, process=False))
    angle = torch.linspace(0, 6.2, 40)
    found = []
    for radius in radii:
        above = torch.stack([radius * angle.cos(), radius * angle.sin(), torch.full_like(angle, 2.0)], -1).contiguous()
        down = torch.tensor([0.0, 0, -1]).expand_as(above).contiguous()
        found.append(float((2 - trace_rays(above, down, surface).distance).median()))
    return np.array(found)


def hull_of(views: Views) -> VisualHull:
    hull = visual_hull(views, HULL)
    assert hull is not None
    return hull


@pytest.fixture(scope="module")
def white_cup() -> Views:
    object_ = tracer_of(cup())
    return photographed(object_, plain(object_), 32, 96)


@pytest.fixture(scope="module")
def drum(white_cup: Views) -> VisualHull:
    """Its hull."""
    return hull_of(white_cup)


@pytest.fixture(scope="module")
def opened(white_cup: Views, drum: VisualHull) -> VisualHull:
    return open_vessels(white_cup, drum, SETTINGS, CPU)


@pytest.mark.slow
def test_a_plain_cup_is_open_as_deep_and_as_wide_as_it_is(drum: VisualHull, opened: VisualHull) -> None:
    assert heights(drum.vertices_world, drum.faces, (0.1,))[0] > HEIGHT / 2 - 0.05
    assert opened is not drum
    mesh = trimesh.Trimesh(opened.vertices_world, opened.faces, process=False)
    assert mesh.is_watertight and mesh.volume > 0
    inside, wall = heights(opened.vertices_world, opened.faces, (0.05, 0.2, 0.32)), heights(opened.vertices_world, opened.faces, (0.51,))
    assert np.abs(inside - FLOOR_Z).max() < 0.15 * HEIGHT
    assert wall[0] > HEIGHT / 2 - 0.06
    # Outside nothing has moved.
    far = np.linalg.norm(opened.vertices_world[:, :2], axis=1) > OUTER - 0.01
    assert far.sum() > 500 and np.abs(np.linalg.norm(opened.vertices_world[far][:, :2], axis=1) - OUTER).max() < 0.04


@pytest.mark.slow
@pytest.mark.parametrize("shape", ["ball", "drum"])
def test_satin_metal_stays_as_it_is(shape: str) -> None:
    mesh = trimesh.creation.icosphere(4, radius=0.6) if shape == "ball" else trimesh.creation.cylinder(radius=0.5, height=0.9)
    views = photographed(tracer_of(mesh), satin, 32)
    hull = hull_of(views)
    assert open_vessels(views, hull, SETTINGS, CPU) is hull


@pytest.mark.slow
def test_without_walls_to_try_and_without_solid_pixels_the_hull_is_kept(white_cup: Views, drum: VisualHull) -> None:
    assert open_vessels(white_cup, drum, replace(SETTINGS, walls=()), CPU) is drum
    thin = replace(white_cup, coverage=tuple((mask // 2).clamp(min=1) for mask in white_cup.coverage))
    assert open_vessels(thin, drum, SETTINGS, CPU) is drum


@pytest.mark.slow
def test_a_build_begins_inside_and_looks_behind_what_was_opened(
    white_cup: Views, opened: VisualHull, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    points = initial_points(white_cup, 3000, 0, hull_settings=HULL)
    place = stages.Workplace(tmp_path, {"seed": "0"}, False, BuildReporter(None, {"read": 1.0}), lambda: False)
    nothing_more = HollowSettings(RadianceGridSettings(levels=()))
    preset = replace(PRESETS["draft"], points=3000, vessels=SETTINGS, hull=HULL, hollows=nothing_more)
    found = stages.hollows_stage(place, white_cup, points, preset, 0, CPU, None)

    def share_inside(of: InitialPoints) -> float:
        within = (of.points_world[:, :2].norm(dim=1) < INNER + 0.03) & (of.points_world[:, 2].abs() < HEIGHT / 2 - 0.05)
        return float(within.float().mean())

    assert share_inside(points) == 0 and share_inside(found) > 0.25
    assert found.bounds_radius == points.bounds_radius
    same = initial_points(white_cup, 3000, 0, opened, hull_settings=HULL)
    assert torch.equal(found.points_world, same.points_world) and torch.equal(found.colors_srgb, same.colors_srgb)

    looked_behind: list[VisualHull] = []
    monkeypatch.setattr(stages, "open_vessels", lambda *_: opened)
    monkeypatch.setattr(stages, "find_hollows", lambda views, hull, *_: looked_behind.append(hull) or hull)
    both = stages.hollows_stage(place, white_cup, points, replace(preset, hollows=HollowSettings()), 0, CPU, None)
    assert looked_behind == [opened] and torch.equal(both.points_world, found.points_world)
    kept = stages.hollows_stage(replace(place, resume=True), white_cup, points, preset, 0, CPU, None)
    assert torch.equal(kept.points_world, found.points_world)


def test_a_vessel_is_one_room_without_what_is_much_narrower_and_without_rooms_that_it_does_not_open() -> None:
    places = np.stack(np.meshgrid(*3 * [np.linspace(-1, 1, 65)], indexing="ij"), -1)
    room = np.linalg.norm(places, axis=-1) < 0.5
    tunnel = np.linalg.norm(places[..., 1:], axis=-1) < 0.05
    apart = np.linalg.norm(places - [0, 0, -0.8], axis=-1) < 0.15
    cell = 2 / 64
    wall = cell * ndimage.distance_transform_edt(room | tunnel | apart)
    entry = np.linalg.norm(places - [0, 0, 0.45], axis=-1) < 0.06
    behind = module._Behind(depth=0.5 - places[..., 2], wall=wall, below_lid=entry, deepest=2.0, cell=cell)
    open_ = behind.empty(0.03, 10.0) > 0
    well_inside = np.linalg.norm(places, axis=-1) < 0.42
    assert open_[well_inside].all() and not open_[np.linalg.norm(places, axis=-1) > 0.56].any()
    assert behind.empty(0.0, 10.0)[tunnel & (np.abs(places[..., 0]) > 0.6)].max() <= 0 and tunnel[:5, 32, 32].all()
    shallow = behind.empty(0.03, 0.6) > 0
    assert (shallow == (open_ & (places[..., 2] > -0.1))).mean() > 0.99
