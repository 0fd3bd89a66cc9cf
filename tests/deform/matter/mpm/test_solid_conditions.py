"""Meshes that matter collides with: as planes and boxes do, where they are planes and boxes."""

import math

import pytest
import torch
import trimesh

from drgs.deform.matter.measure_solid import distances_from_solid, measure_solid, read_collider, solid_around
from drgs.deform.matter.mpm import Box, Condition, GridSettings, Material, MpmSettings, Plane, Sphere, advance, make_model, rest_state

DX = 1 / 16


def mesh_box(minimum, maximum):
    box = trimesh.creation.box(bounds=[minimum, maximum])
    return torch.tensor(box.vertices, dtype=torch.float32), torch.tensor(box.faces, dtype=torch.int32)


def block(shape, effect="separate", friction=0.0, gravity=(0.0, 0.0, -9.81), velocity=(0.0, 0.0, 0.0), own=(0.0, 0.0, 0.0), clearance=0.0):
    """A block of 6^3 particles above z = 0.2, and one condition."""
    steps = (torch.arange(6) + 0.5 - 3) * DX / 2
    points = torch.stack(torch.meshgrid(steps, steps, steps, indexing="ij"), -1).reshape(-1, 3)
    points = points + torch.tensor([0.0, 0.0, 0.2 + 3 * DX / 2 + clearance])
    condition = Condition(shape, effect, friction, own)
    grid = GridSettings((-1.5, -1.5, 0.0), (1.5, 1.5, 2.0), DX)
    volumes = torch.full((len(points),), (DX / 2) ** 3)
    model = make_model(
        points, volumes, (Material(young_modulus=5e4),), torch.zeros(len(points), dtype=torch.int32), grid, gravity, (condition,)
    )
    return model, rest_state(model, velocity)


TABLE = ((-1.0, -1.0, -0.3), (1.0, 1.0, 0.2))


@pytest.mark.slow
@pytest.mark.parametrize("effect", ["sticky", "slip", "separate"])
def test_a_mesh_box_acts_as_the_plane_that_is_its_top(effect):
    ends = []
    for shape in (Plane((0, 0, 0.2), (0, 0, 1)), measure_solid(*mesh_box(*TABLE), DX)):
        model, state = block(shape, effect, 0.2, gravity=(3.0, 0.0, -9.81), velocity=(0.3, 0.0, -1.0), clearance=0.05)
        after, report = advance(model, state, 0.25)
        assert report.retries == 0
        ends.append(after)
    assert float((ends[0].positions - ends[1].positions).abs().max()) < 2e-4  # of a way of 0.15
    assert float((ends[0].total - ends[1].total).abs().max()) < 5e-3


def test_a_block_slides_down_a_mesh_exactly_as_far_as_the_slope_and_friction_say():
    solid = measure_solid(*mesh_box(*TABLE), DX)
    free = 0.5 * 3.0 * 0.09  # the slope's tangent is 3 / 9.81 = 0.31
    for friction, expected in ((0.0, free), (0.15, free * (1 - 0.15 * 9.81 / 3))):
        model, state = block(solid, "separate", friction, gravity=(3.0, 0.0, -9.81))
        after, _ = advance(model, state, 0.3)
        assert float((after.positions - model.rest)[:, 0].mean()) == pytest.approx(expected, rel=0.15 if friction else 0.02)
    model, state = block(solid, "sticky", gravity=(3.0, 0.0, -9.81))
    after, _ = advance(model, state, 0.3)
    assert float((after.positions - model.rest)[:, 0].mean()) < 0.1 * free


def test_a_moving_mesh_takes_along_what_sticks_to_it():
    model, state = block(measure_solid(*mesh_box((-1, -1, -0.3), (1, 1, 0.25)), DX), "sticky", gravity=(0.0, 0.0, 0.0), own=(0.5, 0.0, 0.0))
    after, _ = advance(model, state, 0.2, MpmSettings())
    assert float((after.positions - model.rest)[:, 0].mean()) == pytest.approx(0.1, rel=0.15)


def test_a_mesh_ball_acts_as_the_ball():
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.3)
    center = torch.tensor([0.0, 0.0, -0.1])
    solid = measure_solid(torch.tensor(ball.vertices, dtype=torch.float32) + center, torch.tensor(ball.faces, dtype=torch.int32), DX / 2)
    random = 0.6 * (torch.rand(200, 3, generator=torch.Generator().manual_seed(0)) - 0.5) + center
    truth = (random - center).norm(dim=-1) - 0.3
    assert float((distances_from_solid(solid, random) - truth)[truth > -0.2].abs().max()) < 0.05 * DX
    model, state = block(solid, velocity=(0.0, 0.0, -1.0))
    after, _ = advance(model, state, 0.2)
    other, state = block(Sphere((0.0, 0.0, -0.1), 0.3), velocity=(0.0, 0.0, -1.0))
    truth, _ = advance(other, state, 0.2)
    assert float((after.positions.mean(0) - truth.positions.mean(0)).norm()) < 0.2 * DX
    assert float((after.positions - center).norm(dim=-1).min()) > 0.3 - DX  # it did not sink in


def test_distances_of_a_box_are_exact_on_every_side_and_inside_is_negative():
    solid = measure_solid(*mesh_box(*TABLE), 0.05)
    points = torch.tensor([[0.0, 0.0, 0.22], [0.0, 0.0, 0.17], [0.98, 0.1, 0.0], [0.0, -1.03, -0.1], [0.0, 0.0, -0.29], [5.0, 0, 0]])
    assert torch.allclose(distances_from_solid(solid, points), torch.tensor([0.02, -0.03, -0.02, 0.03, -0.01, math.inf]), atol=1e-6)
    random = 1.6 * (torch.rand(500, 3, generator=torch.Generator().manual_seed(0)) - 0.5)
    inside = ((random > torch.tensor(TABLE[0])) & (random < torch.tensor(TABLE[1]))).all(1)
    assert torch.equal(distances_from_solid(solid, random) < 0, inside)


@pytest.mark.slow
def test_a_holed_mesh_still_has_an_inside_and_large_ones_get_a_larger_spacing():
    vertices, faces = mesh_box(*TABLE)
    holed = measure_solid(vertices, faces[1:], 0.1)
    assert float(distances_from_solid(holed, torch.zeros(1, 3))) < 0
    assert measure_solid(100 * vertices, faces, 0.05).spacing > 0.5


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda v, f: (v, f + 100), "faces name vertices 0 to 7"),
        (lambda v, f: (v * math.nan, f), "finite"),
        (lambda v, f: (v, f[:0]), "has faces"),
        (lambda v, f: (v, f[:1]), "encloses a volume"),
    ],
)
def test_meshes_that_enclose_nothing_are_refused(change, sentence):
    with pytest.raises(ValueError, match=sentence):
        measure_solid(*change(*mesh_box(*TABLE)), 0.1)


def test_colliders_are_read_from_obj_and_ply(tmp_path):
    box = trimesh.creation.box(bounds=TABLE)
    for name in ("table.obj", "table.ply"):
        box.export(tmp_path / name)
        vertices, faces = read_collider(tmp_path / name)
        assert vertices.shape == (8, 3) and faces.shape == (12, 3) and float(vertices.max()) == 1.0
    (tmp_path / "table.txt").write_text("no mesh")
    with pytest.raises(ValueError, match="OBJ or PLY"):
        read_collider(tmp_path / "table.txt")
    with pytest.raises(ValueError, match="cannot be read"):
        read_collider(tmp_path / "none.obj")


def test_boxes_beside_solids_in_one_list_both_act():
    solid = measure_solid(*mesh_box(*TABLE), DX)
    model, state = block(solid)
    both = make_model(
        model.rest, model.volumes, (Material(young_modulus=5e4),), torch.zeros(len(model.rest), dtype=torch.int32), model.grid, (0, 0, -9.81),
        (Condition(Box((-1, -1, 0.3), (1, 1, 1)), "sticky"), Condition(solid), Condition(Sphere((3, 3, 3), 0.1))),
    )  # fmt: skip
    after, _ = advance(both, state, 0.1)
    assert torch.isfinite(after.positions).all() and float((after.positions - model.rest).abs().max()) < 0.02


def test_a_solid_around_points_is_a_ball_around_each():
    points = torch.tensor([[0.0, 0, 0], [2.0, 0, 1.0]])
    solid = solid_around(points, 0.3, 0.05)
    beside = points + torch.tensor([0.0, 0.2, 0])
    assert torch.allclose(distances_from_solid(solid, beside), torch.full((2,), -0.1), atol=0.01)
    assert float(distances_from_solid(solid, points + torch.tensor([0, 0, 0.33])).min()) > 0
