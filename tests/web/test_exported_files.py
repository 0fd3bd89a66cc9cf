"""What others make of exported files: Khronos' glTF validator, three.js, and splat-transform, which reads PLY for SuperSplat.

Each check is also run on files with one thing wrong in them, which must not pass.
"""

import json
import struct
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from drgs.convert.export_asset import display_sh, export_asset
from drgs.convert.import_splats import import_splats
from drgs.exchange import texture_atlas
from drgs.exchange.gaussian_ply import decode_gaussian_ply
from drgs.exchange.glb import VARIANTS, GlbMesh, encode_glb
from drgs.exchange.gltf_splats import EXTENSION, GltfSplats
from drgs.exchange.ply import encode_ply, parse_ply
from drgs.maths.frames import rotation_from_quat_wxyz
from drgs.maths.spherical_harmonics import evaluate_sh
from drgs.scene.asset import Asset, save_asset
from drgs.scene.edits import parse_edits
from tests.convert.test_export_asset import ball_asset
from tests.exchange.write_splats import flat_splats, glb_with_splats, splats_of, with_document
from tests.patience import PATIENCE_SECONDS
from tests.web.browser import ROOT

ERROR, WARNING, INFORMATION = 0, 1, 2
"""The validator's severities; a hint is 3."""
TURN_DEGREES, ENLARGED = (20.0, 30.0, 40.0), 2.0
"""Splats are read, turned around x, then y, then z, made larger and written: only who knows what every column means can."""


def findings(run_node: Callable[..., str], folder: Path, **files: bytes) -> dict[str, list[dict]]:
    """The validator's messages by file."""
    for name, data in files.items():
        (folder / name).write_bytes(data)
    said = json.loads(run_node("tests/validate_glb.mjs", *(folder / name for name in files)))
    return dict(zip(files, said, strict=True))


def test_the_gltf_validator_finds_no_fault_in_an_exported_glb(run_node, tmp_path, monkeypatch):
    asset = ball_asset()
    save_asset(asset, tmp_path / "asset")
    export_asset(asset, tmp_path / "charts.glb", "glb")
    export_asset(asset, tmp_path / "shrunk.glb", "mesh", faces=300)
    monkeypatch.setattr(texture_atlas, "MAX_UNWRAP_FACES", 0)
    export_asset(asset, tmp_path / "cells.glb", "glb")
    paths = {name: tmp_path / f"{name}.glb" for name in ("charts", "shrunk", "cells")} | {"stored": tmp_path / "asset" / "mesh.glb"}
    files = {name: path.read_bytes() for name, path in paths.items()}
    said = findings(run_node, tmp_path, **files, under_our_names=with_document(files["charts"], name_splats_as_ours))
    new = [("UNSUPPORTED_EXTENSION", INFORMATION)]
    told = {name: sorted({(message["code"], message["severity"]) for message in messages}) for name, messages in said.items()}
    assert set(told["cells"]) - set(told["charts"]) <= {("IMAGE_NPOT_DIMENSIONS", INFORMATION)}, (
        "cells fill what they need, no power of two"
    )
    assert told["under_our_names"] == new and told["stored"] == told["shrunk"] == []
    assert told["charts"] == [("MESH_PRIMITIVE_INVALID_ATTRIBUTE", ERROR), *new]
    refused = {message["pointer"].rpartition("/")[2] for message in said["charts"] if message["severity"] == ERROR}
    assert len(refused) == 19 and all(name.startswith(f"{EXTENSION}:") for name in refused), (
        "names with a prefix, which it does not know yet"
    )


def test_the_gltf_validator_knows_variants_and_finds_no_fault_in_them(run_node, tmp_path):
    gold = parse_edits([{"op": "material", "select": {"all": True}, "set": {"metallic": 1.0}}])
    export_asset(ball_asset(), tmp_path / "whole.glb", "mesh", faces=300, variants={"Gold": gold, "Plain": []})
    whole = (tmp_path / "whole.glb").read_bytes()

    def points_nowhere(document: dict) -> None:
        document["meshes"][0]["primitives"][0]["extensions"][VARIANTS]["mappings"][1]["material"] = 9

    said = findings(run_node, tmp_path, whole=whole, points_nowhere=with_document(whole, points_nowhere))
    assert said["whole"] == []
    assert "UNRESOLVED_REFERENCE" in {message["code"] for message in said["points_nowhere"]}


def name_splats_as_ours(document: dict) -> None:
    """Attributes under names of an application's own: this validator takes all others for mistakes (KhronosGroup/glTF-Validator 252)."""
    primitive = splats_of(document)
    primitive["attributes"] = {name.replace(f"{EXTENSION}:", "_SPLAT_"): index for name, index in primitive["attributes"].items()}


def test_the_gltf_validator_finds_what_is_missing_or_wrong(run_node, tmp_path):
    corners, faces = np.eye(4, 3, dtype=np.float32), np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    up = np.repeat(np.array([[0, 0, 1]], np.float32), 4, 0)
    good = encode_glb(GlbMesh({"POSITION": corners, "NORMAL": up}, faces))

    def edited(old: bytes, new: bytes) -> bytes:
        """With another word of the same length in its JSON."""
        end = 20 + struct.unpack_from("<I", good, 12)[0]
        assert len(old) == len(new) and old in good[:end]
        return good[:end].replace(old, new) + good[end:]

    said = findings(
        run_node,
        tmp_path,
        good=good,
        long_normals=encode_glb(GlbMesh({"POSITION": corners, "NORMAL": 2 * up}, faces)),
        no_texture=encode_glb(GlbMesh({"POSITION": corners, "NORMAL": up}, faces, {"baseColorTexture": {"index": 0}})),
        wrong_bound=edited(b'"max":[1.0', b'"max":[2.0'),
        no_bound=edited(b'"min"', b'"mim"'),
    )
    faults = {name: {message["code"] for message in messages if message["severity"] <= WARNING} for name, messages in said.items()}
    assert faults["good"] == set()
    assert "ACCESSOR_VECTOR3_NON_UNIT" in faults["long_normals"]
    assert "UNRESOLVED_REFERENCE" in faults["no_texture"]
    assert "ACCESSOR_MAX_MISMATCH" in faults["wrong_bound"]
    assert "MESH_PRIMITIVE_POSITION_ACCESSOR_WITHOUT_BOUNDS" in faults["no_bound"]


def test_three_reads_the_splats_and_opens_the_mesh_alone(run_node, tmp_path):
    """Its plugin for KHR_gaussian_splatting, as it is: what it would upload, to the byte where it packs bytes."""
    given = flat_splats(40)
    (tmp_path / "a.glb").write_bytes(glb_with_splats(given, meters_per_unit=0.5))
    splats = splats_in_three(run_node, tmp_path / "a.glb", given)
    assert np.allclose(splats["columns_of_matrix"], [0.5, 0, 0, 0, 0, 0, -0.5, 0, 0, 0.5, 0, 0, 0, 0, 0, 1])


def splats_in_three(run_node: Callable[..., str], path: Path, given: GltfSplats) -> dict:
    """What three.js would draw of a GLB's splats; AssertionError where that is not what was meant, or where it opens more than the mesh."""
    (file,) = json.loads(run_node("tests/read_splats.mjs", path))
    assert file["opened"] == ["Group", "Mesh"]
    (splats,) = file["splats"]
    count = len(given.centers)
    assert np.array_equal(np.reshape(splats["centers"], (-1, 3)), given.centers)
    spread = rotation_from_quat_wxyz(torch.from_numpy(given.quats_xyzw[:, [3, 0, 1, 2]]).double()).numpy() * given.scales[:, None]
    rows, columns = np.triu_indices(3)
    assert np.allclose(np.reshape(splats["covariances"], (-1, 6)), (spread @ spread.swapaxes(1, 2))[:, rows, columns], atol=1e-9)
    shown = np.concatenate([given.sh[:, 0] * 0.28209479177387814 + 0.5, given.opacities[:, None]], -1)
    assert np.abs(np.reshape(splats["colors"], (-1, 4)) - 255 * shown.clip(0, 1)).max() < 0.51
    for degree, packed in enumerate(splats["harmonics"], 1):
        first, terms = degree * degree, 2 * degree + 1
        found = np.reshape(packed, (count, -1))[:, : 3 * terms].reshape(count, terms, 3)
        assert np.abs(found - (128 * given.sh[:, first : first + terms] + 128).clip(0, 255)).max() < 0.51, degree
    return splats


def test_splats_in_gltf_by_another_program_are_read_as_they_were_meant(run_node, tmp_path):
    asset = ball_asset()
    export_asset(asset, tmp_path / "a.ply", "ply3")
    run_node("node_modules/@playcanvas/splat-transform/bin/cli.mjs", "--quiet", "--overwrite", tmp_path / "a.ply", tmp_path / "a.glb")
    found, given = import_splats(tmp_path / "a.glb"), meant(asset)
    assert found is not None
    # It takes a PLY for upside down, half a turn around z, and y for up.
    turn = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]) @ np.diag([-1.0, -1, 1])
    assert np.allclose(found.centers, given["centers"] @ turn.T, atol=1e-5)
    assert np.allclose(found.log_scales, given["log_scales"], atol=1e-5)
    assert np.allclose(rotations({"quats_wxyz": found.quats_wxyz.numpy()}), turn @ rotations(given), atol=1e-5)
    assert np.allclose(torch.sigmoid(found.opacity_logits), 1 / (1 + np.exp(-given["opacity_logits"])), atol=1e-6)
    directions = np.random.default_rng(0).normal(size=given["centers"].shape)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    shown = radiance({"sh": display_sh(found.sh).numpy()}, directions @ turn.T)
    assert np.abs(shown - radiance(given, directions)).mean() < 0.01 and np.abs(shown - radiance(given, directions)).max() < 0.06


def test_splat_transform_reads_an_exported_spz_as_it_was_meant(run_node, tmp_path):
    check_spz(run_node, ball_asset(), tmp_path)


def check_spz(run_node: Callable[..., str], asset: Asset, folder: Path) -> None:
    """AssertionError where splat-transform does not read the SPZ of an asset as it was meant; the third scales of small ones may be wider."""
    export_asset(asset, folder / "a.spz", "spz")
    run_node("node_modules/@playcanvas/splat-transform/bin/cli.mjs", "--quiet", "--overwrite", folder / "a.spz", folder / "a.ply")
    given, read = meant(asset), parse_ply((folder / "a.ply").read_bytes()).elements["vertex"].scalars
    unit = asset.meters_per_unit

    def columns(*names: str) -> np.ndarray:
        return np.stack([read[name] for name in names], -1).astype(float)

    # It writes into a PLY what stands in an SPZ, whose frame has y up.
    turn = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    assert np.allclose(columns("x", "y", "z"), unit * given["centers"] @ turn.T, atol=1e-4)
    assert np.allclose(columns("scale_0", "scale_1"), given["log_scales"] + np.log(unit), atol=0.04)
    assert (columns("scale_2") == -10).all()
    assert np.allclose(rotations({"quats_wxyz": columns("rot_0", "rot_1", "rot_2", "rot_3")}), turn @ rotations(given), atol=0.01)
    assert np.allclose(1 / (1 + np.exp(-columns("opacity")[:, 0])), 1 / (1 + np.exp(-given["opacity_logits"])), atol=0.003)
    directions = np.random.default_rng(0).normal(size=given["centers"].shape)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    assert np.allclose(radiance({"sh": harmonics(read)}, directions @ turn.T), radiance(given, directions), atol=0.03)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["a.sog", "a.compressed.ply"])
def test_the_command_has_splat_transform_write_what_it_reads_back(run_node, tmp_path, name):
    """Where Node is there; of the file its own reader gets as many splats as the asset has, at their places."""
    asset = ball_asset()
    save_asset(asset, tmp_path / "asset")
    said = subprocess.run(
        [sys.executable, "-m", "drgs", "export", str(tmp_path / "asset"), str(tmp_path / name)],
        check=True, capture_output=True, text=True, timeout=PATIENCE_SECONDS, cwd=ROOT,
    ).stderr  # fmt: skip
    assert f"Wrote {tmp_path / name}" in said and "materials left out" in said
    run_node("node_modules/@playcanvas/splat-transform/bin/cli.mjs", "--quiet", tmp_path / name, tmp_path / "back.ply")
    read = parse_ply((tmp_path / "back.ply").read_bytes()).elements["vertex"].scalars
    found = np.stack([read[axis] for axis in "xyz"], -1).astype(float)
    given = meant(asset)["centers"]
    nearest = np.linalg.norm(found[:, None] - given[None], axis=-1).min(0)
    assert len(found) == len(given) and nearest.max() < 0.01 * np.ptp(given)


def check_splats(run_node: Callable[..., str], path: Path, given: dict[str, np.ndarray], model: str) -> None:
    """AssertionError where splat-transform does not read a PLY as it was meant.

    Args:
        given: what was meant, by the names of `encode_gaussian_ply`.
        model: what it should be taken for, `2dgs` or `default` (3D Gaussians).
    """
    turned_path = path.with_name("turned.ply")
    turn = ",".join(map(str, TURN_DEGREES))
    options = ("--quiet", "--overwrite", path, "--stats", "json", "--rotate", turn, "--scale", ENLARGED, turned_path)
    said = json.loads(run_node("node_modules/@playcanvas/splat-transform/bin/cli.mjs", *options))
    assert said["gaussian"], "not taken for splats"
    assert (said["model"], said["shBands"], said["numGaussians"]) == (model, 3, len(given["centers"]))
    extras = {extra["name"] for extra in said["extraColumns"]}
    assert extras == {"nx", "ny", "nz", "base_color_0", "base_color_1", "base_color_2", "metallic", "roughness"}, "other columns"
    (level,) = said["stats"]
    largest = dict(zip(level["columns"], level["data"]["max"], strict=True))
    if model == "2dgs":
        assert level["data"]["infCount"][level["columns"].index("scale_2")] == said["numGaussians"], "no thickness: log 0"
    else:
        assert 0 < largest["scale_2"] < 1e-5 * np.ptp(given["centers"], axis=0).max(), "flat"
    assert largest["scale_0"] == pytest.approx(np.exp(given["log_scales"][:, 0]).max(), rel=1e-4)
    assert largest["opacity"] == pytest.approx(1 / (1 + np.exp(-given["opacity_logits"].max())), rel=1e-4)

    found = decode_gaussian_ply(turned_path.read_bytes())
    turn_matrix = turn_of_supersplat()
    assert np.allclose(found["centers"], ENLARGED * given["centers"] @ turn_matrix.T, atol=1e-5)
    assert np.allclose(found["log_scales"], given["log_scales"] + np.log(ENLARGED), atol=1e-5)
    assert np.allclose(rotations(found), turn_matrix @ rotations(given), atol=1e-5), "other rotations"
    directions = np.random.default_rng(0).normal(size=given["centers"].shape)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    assert np.allclose(radiance(found, directions @ turn_matrix.T), radiance(given, directions), atol=1e-5), "other colours"
    assert all(np.array_equal(found[name], given[name]) for name in ("opacity_logits", "albedo", "roughness", "metallic"))


def turn_of_supersplat() -> np.ndarray:
    """(3, 3) of TURN_DEGREES in the file's frame: SuperSplat shows a PLY upside down, half a turn around z, and turns it there."""
    turn = np.eye(3)
    for axis, degrees in enumerate(TURN_DEGREES):
        c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
        i, j = (axis + 1) % 3, (axis + 2) % 3
        step = np.eye(3)
        step[i, i], step[i, j], step[j, i], step[j, j] = c, -s, s, c
        turn = step @ turn
    half_turn = np.diag([-1.0, -1.0, 1.0])
    return half_turn @ turn @ half_turn


def rotations(splats: dict[str, np.ndarray]) -> np.ndarray:
    return rotation_from_quat_wxyz(torch.from_numpy(splats["quats_wxyz"]).double()).numpy()


def radiance(splats: dict[str, np.ndarray], directions: np.ndarray) -> np.ndarray:
    return evaluate_sh(torch.from_numpy(splats["sh"]).double(), torch.from_numpy(directions)).numpy()


def harmonics(read: dict[str, np.ndarray]) -> np.ndarray:
    """(splat, 16, 3) of the columns of a PLY."""
    rest = np.stack([read[f"f_rest_{k}"] for k in range(45)], -1).reshape(-1, 3, 15).transpose(0, 2, 1)
    return np.concatenate([np.stack([read[f"f_dc_{k}"] for k in range(3)], -1)[:, None], rest], 1).astype(float)


def meant(asset: Asset) -> dict[str, np.ndarray]:
    """What the PLY of an asset should say."""
    arrays = {key: values.numpy() for key, values in vars(asset.gaussians).items()}
    return arrays | {"sh": display_sh(asset.gaussians.sh).numpy()}


@pytest.mark.parametrize(("format", "model"), [("ply", "2dgs"), ("ply3", "default")])
def test_supersplats_reader_takes_every_column_of_an_exported_ply_as_it_was_meant(run_node, tmp_path, format, model):
    asset = ball_asset()
    export_asset(asset, tmp_path / "a.ply", format)
    check_splats(run_node, tmp_path / "a.ply", meant(asset), model)


SPOILED = {
    "a rotation's last number is missing": (lambda columns: without(columns, "rot_3"), "not taken for splats"),
    "metallic is missing": (lambda columns: without(columns, "metallic"), "other columns"),
    "there is a third scale": (lambda columns: columns | {"scale_2": columns["scale_1"] - 9}, "default"),
    "w comes last": (lambda columns: columns | {f"rot_{k}": columns[f"rot_{(k + 1) % 4}"] for k in range(4)}, "other rotations"),
    "colours alternate": (
        lambda columns: columns | {f"f_rest_{k}": columns[f"f_rest_{k % 3 * 15 + k // 3}"] for k in range(45)},
        "other colours",
    ),
}


@pytest.mark.parametrize("what", SPOILED)
def test_a_ply_that_says_something_else_does_not_pass(run_node, tmp_path, what):
    asset = ball_asset()
    export_asset(asset, tmp_path / "a.ply", "ply")
    ply = parse_ply((tmp_path / "a.ply").read_bytes())
    spoil, complaint = SPOILED[what]
    # Without the comment that names the model: columns alone must tell.
    (tmp_path / "a.ply").write_bytes(encode_ply({"vertex": spoil(ply.elements["vertex"].scalars)}))
    with pytest.raises(AssertionError, match=complaint):
        check_splats(run_node, tmp_path / "a.ply", meant(asset), "2dgs")


def without(columns: dict, name: str) -> dict:
    return {key: values for key, values in columns.items() if key != name}
