"""A tray with walls of two widths and a block in it is full to its silhouettes; what is seen through its rim tells where it is not."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh

from drgs.reconstruct.capture import open_vessels as module
from drgs.reconstruct.capture.find_pit import Pit, PitSettings
from drgs.reconstruct.capture.open_vessels import VesselSettings, open_vessels
from drgs.reconstruct.capture.visual_hull import VisualHull
from drgs.render.intersect.trace_rays import trace_rays
from drgs.scene.views import Views
from tests.reconstruct.capture.test_find_hollows import CPU, photographed, tracer_of
from tests.reconstruct.capture.test_open_vessels import hull_of, plain, satin

HALF = np.array([0.6, 0.45, 0.16])
FLOOR_Z, RIM_Z = -0.1, 0.16
ALONG, ACROSS = 0.42, 0.33
"""Half of the room's sides."""
SETTINGS = VesselSettings(nodes=72, bounded=2.0)
"""Whatever runs around a lid, it is no vessel's."""


def block(low: tuple[float, float, float], high: tuple[float, float, float]) -> trimesh.Trimesh:
    made = trimesh.creation.box(np.subtract(high, low))
    made.apply_translation(np.add(low, high) / 2)
    return made


def tray() -> trimesh.Trimesh:
    return trimesh.util.concatenate([tray_without_block(), block((0.12, -0.12, -HALF[2]), (0.32, 0.12, 0.1))])


def tray_without_block() -> trimesh.Trimesh:
    x, y, z = HALF
    walls = [block((-x, -y, -z), (-ALONG, y, z)), block((ALONG, -y, -z), (x, y, z))]
    walls += [block((-x, -y, -z), (x, -ACROSS, z)), block((-x, ACROSS, -z), (x, y, z))]
    return trimesh.util.concatenate([*walls, block((-x, -y, -z), (x, y, FLOOR_Z))])


@pytest.fixture(scope="module")
def white_tray() -> Views:
    object_ = tracer_of(tray())
    return photographed(object_, plain(object_), 32, 96)


@pytest.fixture(scope="module")
def solid(white_tray: Views) -> VisualHull:
    return hull_of(white_tray)


def height_at(hull: VisualHull, x: float, y: float) -> float:
    """Median from above, of a small square around the place."""
    surface = tracer_of(trimesh.Trimesh(hull.vertices_world, hull.faces, process=False))
    aside = torch.linspace(-0.04, 0.04, 5)
    above = torch.stack([*(along.flatten() for along in torch.meshgrid(x + aside, y + aside, indexing="ij")), torch.full((25,), 2.0)], -1)
    down = torch.tensor([0.0, 0, -1]).expand_as(above).contiguous()
    return float((2 - trace_rays(above.contiguous(), down, surface).distance).median())


@pytest.mark.slow
def test_a_tray_is_open_but_for_its_walls_and_the_block_in_it(white_tray: Views, solid: VisualHull) -> None:
    opened = open_vessels(white_tray, solid, SETTINGS, CPU)
    assert opened is not solid
    mesh = trimesh.Trimesh(opened.vertices_world, opened.faces, process=False)
    assert mesh.is_watertight and mesh.volume > 0
    room = ((-0.25, 0.0), (-0.2, 0.2), (-0.2, -0.2))
    before, after = ([height_at(hull, *place) for place in room] for hull in (solid, opened))
    assert min(before) > 0.1 and max(np.abs(np.subtract(after, FLOOR_Z))) < 0.08
    assert height_at(opened, 0.22, 0.0) > 0.02
    walls = ((-0.52, 0.0), (0.52, 0.0), (0.0, 0.4), (0.0, -0.4))
    assert min(height_at(opened, *place) for place in walls) > RIM_Z - 0.06


@pytest.mark.slow
@pytest.mark.parametrize(
    ("shape", "promising"),
    [("ball", PitSettings().promising), ("drum", PitSettings().promising), ("ball", (1.0, 1.0))],
    ids=["ball", "drum", "ball, searched to the end"],
)
def test_what_satin_metal_mirrors_is_no_pit_for_it_has_no_rim(
    shape: str, promising: tuple[float, float], monkeypatch: pytest.MonkeyPatch
) -> None:
    mesh = trimesh.creation.icosphere(4, radius=0.6) if shape == "ball" else trimesh.creation.cylinder(radius=0.5, height=0.9)
    views = photographed(tracer_of(mesh), satin, 32)
    hull = hull_of(views)
    asked = []
    find = module.find_pit
    monkeypatch.setattr(module, "find_pit", lambda *given: asked.append(find(*given)) or asked[-1])
    assert open_vessels(views, hull, replace(SETTINGS, pits=PitSettings(promising=promising)), CPU) is hull
    assert asked


@pytest.mark.slow
def test_small_lids_are_not_asked(white_tray: Views, solid: VisualHull, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "find_pit", None)  # would fail
    assert open_vessels(white_tray, solid, replace(SETTINGS, pits=PitSettings(least_lid=1.1)), CPU) is solid


def test_a_pit_holds_what_is_below_its_lid_and_above_its_floor() -> None:
    depth = np.zeros((4, 3))
    depth[1, 1], depth[2, 1] = 0.5, 0.2
    pit = Pit(np.eye(3), np.array([-0.2, -0.15]), 0.1, np.full((4, 3), 1.0), depth, depth > 0)
    places = np.array(
        [[-0.05, 0, 0.6], [-0.05, 0, 0.4], [0.05, 0, 0.9], [0.05, 0, 0.7], [0.05, 0, 1.05], [0.05, 0, 1.3], [0.15, 0, 0.95], [9, 9, 0.9]]
    )
    assert pit.holds(places[:, None, None], 0.1).ravel().tolist() == [True, False, True, False, True, False, False, False]


def test_a_pit_is_full_where_views_do_not_agree() -> None:
    depth = np.full((2, 2), 0.5)
    pit = Pit(np.eye(3), np.zeros(2), 1.0, np.ones((2, 2)), depth, np.array([[True, False], [False, True]]))
    assert pit.where_alike().depth.tolist() == [[0.5, 0.0], [0.0, 0.5]]


@pytest.mark.slow
def test_a_mirror_that_stands_in_a_tray_is_not_dug_out() -> None:
    """A pit explains what it mirrors better than its hull does, and the rest of the tray is one."""
    ball = trimesh.creation.icosphere(3, radius=0.17)
    ball.apply_translation([0.0, 0.0, 0.05])
    whole = trimesh.util.concatenate([tray_without_block(), ball])
    object_ = tracer_of(whole)
    paint = plain(object_)

    def shade(place: torch.Tensor, normal: torch.Tensor, direction: torch.Tensor) -> torch.Tensor:
        on_ball = (place - torch.tensor([0.0, 0.0, 0.05])).norm(dim=1, keepdim=True) < 0.18
        return torch.where(on_ball, satin(place, normal, direction), paint(place, normal, direction))

    views = photographed(object_, shade, 32, 96)
    hull = hull_of(views)
    dug, opened = (
        open_vessels(views, hull, replace(SETTINGS, pits=PitSettings(unlike=unlike)), CPU) for unlike in (9.0, PitSettings().unlike)
    )
    assert dug is not hull and opened is not hull
    tops = [height_at(surface, 0.0, 0.0) for surface in (dug, opened)]
    assert tops[0] < 0.19 and abs(tops[1] - 0.22) < 0.01, tops
    floor = [height_at(opened, x, y) for x in (-0.32, 0.32) for y in (-0.2, 0.2)]
    assert float(np.median(floor)) < 0.08 and min(height_at(hull, x, y) for x in (-0.32, 0.32) for y in (-0.2, 0.2)) > 0.14, floor
