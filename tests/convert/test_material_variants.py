"""Variants of a material in one GLB: the textures of each are those of an asset that wears it, and what does not know of them sees the asset as it is."""

import json
import struct
from pathlib import Path

import pytest
import torch
from test_export_asset import ball_asset

from drgs.convert import bake_transfer
from drgs.convert.bake_edits import bake_edits
from drgs.convert.export_asset import export_asset
from drgs.convert.import_mesh import import_mesh
from drgs.convert.material_variants import load_variants, worn_meshes
from drgs.deform.pose_scene import pose_scene
from drgs.exchange.glb import VARIANTS, decode_glb
from drgs.scene.edits import AS_CAPTURED, parse_edits

GOLD = [{"op": "material", "select": {"all": True}, "set": {"albedo": [1.0, 0.77, 0.34], "metallic": 1.0, "roughness": 0.2}}]
DARK = [{"op": "material", "select": {"all": True}, "set": {"albedo": [0.3, 0.3, 0.3]}, "mode": "multiply"}]


@pytest.fixture(autouse=True)
def _rough_shadows(monkeypatch: pytest.MonkeyPatch) -> None:
    """How finely they are baked is not asked here, but takes most of the time."""
    monkeypatch.setattr(bake_transfer, "DIRECTIONS", 16)


def document(path: Path) -> dict:
    data = path.read_bytes()
    (length,) = struct.unpack_from("<I", data, 12)
    return json.loads(data[20 : 20 + length])


def image(path: Path, material: dict, texture: str) -> bytes:
    """The file of a texture of a material."""
    data, found = path.read_bytes(), document(path)
    view = found["bufferViews"][found["images"][material["pbrMetallicRoughness"][texture]["index"]]["bufferView"]]
    (length,) = struct.unpack_from("<I", data, 12)
    start = 28 + length + view["byteOffset"]
    return data[start : start + view["byteLength"]]


@pytest.mark.slow
@pytest.mark.parametrize("faces", [None, 400], ids=["whole", "shrunk"])
def test_each_variant_has_the_textures_of_an_asset_that_wears_it(tmp_path: Path, faces: int | None) -> None:
    asset, path = ball_asset(), tmp_path / "a.glb"
    variants = {"Gold": parse_edits(GOLD), "Dark": parse_edits(DARK)}
    export_asset(asset, path, "glb", faces, variants)
    found = document(path)
    assert [one["name"] for one in found["extensions"][VARIANTS]["variants"]] == [AS_CAPTURED, "Gold", "Dark"]
    (primitive,) = found["meshes"][0]["primitives"]
    assert primitive["material"] == 0, "what a viewer shows that does not know of variants"
    assert [(one["material"], one["variants"]) for one in primitive["extensions"][VARIANTS]["mappings"]] == [(0, [0]), (1, [1]), (2, [2])]
    assert VARIANTS in found["extensionsUsed"] and "extensionsRequired" not in found
    for material, edits in zip(found["materials"], ([], *variants.values()), strict=True):
        worn = tmp_path / f"{material['name']}.glb"
        export_asset(bake_edits(asset, edits, tmp_path, 2) if edits else asset, worn, "mesh", faces)
        (alone,) = document(worn)["materials"]
        for texture in ("baseColorTexture", "metallicRoughnessTexture"):
            assert image(path, material, texture) == image(worn, alone, texture), (material["name"], texture)
        assert material["occlusionTexture"]["index"] == material["pbrMetallicRoughness"]["metallicRoughnessTexture"]["index"]
        assert ("normalTexture" in material) == (faces is not None)


@pytest.mark.slow
def test_our_importer_reads_the_asset_as_captured(tmp_path: Path) -> None:
    export_asset(ball_asset(), tmp_path / "plain.glb", "mesh")
    export_asset(ball_asset(), tmp_path / "variants.glb", "mesh", variants={"Gold": parse_edits(GOLD)})
    plain, variants = (import_mesh(tmp_path / f"{name}.glb").mesh for name in ("plain", "variants"))
    for name in ("vertices", "albedo", "roughness", "metallic"):
        assert torch.equal(getattr(plain, name), getattr(variants, name)), name
    assert len(decode_glb((tmp_path / "variants.glb").read_bytes()).faces) == len(plain.faces)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[1", "is not JSON"),
        ("[]", "expected an object"),
        ("{}", "found 0 variants"),
        ('{"Gold": {}}', "expected an object of lists"),
        ('{"Gold": [{"op": "paint"}]}', "edits: 0"),
        ('{"Gold": [{"op": "deform", "map": {"type": "twist", "rate": 1}}]}', "'Gold' has an edit of the kind 'deform'"),
        ('{" ": []}', "a variant is called ' '"),
        (f'{{"{AS_CAPTURED}": []}}', "other than"),
        (json.dumps({str(k): [] for k in range(33)}), "found 33 variants; expected 1 to 32"),
    ],
)
def test_a_file_that_is_none_is_refused_with_a_sentence(tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "variants.json"
    path.write_text(text)
    with pytest.raises(ValueError, match=said) as refused:
        load_variants(path)
    assert str(refused.value).startswith(str(path)) and "\n" not in str(refused.value)


def test_formats_that_hold_none_refuse_them(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="expected glb, mesh, html"):
        export_asset(ball_asset(), tmp_path / "a.ply", "ply", variants={"Gold": parse_edits(GOLD)})


def test_a_moved_mesh_in_a_variant_is_that_of_an_asset_that_wears_it_and_was_moved(tmp_path: Path) -> None:
    asset = ball_asset()
    twist = parse_edits([{"op": "deform", "map": {"type": "twist", "rate": 0.7}}])
    cap = {"select": {"sphere": {"center": [0, 0, 2], "radius": 1.2, "falloff": 0.1}}}
    capped = parse_edits([GOLD[0] | cap])
    made = bake_edits(asset, [*parse_edits(DARK), *twist], tmp_path, 2)
    worn, wanted = worn_meshes(asset, made.mesh, {"Cap": capped}, tmp_path)["Cap"], pose_scene(asset, [*twist, *capped]).mesh
    for name in ("vertices", "normals", "faces", "albedo", "roughness", "metallic"):
        assert torch.equal(getattr(worn, name), getattr(wanted, name)), name
    assert not torch.equal(worn.metallic, made.mesh.metallic) and not torch.equal(worn.vertices, asset.mesh.vertices)
