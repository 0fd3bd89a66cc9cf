import numpy as np
import pytest
import torch

from drgs.deform.pose_scene import pose_scene
from drgs.deform.rig.skeleton import pose_rig
from drgs.exchange import fbx_rig
from drgs.exchange.fbx_rig import read_fbx_rig
from drgs.exchange.gltf_rig import read_gltf_rig
from drgs.scene.edits import parse_edits
from tests.deform.rig.test_proxy import column_asset
from tests.exchange.write_fbx import STEP, FbxWriter, two_bones_in_fbx
from tests.exchange.write_rig import two_bones

SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float64)


@pytest.fixture
def ufbx() -> None:
    pytest.importorskip("ufbx", reason="the optional package ufbx is not installed")


def square(writer: FbxWriter, parent: int = 0, **properties) -> tuple[int, int]:
    """Node and geometry."""
    node = writer.node("square", parent, "Mesh", **properties)
    return node, writer.mesh(node, SQUARE, [[0, 1, 2, 3]])


def posed(writer: FbxWriter, folder, *seconds: float) -> np.ndarray:
    """(vertex, 3) at rest, or (time, vertex, 3)."""
    rig = read_fbx_rig(writer.save(folder / "rig.fbx"))
    if not seconds:
        return pose_rig(rig).vertices.numpy()
    return np.stack([pose_rig(rig, rig.animations[0], time).vertices.numpy() for time in seconds])


def turned(axis: str, degrees: float) -> np.ndarray:
    cosine, sine = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    i, j = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    matrix = np.eye(3)
    matrix[i, i] = matrix[j, j] = cosine
    matrix[i, j], matrix[j, i] = -sine, sine
    return matrix


def test_a_skin_and_its_clip_move_vertices_as_the_same_rig_in_gltf_does(ufbx, tmp_path):
    fbx = read_fbx_rig(two_bones_in_fbx().save(tmp_path / "rig.fbx"))
    gltf = read_gltf_rig(two_bones().save(tmp_path / "rig.glb"))
    assert [animation.name for animation in fbx.animations] == ["Bend"] and fbx.animations[0].duration == 1
    assert torch.equal(pose_rig(fbx).faces, pose_rig(gltf).faces)
    for seconds in (0.0, 0.3, 0.77, 1.0, 5.0):
        ours, theirs = (pose_rig(rig, rig.animations[0], seconds).vertices for rig in (fbx, gltf))
        assert torch.allclose(ours, theirs, atol=1e-6), seconds
    assert torch.allclose(pose_rig(fbx).vertices, pose_rig(gltf).vertices, atol=1e-6)


def test_a_bent_bone_turns_what_follows_it_alone_about_the_joint(ufbx, tmp_path):
    rig = read_fbx_rig(two_bones_in_fbx(height=2, radius=0.3, rings=9).save(tmp_path / "rig.fbx"))
    rest = pose_rig(rig).vertices.numpy()
    top, joint = rest[:, 1] >= 1.5 - 1e-9, np.array([0, 1.0, 0])
    assert top.sum() == 12
    for seconds in (1 / 3, 1.0):
        moved = pose_rig(rig, rig.animations[0], seconds).vertices.numpy()
        assert np.allclose(moved[top], (rest[top] - joint) @ turned("z", 90 * seconds).T + joint, atol=1e-12)
        assert np.allclose(moved[rest[:, 1] < 0.5], rest[rest[:, 1] < 0.5], atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("clip", ["rig.fbx#Bend", "rig.FBX"])
def test_a_pose_edit_moves_an_object_by_fbx_as_by_gltf(ufbx, tmp_path, clip):
    two_bones_in_fbx().save(tmp_path / clip.split("#")[0])
    two_bones().save(tmp_path / "rig.glb")
    asset = column_asset()

    def scene(name: str, time: float):
        return pose_scene(asset, parse_edits([{"op": "pose", "clip": name, "time": time}]), tmp_path)

    ours, theirs = scene(clip, 0.6), scene("rig.glb#Bend", 0.6)
    assert torch.allclose(ours.mesh.vertices, theirs.mesh.vertices, atol=1e-5)
    assert not torch.allclose(ours.mesh.vertices, asset.mesh.vertices, atol=0.1)
    assert torch.equal(scene(clip, 0.0).mesh.vertices, asset.mesh.vertices)


@pytest.mark.slow
def test_any_up_axis_and_unit_become_y_up_and_metres(ufbx, tmp_path):
    for name, writer, expected in (
        ("y up, metres", FbxWriter("y", 100.0), SQUARE),
        ("y up, inches", FbxWriter("y", 2.54), 0.0254 * SQUARE),
        ("z up, centimetres", FbxWriter("z", 1.0), 0.01 * SQUARE @ turned("x", -90).T),
    ):
        square(writer)
        assert np.allclose(posed(writer, tmp_path), expected, atol=1e-12), name


def test_pivots_pre_rotations_and_geometric_transforms_place_a_node(ufbx, tmp_path):
    writer = FbxWriter(unit_centimeters=100.0)
    parent = writer.node("parent", Lcl_Translation=(0, 5, 0), Lcl_Scaling=(2, 2, 2))
    square(
        writer,
        parent,
        Lcl_Translation=(1, 2, 3),
        Lcl_Rotation=(10, 20, 30),
        Lcl_Scaling=(1, 2, 3),
        PreRotation=(0, 0, 40),
        RotationPivot=(0.5, 0, 0),
        GeometricTranslation=(0, 0, 7),
    )
    pivot = np.array([0.5, 0, 0])
    rotation = turned("z", 40) @ turned("z", 30) @ turned("y", 20) @ turned("x", 10)
    local = (np.add(SQUARE, [0, 0, 7]) * [1, 2, 3] - pivot) @ rotation.T + np.add(pivot, [1, 2, 3])
    assert np.allclose(posed(writer, tmp_path), np.add(2 * local, [0, 5, 0]), atol=1e-12)


def test_a_node_that_does_not_inherit_scale_keeps_its_size_though_not_its_place(ufbx, tmp_path):
    writer = FbxWriter(unit_centimeters=100.0)
    parent = writer.node("parent", Lcl_Scaling=(2, 3, 4), Lcl_Rotation=(0, 0, 90))
    square(writer, parent, Lcl_Translation=(1, 1, 1), Lcl_Rotation=(0, 30, 0), InheritType=2)
    expected = (SQUARE @ turned("y", 30).T + [2, 3, 4]) @ turned("z", 90).T
    assert np.allclose(posed(writer, tmp_path), expected, atol=1e-12)


def test_curves_turn_by_euler_angles_between_their_keys(ufbx, tmp_path):
    writer = FbxWriter(unit_centimeters=100.0)
    node, _ = square(writer)
    writer.animate(writer.animation("turn"), node, "Lcl Rotation", [0, 2], [0.0, 80.0], [0.0, -60.0], [0.0, 170.0])
    shares = (0.25, 0.505, 0.75)
    for share, found in zip(shares, posed(writer, tmp_path, *(2 * share for share in shares)), strict=True):
        expected = SQUARE @ (turned("z", 170 * share) @ turned("y", -60 * share) @ turned("x", 80 * share)).T
        assert np.allclose(found, expected, atol=2e-4)  # a thirtieth of a second is turned through evenly


def test_steps_hold_until_the_next_key(ufbx, tmp_path):
    writer = FbxWriter(unit_centimeters=100.0)
    node, _ = square(writer)
    writer.animate(writer.animation("jump"), node, "Lcl Translation", [0, 1, 2], [0.0, 1.0, 5.0], [0.0] * 3, [0.0] * 3, flag=STEP)
    assert posed(writer, tmp_path, 0, 0.99, 1, 1.99, 2, 3)[:, 0, 0].tolist() == [0, 0, 1, 1, 5, 5]


def test_the_part_that_is_played_begins_at_zero_and_ends_with_the_take(ufbx, tmp_path):
    writer = FbxWriter(unit_centimeters=100.0)
    node, _ = square(writer)
    writer.animate(writer.animation("slide", 1.0, 2.5), node, "Lcl Translation", [0, 3], [0.0, 3.0], [0.0, 0.0], [0.0, 0.0])
    rig = read_fbx_rig(writer.save(tmp_path / "rig.fbx"))
    assert rig.animations[0].duration == pytest.approx(1.5)
    found = [pose_rig(rig, rig.animations[0], seconds).vertices[0, 0].item() for seconds in (0, 1, 1.5, 2)]
    assert found == pytest.approx([1, 2, 2.5, 2.5])


@pytest.mark.slow
def test_morph_targets_add_up_and_what_no_curve_moves_keeps_its_place(ufbx, tmp_path):
    writer = FbxWriter(unit_centimeters=100.0)
    node, shape = square(writer, GeometricRotation=(0, 0, 90))
    smile = writer.blend(shape, "smile", [2], [[0, 0, 1.0]])
    writer.blend(shape, "frown", [0, 1], [[0, 1.0, 0], [0, 2.0, 0]], percent=50.0)
    frowning = SQUARE + np.array([[0, 0.5, 0], [0, 1, 0], [0, 0, 0], [0, 0, 0]])
    assert np.allclose(posed(writer, tmp_path), frowning @ turned("z", 90).T)
    layer = writer.animation("smiling")
    writer.animate(layer, smile, "DeformPercent", [0, 2], [0.0, 100.0])
    writer.animate(layer, node, "Lcl Translation", [0, 2], [0.0, 4.0], [0.0, 0.0], [0.0, 0.0])
    frowning[2, 2] = 0.25
    assert np.allclose(posed(writer, tmp_path, 0.5), np.add(frowning @ turned("z", 90).T, [1, 0, 0]))


def test_vertices_that_no_bone_holds_follow_their_node(ufbx, tmp_path):
    writer = FbxWriter(unit_centimeters=100.0)
    bone = writer.node("bone", sort="LimbNode")
    node, shape = square(writer, Lcl_Translation=(0, 0, 2))
    world_from_mesh = np.eye(4)
    world_from_mesh[2, 3] = 2
    writer.cluster(writer.skin(shape), bone, [0, 1], [1.0, 0.5], world_from_mesh, np.eye(4))
    layer = writer.animation("apart")
    writer.animate(layer, bone, "Lcl Translation", [0, 1], [0.0, 10.0], [0.0, 0.0], [0.0, 0.0])
    writer.animate(layer, node, "Lcl Translation", [0, 1], [0.0, 0.0], [0.0, 3.0], [2.0, 2.0])
    expected = np.add(SQUARE, [[10, 0, 2], [10, 0, 2], [0, 3, 2], [0, 3, 2]])  # 0.5 of one bone is all of it
    assert np.allclose(posed(writer, tmp_path, 1.0), expected)


@pytest.mark.slow
def test_what_is_not_read_is_refused_by_name(ufbx, tmp_path):
    def refusal(writer: FbxWriter) -> str:
        with pytest.raises(ValueError, match=r"rig\.fbx: ") as found:
            read_fbx_rig(writer.save(tmp_path / "rig.fbx"))
        return str(found.value)

    writer = FbxWriter()
    assert "no triangles" in refusal(writer)
    _, shape = square(writer)
    writer.cluster(writer.skin(shape, "DualQuaternion"), writer.node("bone"), [0], [1.0], np.eye(4), np.eye(4))
    assert "dual quaternions" in refusal(writer)
    writer = FbxWriter()
    _, shape = square(writer)
    writer.blend(shape, "smile", [2], [[0, 0, 1.0]], full_weights=(50.0, 100.0))
    assert "shapes in between" in refusal(writer)


@pytest.mark.slow
@pytest.mark.parametrize(
    "content", [b"", b"hello", b"; FBX 7.4.0 project file\n", b"Kaydara FBX Binary  \0\x1a\0\xe8\x1c\0\0" + b"\xff" * 64]
)
def test_a_damaged_file_is_refused_by_name(ufbx, tmp_path, content):
    path = tmp_path / "bad.fbx"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"bad\.fbx: is no FBX file, or a damaged one \(\w+"):
        read_fbx_rig(path)
    with pytest.raises(ValueError, match=r"none\.fbx: does not exist"):
        read_fbx_rig(tmp_path / "none.fbx")


def test_a_reader_that_crashes_harms_nobody(ufbx, tmp_path, monkeypatch):
    crash = tmp_path / "crash.py"
    crash.write_text("import os, signal\nos.kill(os.getpid(), signal.SIGSEGV)\n")
    monkeypatch.setattr(fbx_rig, "_PROCESS", crash)
    with pytest.raises(ValueError, match=r"rig\.fbx: ufbx gave up on it with status -11"):
        read_fbx_rig(two_bones_in_fbx().save(tmp_path / "rig.fbx"))


def test_without_the_package_the_refusal_says_how_to_install_it(tmp_path, monkeypatch):
    monkeypatch.setattr(fbx_rig, "find_spec", lambda name: None)
    with pytest.raises(ValueError, match=r"rig\.fbx: reading FBX needs the package ufbx; install it with: .*\[fbx\]'"):
        read_fbx_rig(two_bones_in_fbx().save(tmp_path / "rig.fbx"))
