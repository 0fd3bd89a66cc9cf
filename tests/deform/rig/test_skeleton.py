import math

import numpy as np
import pytest
import torch

from drgs.deform.carry.carry_gaussians import carry_normals
from drgs.deform.rig.skeleton import pose_rig, rig_gradients, sample_channel, slerp
from drgs.exchange.gltf_rig import read_gltf_rig
from drgs.exchange.rig import RigChannel
from tests.exchange.write_rig import RigWriter, quat_xyzw, two_bones

SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])


def channel(path, interpolation, times, values) -> RigChannel:
    return RigChannel(0, path, interpolation, np.array(times, np.float64), np.array(values, np.float64))


def square_on(nodes: list[dict], **primitive) -> RigWriter:
    """A square mesh; the caller's nodes show it."""
    writer = RigWriter()
    attributes = {"POSITION": writer.array(SQUARE)}
    writer.document["meshes"] = [
        {"primitives": [{"attributes": attributes, "indices": writer.array([0, 1, 2, 0, 2, 3], "u1"), **primitive}]}
    ]
    writer.document["nodes"] = nodes
    return writer


def load(writer, folder):
    return read_gltf_rig(writer.save(folder / "rig.glb"))


def test_steps_hold_until_the_next_key():
    steps = channel("translation", "STEP", [1, 2, 4], [[1, 0, 0], [2, 0, 0], [3, 0, 0]])
    assert [sample_channel(steps, t)[0] for t in (0, 1, 1.999, 2, 3.999, 4, 9)] == [1, 1, 1, 2, 2, 3, 3]


def test_lines_run_straight_between_keys_and_hold_beyond_them():
    line = channel("scale", "LINEAR", [1, 2, 4], [[0, 0, 1], [4, 0, 1], [0, 8, 1]])
    for t, expected in ((0, [0, 0, 1]), (1.25, [1, 0, 1]), (2, [4, 0, 1]), (3, [2, 4, 1]), (4, [0, 8, 1]), (7, [0, 8, 1])):
        assert sample_channel(line, t) == pytest.approx(expected)


def test_rotations_turn_evenly_along_the_shorter_way():
    axis = [1, -2, 0.5]
    end = -np.array(quat_xyzw(axis, 150))  # the same rotation, from the other side
    turn = channel("rotation", "LINEAR", [0, 2], [quat_xyzw(axis, 0), end])
    for t in np.linspace(0, 2, 9):
        found = sample_channel(turn, t)
        assert abs(found @ quat_xyzw(axis, 75 * t)) == pytest.approx(1, abs=1e-14)


@pytest.mark.parametrize("degrees", [0, 1e-7, 1e-4, 0.01, 1, 90, 179.9])
def test_slerp_divides_the_angle_however_small_it_is(degrees):
    start, end = np.array(quat_xyzw([0, 1, 1], 20)), np.array(quat_xyzw([0, 1, 1], 20 + degrees))
    assert slerp(start, end, 0.3) == pytest.approx(quat_xyzw([0, 1, 1], 20 + 0.3 * degrees), abs=1e-15)


def test_cubic_splines_reproduce_any_cubic():
    random = np.random.default_rng(0)
    cubic = [np.polynomial.Polynomial(random.normal(size=4)) for _ in range(3)]
    times = [0.5, 1.25, 3.0]
    keys = [[[p.deriv()(t) for p in cubic], [p(t) for p in cubic], [p.deriv()(t) for p in cubic]] for t in times]
    spline = channel("translation", "CUBICSPLINE", times, keys)
    for t in random.uniform(0.5, 3, 20):
        assert sample_channel(spline, t) == pytest.approx([p(t) for p in cubic], abs=1e-11)
    assert sample_channel(spline, 0) == pytest.approx(keys[0][1]) and sample_channel(spline, 9) == pytest.approx(keys[2][1])


def test_cubic_slopes_are_a_second_and_each_key_has_two():
    # In-slopes 100 of the first key and out-slopes 100 of the last must not matter.
    keys = [[[100], [0], [1]], [[-1], [0], [100]]]
    assert sample_channel(channel("weights", "CUBICSPLINE", [0, 4], keys), 2) == pytest.approx([1.0])


def test_cubic_rotations_have_unit_length():
    keys = [[[0] * 4, quat_xyzw([1, 0, 0], 0), [0, 0, 3, 0]], [[1, 0, 0, 0], quat_xyzw([0, 1, 0], 120), [0] * 4]]
    spline = channel("rotation", "CUBICSPLINE", [0, 1], keys)
    assert all(np.linalg.norm(sample_channel(spline, t)) == pytest.approx(1, abs=1e-14) for t in np.linspace(0, 1, 11))
    zero = channel("rotation", "CUBICSPLINE", [0, 1], [[[0] * 4, [0, 0, 0, 1], [0] * 4], [[0] * 4, [0, 0, 0, -1], [0] * 4]])
    assert np.isfinite(sample_channel(zero, 0.5)).all()


def test_nodes_follow_their_parents(tmp_path):
    quarter = {"rotation": quat_xyzw([0, 0, 1], 90)}
    matrix = np.array([[0, -1, 0, 3], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])
    nodes = [
        {"translation": [10, 0, 0], "scale": [2, 1, 1], "children": [1]},
        {**quarter, "children": [2]},
        {"matrix": matrix.T.reshape(-1).tolist(), "mesh": 0},
    ]
    vertices = pose_rig(load(square_on(nodes), tmp_path)).vertices
    # (x, y) -> (3 - y, x) -> (-x, 3 - y) -> (10 - 2x, 3 - y)
    expected = torch.tensor([[10.0, 3, 0], [8, 3, 0], [8, 2, 0], [10, 2, 0]], dtype=torch.float64)
    assert torch.allclose(vertices, expected, atol=1e-12)


def test_only_the_scene_is_shown(tmp_path):
    writer = square_on([{"mesh": 0}, {"mesh": 0, "translation": [5, 0, 0]}])
    assert len(pose_rig(load(writer, tmp_path)).vertices) == 4
    writer.document["scenes"][0]["nodes"] = [1, 0]
    both = pose_rig(load(writer, tmp_path))
    assert len(both.vertices) == 8 and both.faces.max() == 7 and both.parts.unique().tolist() == [0, 1]
    writer.document["scenes"][0]["nodes"] = []
    with pytest.raises(ValueError, match="shows no triangles"):
        pose_rig(load(writer, tmp_path))


def test_morph_targets_add_up(tmp_path):
    writer = square_on([{"mesh": 0, "weights": [0.5, 0]}])
    shifts = [np.tile([0, 0, 1], (4, 1)), SQUARE]
    writer.document["meshes"][0]["primitives"][0]["targets"] = [{"POSITION": writer.array(shift)} for shift in shifts]
    writer.animate("grow", (0, "weights", [0, 1], [[0.5, 0], [0, 2]], "LINEAR"))
    rig = load(writer, tmp_path)
    square = torch.tensor(SQUARE, dtype=torch.float64)
    assert torch.allclose(pose_rig(rig).vertices, square + torch.tensor([0, 0, 0.5]))
    assert torch.allclose(pose_rig(rig, rig.animations[0], 0.5).vertices, square * 2 + torch.tensor([0, 0, 0.25]))
    assert torch.allclose(pose_rig(rig, rig.animations[0], 1).vertices, square * 3)


def test_a_skin_at_its_bind_pose_leaves_the_mesh_as_it_is(tmp_path):
    writer = two_bones(base=(0.3, -2, 1))
    rig = load(writer, tmp_path)
    assert torch.allclose(pose_rig(rig).vertices, torch.from_numpy(rig.meshes[0].vertices), atol=1e-7)  # the file's float32
    writer.document["nodes"][2] |= {"translation": [5, 5, 5], "scale": [3, 3, 3]}  # who shows a skinned mesh does not place it
    moved = load(writer, tmp_path)
    assert torch.equal(pose_rig(moved).vertices, pose_rig(rig).vertices)


def test_a_bent_bone_turns_its_own_vertices_about_the_joint_and_shares_the_others(tmp_path):
    rig = load(two_bones(height=2, radius=0.3, rings=9), tmp_path)
    rest, bent = pose_rig(rig).vertices, pose_rig(rig, rig.animations[0], 1).vertices
    turned = torch.stack([-(rest[:, 1] - 1), 1 + rest[:, 0], rest[:, 2]], -1)  # 90 degrees about z through (0, 1, 0)
    share = ((rest[:, 1] / 2 - 0.25) * 2).clamp(0, 1)[:, None]
    assert torch.allclose(bent, (1 - share) * rest + share * turned, atol=1e-6)
    assert torch.equal(bent[rest[:, 1] <= 0.5], rest[rest[:, 1] <= 0.5])
    half = pose_rig(rig, rig.animations[0], 0.5).vertices[-1] - torch.tensor([0, 1.0, 0])
    angle = math.radians(45)
    x, y = float(rest[-1, 0]), float(rest[-1, 1]) - 1
    assert half[:2].tolist() == pytest.approx(
        [x * math.cos(angle) - y * math.sin(angle), x * math.sin(angle) + y * math.cos(angle)], abs=1e-6
    )


def ramp(folder, steps: int = 8):
    """A strip in x, z = 0, whose second joint rises by 0.5; weights grow evenly along x, so that the strip becomes a slope."""
    x = np.linspace(0, 1, steps + 1)
    vertices = np.concatenate([np.stack([x, np.full_like(x, y), np.zeros_like(x)], -1) for y in (0, 1)])
    faces = [f for k in range(steps) for f in ([k, k + 1, steps + 2 + k], [k, steps + 2 + k, steps + 1 + k])]
    weights = np.zeros((len(vertices), 4))
    weights[:, 1] = vertices[:, 0]
    weights[:, 0] = 1 - vertices[:, 0]
    writer = RigWriter()
    attributes = {
        "POSITION": writer.array(vertices), "JOINTS_0": writer.array(np.tile([0, 1, 0, 0], (len(vertices), 1)), "u1"),
        "WEIGHTS_0": writer.array(weights),
    }  # fmt: skip
    writer.document["meshes"] = [{"primitives": [{"attributes": attributes, "indices": writer.array(np.ravel(faces), "u2")}]}]
    writer.document["skins"] = [{"joints": [1, 2]}]
    writer.document["nodes"] = [{"mesh": 0, "skin": 0}, {}, {}]
    writer.animate("rise", (2, "translation", [0, 1], [[0, 0, 0], [0, 0, 0.5]], "LINEAR"))
    return load(writer, folder)


def test_normals_know_how_weights_change_along_the_surface(tmp_path):
    rig = ramp(tmp_path)
    rest, moved = pose_rig(rig), pose_rig(rig, rig.animations[0], 1)
    up = torch.tensor([0, 0, 1.0], dtype=torch.float64).expand(len(rest.vertices), 3)
    # The blend of the joints' matrices is the identity everywhere and would leave the normals upright.
    slope = torch.tensor([-0.5, 0, 1], dtype=torch.float64) / math.hypot(1, 0.5)
    assert torch.allclose(carry_normals(up, rig_gradients(rest, moved)), slope.expand_as(up), atol=1e-6)


def test_vertices_in_one_place_share_their_gradient_within_a_part(tmp_path):
    writer = RigWriter()
    # Two squares side by side that share an edge in space only.
    corners = np.concatenate([SQUARE, np.add(SQUARE, [1, 0, 0])])
    target = np.zeros((8, 3))
    target[[5, 6], 2] = 1  # the far edge of the second rises
    primitive = {"attributes": {"POSITION": writer.array(corners)}, "targets": [{"POSITION": writer.array(target)}]}
    writer.document["meshes"] = [{"primitives": [{**primitive, "indices": writer.array([0, 1, 2, 0, 2, 3, 4, 5, 6, 4, 6, 7], "u1")}]}]
    writer.document["nodes"] = [{"mesh": 0}]
    writer.animate("fold", (0, "weights", [0, 1], [[0], [1]], "LINEAR"))
    rig = load(writer, tmp_path)
    gradient = rig_gradients(pose_rig(rig), pose_rig(rig, rig.animations[0], 1))
    assert torch.equal(gradient[1], gradient[4]) and torch.equal(gradient[2], gradient[7])
    assert torch.allclose(gradient[0], torch.eye(3, dtype=torch.float64)) and 0 < gradient[1, 2, 0] < gradient[5, 2, 0]
