"""Splats in glTF are what KHR_gaussian_splatting says, and nothing else is read."""

import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh

from drgs.exchange.glb import decode_glb
from drgs.exchange.gltf_rig import read_gltf_rig
from drgs.exchange.gltf_splats import EXTENSION, read_gltf_splats
from drgs.maths.color_numpy import srgb_from_linear
from drgs.maths.spherical_harmonics import evaluate_sh
from tests.exchange.write_rig import RigWriter
from tests.exchange.write_splats import CORNERS, FACES, document_of, flat_splats, glb_with_splats, splats_of, with_document

HARMONICS = [f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{n}" for degree in range(4) for n in range(2 * degree + 1)]
ROTATION, SCALE, OPACITY = (f"{EXTENSION}:{name}" for name in ("ROTATION", "SCALE", "OPACITY"))


def read(data: bytes, folder: Path) -> list:
    (folder / "a.glb").write_bytes(data)
    return read_gltf_splats(folder / "a.glb")


def test_splats_survive_writing_and_reading(tmp_path):
    given = flat_splats(color_space="lin_rec709_display")
    (part,) = read(glb_with_splats(given, meters_per_unit=0.5), tmp_path)
    for name in ("centers", "scales", "opacities", "sh"):
        assert getattr(part.splats, name).tobytes() == getattr(given, name).tobytes(), name
    assert np.allclose(part.splats.quats_xyzw, given.quats_xyzw, atol=1e-7)
    assert part.splats.color_space == "lin_rec709_display" and part.splats.materials.keys() == given.materials.keys()
    assert all(part.splats.materials[name].tobytes() == values.tobytes() for name, values in given.materials.items())
    assert np.array_equal(part.gltf_from_splats, [[0.5, 0, 0, 0], [0, 0, 0.5, 0], [0, -0.5, 0, 0], [0, 0, 0, 1]])


def test_the_file_says_what_the_extension_demands():
    document = document_of(glb_with_splats())
    primitive = splats_of(document)
    assert primitive["mode"] == 0 and "indices" not in primitive
    said = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display", "projection": "perspective", "sortingMethod": "cameraDistance"}
    assert primitive["extensions"] == {EXTENSION: said}
    types = dict.fromkeys(["POSITION", SCALE, *HARMONICS, "_ALBEDO"], "VEC3") | dict.fromkeys([ROTATION, "COLOR_0"], "VEC4")
    types |= dict.fromkeys([OPACITY, "_ROUGHNESS", "_METALLIC"], "SCALAR")
    accessors = {name: document["accessors"][index] for name, index in primitive["attributes"].items()}
    assert {name: accessor["type"] for name, accessor in accessors.items()} == types
    assert {accessor["count"] for accessor in accessors.values()} == {5}
    bytes_only = {name for name, accessor in accessors.items() if accessor["componentType"] != 5126}
    assert bytes_only == {"COLOR_0"} and accessors["COLOR_0"]["componentType"] == 5121 and accessors["COLOR_0"]["normalized"] is True
    assert np.allclose(accessors["POSITION"]["min"], flat_splats().centers.min(0))


def test_who_does_not_know_the_extension_opens_the_mesh_alone(tmp_path):
    data = glb_with_splats()
    document = document_of(data)
    assert document["extensionsUsed"] == [EXTENSION] and "extensionsRequired" not in document
    (mesh_root,), (splats_root,) = (document["scenes"][k]["nodes"] for k in (document["scene"], 1 - document["scene"]))
    mesh, splats = document["nodes"][mesh_root], document["nodes"][splats_root]
    assert (
        document["meshes"][mesh["mesh"]]["primitives"][0].get("mode", 4) == 4
        and document["meshes"][splats["mesh"]]["primitives"][0]["mode"] == 0
    )
    assert mesh["matrix"] == splats["matrix"]
    shown = trimesh.load_scene(io.BytesIO(data), file_type="glb", process=False)
    assert len(shown.graph.nodes_geometry) == 1 and len(shown.to_geometry().faces) == len(FACES)
    (tmp_path / "a.glb").write_bytes(data)
    rig = read_gltf_rig(tmp_path / "a.glb")
    assert [len(rig.meshes[node.mesh].faces) for node in rig.nodes if node.shown and node.mesh is not None] == [len(FACES)]
    own = decode_glb(data)
    assert np.array_equal(own.attributes["POSITION"], CORNERS) and np.array_equal(own.faces, FACES)


def test_readers_of_points_get_the_colour_in_linear_light_and_the_opacity():
    given = flat_splats()
    shown = trimesh.load_scene(
        io.BytesIO(with_document(glb_with_splats(given), lambda d: d.update(scene=1))), file_type="glb", process=False
    )
    (cloud,) = (shown.geometry[shown.graph[node][1]] for node in shown.graph.nodes_geometry)
    colors = np.asarray(cloud.colors) / 255
    assert np.allclose(srgb_from_linear(colors[:, :3]), given.sh[:, 0] * 0.282095 + 0.5, atol=0.01)
    assert np.allclose(colors[:, 3], given.opacities, atol=0.5 / 255 + 1e-6)


def test_the_harmonics_are_those_of_the_specification():
    """Its formulas, written out, against ours in its order of attributes."""
    random = np.random.default_rng(1)
    x, y, z = direction = random.normal(size=3) / 2
    direction /= np.linalg.norm(direction)
    x, y, z = direction
    values = [
        0.2820947917738781, -0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x,
        1.092548430592079 * x * y, -1.092548430592079 * y * z, 0.3153915652525200 * (2 * z * z - x * x - y * y),
        -1.092548430592079 * x * z, 0.5462742152960395 * (x * x - y * y),
        -0.5900435899266435 * y * (3 * x * x - y * y), 2.890611442640554 * x * y * z, -0.4570457994644657 * y * (4 * z * z - x * x - y * y),
        0.3731763325901154 * z * (2 * z * z - 3 * x * x - 3 * y * y), -0.4570457994644657 * x * (4 * z * z - x * x - y * y),
        1.445305721320277 * z * (x * x - y * y), -0.5900435899266435 * x * (x * x - 3 * y * y),
    ]  # fmt: skip
    ours = evaluate_sh(torch.eye(16, dtype=torch.float64)[:, :, None].expand(16, 16, 3), torch.from_numpy(direction).expand(16, 3))
    assert np.allclose(ours[:, 0], values, atol=1e-12)
    document = document_of(glb_with_splats())
    assert [name for name in splats_of(document)["attributes"] if ":SH_" in name] == HARMONICS


def write_packed_splats(path: Path, nodes: list[dict]) -> None:
    """Two of them alone, in bytes and shorts, with harmonics to degree 1, by a program that needs the extension."""
    writer = RigWriter()
    attributes = {"POSITION": writer.array([[1, 2, 3], [0, 0, 0]])}
    attributes[ROTATION] = writer.array([[0, 0, 0, 127], [90, 0, 0, 90]], "i1", normalized=True)
    attributes[SCALE] = writer.array([[3, 2, 0], [5, 4, 0]], "u1", stride=4)
    attributes[OPACITY] = writer.array([65535, 13107], "u2", stride=4, normalized=True)
    attributes |= {name: writer.array(np.full((2, 3), k)) for k, name in enumerate(HARMONICS[:4])}
    said = {EXTENSION: {"kernel": "ellipse", "colorSpace": "lin_rec709_display"}}
    writer.document |= {"nodes": nodes, "extensionsUsed": [EXTENSION], "extensionsRequired": [EXTENSION]}
    writer.document["meshes"] = [{"primitives": [{"mode": 0, "attributes": attributes, "extensions": said}]}]
    writer.save(path)


def test_bytes_and_shorts_few_harmonics_and_nested_nodes_are_read(tmp_path):
    half = np.sqrt(0.5)
    nodes = [{"children": [1], "translation": [0, 0, 10], "scale": [2, 2, 2]}, {"mesh": 0, "rotation": [0, 0, half, half]}, {"mesh": 0}]
    write_packed_splats(tmp_path / "a.glb", nodes)
    below, plain = sorted(read_gltf_splats(tmp_path / "a.glb"), key=lambda part: -part.gltf_from_splats[2, 3])
    assert np.allclose(below.gltf_from_splats, [[0, -2, 0, 0], [2, 0, 0, 0], [0, 0, 2, 10], [0, 0, 0, 1]])
    assert np.array_equal(plain.gltf_from_splats, np.eye(4))
    splats = below.splats
    assert np.allclose(splats.quats_xyzw, [[0, 0, 0, 1], [half, 0, 0, half]], atol=1e-6)
    assert np.array_equal(splats.scales, [[3, 2, 0], [5, 4, 0]]) and np.allclose(splats.opacities, [1, 0.2])
    assert np.array_equal(splats.sh[:, :4, 0], [[0, 1, 2, 3], [0, 1, 2, 3]]) and not splats.sh[:, 4:].any()
    assert splats.materials == {} and splats.color_space == "lin_rec709_display"


def test_a_file_without_splats_holds_none(tmp_path):
    data = glb_with_splats()

    def forget(document: dict) -> None:
        del document["extensionsUsed"], splats_of(document)["extensions"]

    assert read(with_document(data, forget), tmp_path) == []
    assert read(b"glTF", tmp_path) == []


def drop(*names: str):
    return lambda document: [splats_of(document)["attributes"].pop(name) for name in names]


def say(**words: Any):
    return lambda document: splats_of(document)["extensions"][EXTENSION].update(words)


def other_accessor(name: str, **keys: Any):
    return lambda document: document["accessors"][splats_of(document)["attributes"][name]].update(keys)


def swap(first: str, second: str):
    def change(document: dict) -> None:
        attributes = splats_of(document)["attributes"]
        attributes[first], attributes[second] = attributes[second], attributes[first]

    return change


WRONG = {
    "no rotation": (drop(ROTATION), r"its splats have no KHR_gaussian_splatting:ROTATION"),
    "no position": (drop("POSITION"), r"no POSITION"),
    "no constant colour": (drop(HARMONICS[0]), r"0 harmonics of degree 0, and some of degree 3; expected 1"),
    "half a degree": (drop(HARMONICS[10]), r"6 harmonics of degree 3, and some of degree 3; expected 7"),
    "a degree left out": (drop(*HARMONICS[4:9]), r"0 harmonics of degree 2, and some of degree 3; expected 5"),
    "another kernel": (say(kernel="box"), r"the kernel 'box'; expected ellipse"),
    "no colour space": (say(colorSpace=None), r"the colorSpace 'None'; expected srgb_rec709_display or lin_rec709_display"),
    "compressed": (say(extensions={f"{EXTENSION}_compression_spz_2": {}}), r"compressed by \w+_spz_2, which this program does not read"),
    "triangles": (lambda document: splats_of(document).pop("mode"), r"have the mode 4; expected plain points"),
    "indices": (lambda document: splats_of(document).update(indices=0), r"are indexed; expected plain points"),
    "a rotation of three": (other_accessor(ROTATION, type="VEC3"), r"ROTATION have the type 'VEC3'; expected VEC4"),
    "whole opacities": (other_accessor(OPACITY, componentType=5121), r"OPACITY has the component type 5121; expected floats, or normalised"),
    "harmonics in shorts": (other_accessor(HARMONICS[5], componentType=5122, normalized=True), r"COEF_1 has the component type 5122, normalised; expected floats"),
    "fewer scales": (other_accessor(SCALE, count=4), r"SCALE is of 4 splats; expected 5, as in POSITION"),
    "fewer materials": (other_accessor("_METALLIC", count=4), r"_METALLIC is of 4 splats; expected 5"),
    "scales as logarithms": (swap(SCALE, HARMONICS[3]), r"scales of its splats fall to -.*expected linear ones from 0 on"),
    "opacities beyond one": (lambda document: document["accessors"][splats_of(document)["attributes"][OPACITY]].update(
        bufferView=document["accessors"][splats_of(document)["attributes"][HARMONICS[2]]]["bufferView"]), r"opacities of its splats are .*; expected 0 to 1"),
    "rotations that are none": (swap(ROTATION, "COLOR_0"), r"ROTATION has the component type 5121, normalised; expected floats"),
    "a node of its own": (lambda document: document["nodes"][1].update(children=[1]), None),
    "two parents": (lambda document: document["nodes"].extend([{"children": [1]}, {"children": [1]}]), r"its node 1 has two parents"),
    "no such mesh": (lambda document: document["nodes"][1].update(mesh=7), r"a node's mesh is 7; expected a whole number from 0 to 1"),
    "an endless node": (lambda document: document["nodes"].extend(
        [{"children": [3], "scale": [1e29] * 3}] + [{"children": [k], "scale": [1e29] * 3} for k in range(4, 15)] + [{"mesh": 1}]), r"transform of its node \d+ is not finite"),
    "nonsense": (lambda document: splats_of(document).update(attributes=[]), r"is not well-formed glTF|no POSITION"),
}  # fmt: skip


@pytest.mark.parametrize("what", WRONG)
def test_what_the_extension_forbids_is_refused_by_name(what, tmp_path):
    change, complaint = WRONG[what]
    data = with_document(glb_with_splats(), change)
    if complaint is None:
        assert read(data, tmp_path) == [], "no root leads there"
        return
    with pytest.raises(ValueError, match=complaint) as refusal:
        read(data, tmp_path)
    assert str(refusal.value).startswith(str(tmp_path / "a.glb")) and "\n" not in str(refusal.value)


def test_rotations_of_another_length_are_normalised_and_those_of_none_refused(tmp_path):
    given = flat_splats()
    wanted = given.quats_xyzw.copy()
    given.quats_xyzw[2] *= 3
    (part,) = read(glb_with_splats(given), tmp_path)
    assert np.allclose(part.splats.quats_xyzw, wanted, atol=1e-6)
    given.quats_xyzw[2] = 0
    with pytest.raises(ValueError, match=r"1 of its 5 splats have a rotation of length 0; expected unit quaternions"):
        read(glb_with_splats(given), tmp_path)
