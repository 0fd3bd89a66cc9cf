import json

import numpy as np
import pytest

from drgs.exchange.gltf_rig import read_gltf_rig
from tests.exchange.write_rig import RigWriter, quat_xyzw, two_bones

CORNERS = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.5]])


def plate(**attributes) -> RigWriter:
    """A plate of two triangles on node 0."""
    writer = RigWriter()
    positions = attributes.pop("POSITION", None)
    given = {"POSITION": writer.array(CORNERS) if positions is None else positions(writer)}
    given |= {name: make(writer) for name, make in attributes.items()}
    writer.document["meshes"] = [{"primitives": [{"attributes": given, "indices": writer.array([0, 1, 2, 0, 2, 3], "u1")}]}]
    writer.document["nodes"] = [{"mesh": 0}]
    return writer


def read(writer: RigWriter, folder, name: str = "rig.glb"):
    return read_gltf_rig(writer.save(folder / name))


def test_a_rig_is_read_as_it_was_written(tmp_path):
    writer = two_bones(height=2, radius=0.3, rings=5)
    rig = read(writer, tmp_path)
    assert [node.name for node in rig.nodes] == ["root", "upper", "body"] and [node.parent for node in rig.nodes] == [-1, 0, -1]
    assert rig.nodes[1].translation.tolist() == [0, 1, 0] and rig.nodes[2].mesh == 0 and rig.nodes[2].skin == 0
    mesh = rig.meshes[0]
    assert mesh.vertices.shape == (20, 3) and mesh.faces.shape == (36, 3) and mesh.vertices[:, 1].max() == 2
    assert np.allclose(mesh.weights.sum(1), 1) and mesh.weights[8:12, 1].tolist() == [0.5] * 4 and mesh.joints[:, 1].max() == 1
    assert rig.skins[0].joints.tolist() == [0, 1] and rig.skins[0].joint_from_mesh[1, :3, 3].tolist() == [0, -1, 0]
    assert [animation.name for animation in rig.animations] == ["Bend", "Turn", "Still"]
    turn = rig.animations[1]
    assert [channel.path for channel in turn.channels] == ["rotation", "translation"] and turn.duration == 1
    assert np.allclose(turn.channels[0].values[1], quat_xyzw([1, 2, 3], 100), atol=1e-7)


@pytest.mark.parametrize("buffer", ["inside", "beside"])
def test_text_files_say_the_same_as_binary_ones(tmp_path, buffer):
    writer = two_bones()
    binary, text = read(writer, tmp_path), read_gltf_rig(writer.save(tmp_path / "rig.gltf", buffer))
    assert np.array_equal(binary.meshes[0].vertices, text.meshes[0].vertices)
    assert np.array_equal(binary.animations[1].channels[0].values, text.animations[1].channels[0].values)


@pytest.mark.parametrize(("dtype", "largest"), [("u1", 255), ("u2", 65535)])
def test_normalised_weights_become_fractions(tmp_path, dtype, largest):
    whole = np.array([[largest, 0, 0, 0], [0, largest, 0, 0], [largest // 5, largest // 5 * 4, 0, 0], [0, 0, 0, largest]])
    writer = plate(
        JOINTS_0=lambda w: w.array(np.tile([0, 1, 2, 3], (4, 1)), "u2"), WEIGHTS_0=lambda w: w.array(whole, dtype, normalized=True)
    )
    weights = read(writer, tmp_path).meshes[0].weights
    assert np.allclose(weights, [[1, 0, 0, 0], [0, 1, 0, 0], [0.2, 0.8, 0, 0], [0, 0, 0, 1]], atol=1e-6)


def test_weights_of_several_sets_sum_to_one_and_none_means_the_first_joint(tmp_path):
    first, second = np.zeros((4, 4)), np.zeros((4, 4))
    first[0, 0], second[0, 3], first[1, 1] = 2, 6, 1
    writer = plate(
        JOINTS_0=lambda w: w.array(np.tile([5, 6, 7, 8], (4, 1)), "u1"), WEIGHTS_0=lambda w: w.array(first),
        JOINTS_1=lambda w: w.array(np.tile([9, 10, 11, 12], (4, 1)), "u1"), WEIGHTS_1=lambda w: w.array(second),
    )  # fmt: skip
    mesh = read(writer, tmp_path).meshes[0]
    assert mesh.weights[0].tolist() == [0.25, 0, 0, 0, 0, 0, 0, 0.75] and mesh.joints[0, 7] == 12
    assert mesh.weights[2].tolist() == [1, 0, 0, 0, 0, 0, 0, 0] and mesh.joints[2, 0] == 5
    assert mesh.joints[0, 1] == 0  # without weight, a joint is nobody's


@pytest.mark.parametrize("base", [None, 7 + np.arange(12.0).reshape(4, 3)])
def test_sparse_values_stand_over_their_base(tmp_path, base):
    given = np.array([[1, 2, 3], [4, 5, 6]])
    rig = read(plate(POSITION=lambda w: w.sparse(base, 4, [1, 3], given)), tmp_path)
    expected = np.zeros((4, 3)) if base is None else base.copy()
    expected[[1, 3]] = given
    assert np.array_equal(rig.meshes[0].vertices, expected)


def test_strided_values_are_read_past_what_lies_between(tmp_path):
    rig = read(plate(POSITION=lambda w: w.array(CORNERS, stride=20)), tmp_path)
    assert np.array_equal(rig.meshes[0].vertices, CORNERS)


def test_quantised_positions_and_rotations_are_read(tmp_path):
    writer = plate(POSITION=lambda w: w.array(CORNERS * 32766, "i2", stride=8, normalized=True))
    writer.document["extensionsRequired"] = ["KHR_mesh_quantization"]
    writer.animate("turn", (0, "rotation", [0], [[0, 0, 0, 1]], "LINEAR"))
    writer.document["animations"][0]["samplers"][0]["output"] = writer.array([[0, 0, -32768, 0]], "i2", normalized=True)
    rig = read(writer, tmp_path)
    assert np.abs(rig.meshes[0].vertices - CORNERS).max() < 1 / 32767
    assert rig.animations[0].channels[0].values.tolist() == [[0, 0, -1, 0]]  # the lowest integer is -1, not below it
    whole = read(plate(POSITION=lambda w: w.array(CORNERS * 2, "i1", stride=4)), tmp_path)
    assert np.array_equal(whole.meshes[0].vertices, CORNERS * 2)


@pytest.mark.parametrize(("mode", "faces"), [(5, [[0, 1, 2], [2, 1, 3]]), (6, [[0, 1, 2], [0, 2, 3]])])
def test_strips_and_fans_become_triangles(tmp_path, mode, faces):
    writer = plate()
    primitive = writer.document["meshes"][0]["primitives"][0]
    primitive["mode"], primitive["indices"] = mode, writer.array([0, 1, 2, 3], "u4")
    found = read(writer, tmp_path).meshes[0].faces
    normal = [np.cross(CORNERS[b] - CORNERS[a], CORNERS[c] - CORNERS[a]) for a, b, c in found]
    expected = [np.cross(CORNERS[b] - CORNERS[a], CORNERS[c] - CORNERS[a]) for a, b, c in faces]
    assert [sorted(face) for face in found.tolist()] == [sorted(face) for face in faces] and np.allclose(normal, expected)


def test_primitives_are_joined_and_lines_passed_over(tmp_path):
    writer = plate()
    primitives = writer.document["meshes"][0]["primitives"]
    primitives += [{**primitives[0], "mode": 1}, {"attributes": primitives[0]["attributes"]}]
    mesh = read(writer, tmp_path).meshes[0]
    assert mesh.vertices.shape == (8, 3) and mesh.faces.tolist() == [[0, 1, 2], [0, 2, 3], [4, 5, 6]]


def test_morph_targets_and_their_weights_are_read(tmp_path):
    writer = plate()
    mesh = writer.document["meshes"][0]
    mesh["primitives"][0]["targets"] = [{"POSITION": writer.array(CORNERS * 2)}, {"POSITION": writer.sparse(None, 4, [2], [[0, 0, 9]])}]
    mesh["weights"] = [0.5, 0]
    writer.animate("blink", (0, "weights", [0, 1], [[0, 0], [1, 0.25]], "LINEAR"))
    rig = read(writer, tmp_path)
    assert np.array_equal(rig.meshes[0].targets[0], CORNERS * 2) and rig.meshes[0].targets[1, 2].tolist() == [0, 0, 9]
    assert rig.meshes[0].morph_weights.tolist() == [0.5, 0] and rig.animations[0].channels[0].values.tolist() == [[0, 0], [1, 0.25]]


def edit(path: list, value):
    """A change of the document: value at the path, or removed if it is `...`."""

    def change(document: dict) -> None:
        for step in path[:-1]:
            document = document[step]
        if value is ...:
            del document[path[-1]]
        else:
            document[path[-1]] = value

    return change


HOSTILE = {
    "another version": (edit(["asset", "version"], "1.0"), "glTF 1.0"),
    "compression": (edit(["extensionsRequired"], ["KHR_draco_mesh_compression"]), "KHR_draco_mesh_compression.*without compression"),
    "cycle": (edit(["nodes", 1, "children"], [0]), "ancestor"),
    "own child": (edit(["nodes", 2, "children"], [2]), "ancestor"),
    "two parents": (edit(["nodes", 2, "children"], [1]), "two parents"),
    "child that is not there": (edit(["nodes", 2, "children"], [9]), "child is 9"),
    "negative index": (edit(["nodes", 2, "mesh"], -1), "is -1"),
    "truth as an index": (edit(["nodes", 2, "mesh"], True), "is True"),
    "no mesh": (edit(["meshes"], []), "there is none"),
    "accessor beyond its view": (edit(["accessors", 0, "count"], 60_000), "reach beyond"),
    "huge count": (edit(["accessors", 0, "count"], 10**12), "count"),
    "huge number of zeros": (edit(["accessors", 0], {"componentType": 5126, "type": "VEC3", "count": 60_000_000}), "unpack to more"),
    "offset beyond": (edit(["accessors", 0, "byteOffset"], 10**9), "offset"),
    "negative offset": (edit(["bufferViews", 0, "byteOffset"], -4), "offset"),
    "small stride": (edit(["bufferViews", 0, "byteStride"], 4), "reach beyond"),
    "unknown component": (edit(["accessors", 0, "componentType"], 5130), "component type"),
    "wrong type": (edit(["accessors", 0, "type"], "SCALAR"), "VEC3"),
    "joints that do not exist": (edit(["skins", 0, "joints"], [0]), "names joint 1 of a skin that has 1"),
    "skin without joints": (edit(["skins", 0, "joints"], []), "without joints"),
    "weights missing": (edit(["meshes", 0, "primitives", 0, "attributes", "WEIGHTS_0"], ...), "well-formed"),
    "faces as floats": (edit(["meshes", 0, "primitives", 0, "indices"], 0), "SCALAR"),
    "zero rotation": (edit(["nodes", 0, "rotation"], [0, 0, 0, 0]), "zero"),
    "short matrix": (edit(["nodes", 0, "matrix"], [1, 2]), "16 numbers"),
    "unknown interpolation": (edit(["animations", 0, "samplers", 0, "interpolation"], "WAVY"), "WAVY"),
    "values and times that differ": (edit(["animations", 0, "samplers", 0, "input"], -3), "accessors"),
    "cubic without slopes": (edit(["animations", 0, "samplers", 0, "interpolation"], "CUBICSPLINE"), "8 numbers for 2 times; expected 24"),
    "channels as text": (edit(["animations", 0, "channels"], "all"), "well-formed"),
    "buffer elsewhere": (edit(["buffers", 0, "uri"], "../secret.bin"), "outside its folder"),
    "buffer at the root": (edit(["buffers", 0, "uri"], "/etc/hostname"), "outside its folder"),
    "buffer of the net": (edit(["buffers", 0, "uri"], "https://example.org/a.bin"), "no file beside it"),
    "buffer that is not there": (edit(["buffers", 0, "uri"], "none.bin"), "does not exist"),
    "damaged base64": (edit(["buffers", 0, "uri"], "data:;base64,!!!"), "base64"),
    "nodes as a number": (edit(["nodes"], 5), "not a list"),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_hostile_files_are_refused_with_a_sentence(tmp_path, case):
    change, sentence = HOSTILE[case]
    path = two_bones().save(tmp_path / "bad.gltf")
    document = json.loads(path.read_text())
    change(document)
    path.write_text(json.dumps(document))
    with pytest.raises(ValueError, match=rf"bad\.gltf: (?s:.*){sentence}"):
        read_gltf_rig(path)


@pytest.mark.parametrize(
    ("content", "sentence"),
    [(b"", "JSON"), (b"glTF", "header"), (b"[" * 100_000, "JSON"), (b'{"a": NaN}', "NaN"), (b"[]", "no glTF"), (b"\xff\xfe{}", "JSON")],
)
def test_files_that_are_no_gltf_are_refused(tmp_path, content, sentence):
    (tmp_path / "bad.glb").write_bytes(content)
    with pytest.raises(ValueError, match=rf"bad\.glb: .*{sentence}"):
        read_gltf_rig(tmp_path / "bad.glb")
    with pytest.raises(ValueError, match=r"none\.glb: does not exist"):
        read_gltf_rig(tmp_path / "none.glb")


def test_keys_that_fall_and_values_that_are_not_finite_are_refused(tmp_path):
    writer = two_bones()
    writer.animate("back", (1, "translation", [1, 0], np.zeros((2, 3)), "LINEAR"))
    with pytest.raises(ValueError, match="do not rise"):
        read(writer, tmp_path)
    with pytest.raises(ValueError, match="not finite"):
        read(plate(POSITION=lambda w: w.array(np.full((4, 3), np.nan))), tmp_path)


def test_damaged_bytes_are_read_or_refused_but_nothing_else(tmp_path):
    data = two_bones(rings=3).save(tmp_path / "rig.glb").read_bytes()
    random = np.random.default_rng(0)
    refused = 0
    for _ in range(150):
        damaged = bytearray(data)
        for place in random.integers(0, len(data), 4):
            damaged[place] = random.integers(0, 256)
        damaged = damaged[: random.integers(0, len(data))] if random.random() < 0.3 else damaged
        (tmp_path / "bad.glb").write_bytes(damaged)
        try:
            read_gltf_rig(tmp_path / "bad.glb")
        except ValueError as error:
            refused += 1
            assert "bad.glb" in str(error)
    assert refused > 30
