import hashlib
import json
import os
import zipfile
from dataclasses import fields, replace

import numpy as np
import pytest
import safetensors.numpy
import torch

from drgs.deform.pose_scene import pose_scene
from drgs.scene.albedo_detail import AlbedoDetail
from drgs.scene.asset import Asset, load_asset, save_asset
from drgs.scene.binding import Binding
from drgs.scene.camera import Camera, camera_from_opengl
from drgs.scene.certainty import Certainty
from drgs.scene.environment import Environment
from drgs.scene.gaussians import Gaussians
from drgs.scene.mesh import TriangleMesh

CERTAINTIES = ("shape", "albedo", "roughness", "metallic")


def small_asset() -> Asset:
    random = torch.Generator().manual_seed(3)
    normal, uniform = (lambda *shape: torch.randn(shape, generator=random)), (lambda *shape: torch.rand(shape, generator=random))
    gaussians = Gaussians(normal(5, 3), normal(5, 2), normal(5, 4), normal(5), normal(5, 16, 3), uniform(5, 3), uniform(5), uniform(5))
    faces = torch.tensor([[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]], dtype=torch.int32)
    mesh = TriangleMesh(normal(4, 3), faces, torch.nn.functional.normalize(normal(4, 3), dim=-1), uniform(4, 3), uniform(4), uniform(4))
    binding = Binding(torch.tensor([0, 1, 2, 3, 3], dtype=torch.int32), uniform(5, 3), normal(5))
    turn = torch.linalg.qr(normal(3, 3).double())[0]
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3], pose[:3, 3] = turn * torch.linalg.det(turn), normal(3).double()
    k = torch.tensor([[511.1, 0, 200.3], [0, 510.7, 199.9], [0, 0, 1]])
    cameras = (camera_from_opengl(pose, k, 400, 401, "r_000"), Camera(torch.eye(4), k, 7, 5, "nästa"))
    horizons = torch.randint(256, (4, 8), generator=random, dtype=torch.uint8)
    environment = Environment(uniform(4, 8, 3) * 1e3)
    certainty = Certainty(*(uniform(4).half() for _ in range(4)))
    facts = {"seed": 0, "quality": {"psnr": 30.1}}
    return Asset(gaussians, mesh, binding, environment, cameras, 0.1, facts, horizons, certainty=certainty)


def assert_equal_bits(a, b):
    assert type(a) is type(b)
    for entry in fields(a):
        x, y = getattr(a, entry.name), getattr(b, entry.name)
        if isinstance(x, torch.Tensor):
            assert x.dtype == y.dtype and x.numpy().tobytes() == y.numpy().tobytes(), entry.name
        elif hasattr(x, "__dataclass_fields__"):
            assert_equal_bits(x, y)
        elif isinstance(x, tuple):
            assert len(x) == len(y)
            for one, other in zip(x, y, strict=True):
                assert_equal_bits(one, other)
        else:
            assert x == y, entry.name


@pytest.mark.parametrize("name", ["teapot", "teapot.zip"])
def test_an_asset_survives_saving_and_loading_bit_for_bit(tmp_path, name):
    asset = small_asset()
    save_asset(asset, tmp_path / name, thumbnail_jpeg=b"\xff\xd8jpeg")
    assert_equal_bits(asset, load_asset(tmp_path / name))
    assert os.listdir(tmp_path) == [name]  # no temporary file is left


def test_horizons_of_another_mesh_are_refused(tmp_path):
    asset = replace(small_asset(), horizons=torch.zeros(5, 8, dtype=torch.uint8))
    with pytest.raises(ValueError, match="the horizons are of 5 faces, there are 4"):
        save_asset(asset, tmp_path / "a")


@pytest.mark.parametrize(
    ("values", "sentence"),
    [
        (torch.zeros(5).half(), "the certainty of shape is of 5 vertices, there are 4"),
        (torch.tensor([0.0, 1.5, -0.5, 1.0]).half(), "the certainty of shape is -0.5 to 1.5; expected numbers from 0 to 1"),
        (torch.tensor([0.0, torch.nan, torch.inf, 1.0]).half(), "Certainty.shape holds 2 values that are not finite"),
    ],
)
def test_a_certainty_that_means_nothing_is_refused_on_either_side_of_a_file(tmp_path, values, sentence):
    with pytest.raises(ValueError, match=sentence):
        save_asset(replace(small_asset(), certainty=Certainty(values, values, values, values)), tmp_path / "a")
    save_asset(small_asset(), tmp_path / "a")
    arrays = {name: values.numpy() for name in CERTAINTIES}
    rewrite_file(tmp_path / "a", "certainty.safetensors", safetensors.numpy.save(arrays))
    with pytest.raises(ValueError, match=sentence):
        load_asset(tmp_path / "a")


@pytest.mark.parametrize(
    ("data", "sentence"),
    [
        (b"nothing", r"certainty\.safetensors is damaged"),
        (safetensors.numpy.save({"shape": np.zeros(4, np.float16)}), r"certainty\.safetensors is damaged \('albedo'\)"),
        (safetensors.numpy.save({name: np.zeros((4, 1), np.float16) for name in CERTAINTIES}), "wrong shape or type; expected float16"),
        (safetensors.numpy.save({name: np.zeros(4, np.float32) for name in CERTAINTIES}), "wrong shape or type; expected float16"),
        (safetensors.numpy.save({name: np.zeros(k + 1, np.float16) for k, name in enumerate(CERTAINTIES)}), "wrong shape or type"),
    ],
)
def test_a_damaged_certainty_is_refused_with_one_sentence(tmp_path, data, sentence):
    save_asset(small_asset(), tmp_path / "a")
    rewrite_file(tmp_path / "a", "certainty.safetensors", data)
    with pytest.raises(ValueError, match=sentence) as caught:
        load_asset(tmp_path / "a")
    assert str(caught.value).startswith(str(tmp_path / "a")) and "\n" not in str(caught.value)


def rewrite_file(folder, name, data):
    """As whoever wrote it so would have: the manifest's hash fits."""
    files = json.loads((folder / "asset.json").read_text())["files"]
    (folder / name).write_bytes(data)
    edit_manifest(folder, files=files | {name: {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}})


def test_what_cameras_see_is_kept_and_decides_what_a_scene_shows(tmp_path):
    asset = small_asset()
    assert load_asset(saved(asset, tmp_path / "older")).primary is None and pose_scene(asset, []).primary == "gaussians"
    for primary in ("gaussians", "mesh"):
        chosen = replace(asset, primary=primary)
        assert load_asset(saved(chosen, tmp_path / primary)).primary == primary and pose_scene(chosen, []).primary == primary
    imported = replace(asset, gaussians=None, binding=None)
    assert pose_scene(imported, []).primary == "mesh"
    with pytest.raises(ValueError, match="its primary surface is gaussians, but it has none"):
        save_asset(replace(imported, primary="gaussians"), tmp_path / "none")


def saved(asset: Asset, path):
    save_asset(asset, path)
    return path


def test_an_asset_without_gaussians_cameras_and_what_older_ones_lack_survives_saving_and_loading(tmp_path):
    asset = replace(small_asset(), gaussians=None, binding=None, cameras=(), horizons=None, certainty=None)
    save_asset(asset, tmp_path / "a")
    assert_equal_bits(asset, load_asset(tmp_path / "a"))


def test_the_folder_holds_the_files_of_the_contract_and_a_described_manifest(tmp_path):
    save_asset(small_asset(), tmp_path / "a", thumbnail_jpeg=b"jpeg")
    files = {"gaussians.ply", "mesh.glb", "binding.safetensors", "environment.exr", "cameras.json", "thumb.jpg"}
    files |= {"horizons.safetensors", "certainty.safetensors"}
    assert set(os.listdir(tmp_path / "a")) == files | {"asset.json"}
    manifest = json.loads((tmp_path / "a" / "asset.json").read_text())
    assert manifest["schema_version"] == 1 and manifest["meters_per_unit"] == 0.1 and set(manifest["files"]) == files
    assert manifest["counts"] == {"surfels": 5, "vertices": 4, "faces": 4, "cameras": 2}
    frame = json.loads((tmp_path / "a" / "cameras.json").read_text())["frames"][0]
    rebuilt = camera_from_opengl(
        torch.tensor(frame["transform_matrix"], dtype=torch.float64), small_asset().cameras[0].intrinsics, 400, 401
    )
    assert torch.allclose(rebuilt.camera_from_world, small_asset().cameras[0].camera_from_world, atol=1e-6)


def test_the_same_asset_gives_the_same_zip(tmp_path):
    save_asset(small_asset(), tmp_path / "a.zip")
    save_asset(small_asset(), tmp_path / "b.zip")
    assert (tmp_path / "a.zip").read_bytes() == (tmp_path / "b.zip").read_bytes()


def test_a_folder_zipped_with_its_own_name_is_read(tmp_path):
    save_asset(small_asset(), tmp_path / "pot")
    with zipfile.ZipFile(tmp_path / "hand.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.write(tmp_path / "pot", "pot")
        for file in (tmp_path / "pot").iterdir():
            archive.write(file, f"pot/{file.name}")
    assert_equal_bits(small_asset(), load_asset(tmp_path / "hand.zip"))


def test_replacing_an_asset_keeps_other_files_of_the_folder_and_drops_its_own_old_ones(tmp_path):
    save_asset(small_asset(), tmp_path / "a", thumbnail_jpeg=b"old")
    (tmp_path / "a" / "checkpoints").mkdir()
    (tmp_path / "a" / "checkpoints" / "last").write_text("kept")
    smaller = replace(small_asset(), gaussians=None, binding=None)
    save_asset(smaller, tmp_path / "a")
    assert_equal_bits(smaller, load_asset(tmp_path / "a"))
    assert not (tmp_path / "a" / "thumb.jpg").exists() and not (tmp_path / "a" / "gaussians.ply").exists()
    assert (tmp_path / "a" / "checkpoints" / "last").read_text() == "kept"
    assert os.listdir(tmp_path) == ["a"]


def test_a_file_that_belongs_to_no_asset_is_never_overwritten(tmp_path):
    (tmp_path / "mesh.glb").write_bytes(b"mine")
    with pytest.raises(ValueError, match=r"already holds mesh\.glb, which belongs to no asset"):
        save_asset(small_asset(), tmp_path)
    assert os.listdir(tmp_path) == ["mesh.glb"] and (tmp_path / "mesh.glb").read_bytes() == b"mine"


def test_a_save_that_fails_midway_leaves_the_old_asset_as_it_was(tmp_path, monkeypatch):
    save_asset(small_asset(), tmp_path / "a")
    save_asset(small_asset(), tmp_path / "a.zip")

    def full_disk(_descriptor):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full_disk)
    for name in ("a", "a.zip"):
        with pytest.raises(OSError, match="No space"):
            save_asset(replace(small_asset(), meters_per_unit=2.0), tmp_path / name)
    monkeypatch.undo()
    for name in ("a", "a.zip"):
        assert_equal_bits(small_asset(), load_asset(tmp_path / name))
    assert sorted(os.listdir(tmp_path)) == ["a", "a.zip"]


def edit_manifest(folder, **changes):
    manifest = json.loads((folder / "asset.json").read_text())
    (folder / "asset.json").write_text(json.dumps(manifest | changes))


def flip_a_byte(file):
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 1
    file.write_bytes(data)


@pytest.mark.parametrize(
    ("damage", "sentence"),
    [
        (lambda a: flip_a_byte(a / "gaussians.ply"), r"gaussians\.ply has changed"),
        (lambda a: (a / "mesh.glb").write_bytes((a / "mesh.glb").read_bytes()[:-9]), r"mesh\.glb has \d+ bytes, \d+ were written"),
        (lambda a: (a / "environment.exr").unlink(), r"environment\.exr is missing"),
        (lambda a: (a / "asset.json").unlink(), r"has no asset\.json"),
        (lambda a: (a / "asset.json").write_text('{"schema_version": 1,'), r"asset\.json is damaged"),
        (lambda a: edit_manifest(a, schema_version=2), "written by a newer drgs"),
        (lambda a: edit_manifest(a, schema_version="1"), "schema version '1'"),
        (lambda a: edit_manifest(a, primary="voxels"), "primary 'voxels'; expected gaussians or mesh"),
        (lambda a: edit_manifest(a, files={"../mesh.glb": {}}), "expected plain file names"),
        (lambda a: edit_manifest(a, files={}), r"does not list mesh\.glb"),
        (lambda a: edit_manifest(a, meters_per_unit=-1), "meters_per_unit -1"),
    ],
)
def test_a_damaged_asset_is_refused_with_one_sentence(tmp_path, damage, sentence):
    save_asset(small_asset(), tmp_path / "a")
    damage(tmp_path / "a")
    with pytest.raises(ValueError, match=sentence) as caught:
        load_asset(tmp_path / "a")
    assert str(caught.value).startswith(str(tmp_path / "a")) and "\n" not in str(caught.value)


def rewrite_zip(path, change):
    with zipfile.ZipFile(path) as archive:
        entries = [(info, archive.read(info)) for info in archive.infolist()]
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        change(archive, entries)
        for info, data in entries:
            archive.writestr(info, data)


def add_symlink(archive, _entries):
    info = zipfile.ZipInfo("thumb.jpg")
    info.external_attr = 0o120777 << 16
    archive.writestr(info, "/etc/passwd")


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda archive, _: archive.writestr("../evil.txt", "x"), "no plain file inside"),
        (lambda archive, _: archive.writestr("/etc/evil", "x"), "no plain file inside"),
        (lambda archive, _: archive.writestr("c:evil", "x"), "no plain file inside"),
        (add_symlink, "no plain file inside"),
        (lambda archive, entries: entries.__setitem__(0, (entries[0][0].filename, b" " * (8 << 20))), "unpacks to more than"),
    ],
)
def test_a_hostile_zip_is_refused(tmp_path, change, sentence):
    save_asset(small_asset(), tmp_path / "a.zip")
    rewrite_zip(tmp_path / "a.zip", change)
    with pytest.raises(ValueError, match=sentence):
        load_asset(tmp_path / "a.zip")


def test_a_truncated_zip_a_missing_path_and_a_foreign_file_are_refused(tmp_path):
    save_asset(small_asset(), tmp_path / "a.zip")
    (tmp_path / "a.zip").write_bytes((tmp_path / "a.zip").read_bytes()[:-100])
    (tmp_path / "note.txt").write_text("hello")
    for name, sentence in [("a.zip", "is no zip"), ("nothing", "does not exist"), ("note.txt", "no asset folder; as a file it is no zip")]:
        with pytest.raises(ValueError, match=sentence):
            load_asset(tmp_path / name)


def test_values_that_are_not_finite_and_indices_that_point_nowhere_are_not_saved(tmp_path):
    asset = small_asset()
    centers = asset.gaussians.centers.clone()
    centers[2, 1] = np.nan
    beyond = asset.mesh.faces.clone()
    beyond[0, 0] = 4
    cases = [
        (replace(asset, gaussians=replace(asset.gaussians, centers=centers)), r"Gaussians\.centers holds 1 values"),
        (replace(asset, mesh=replace(asset.mesh, faces=beyond)), "names a vertex that does not exist"),
        (replace(asset, binding=replace(asset.binding, face=asset.binding.face + 1)), "names a face that does not exist"),
        (replace(asset, gaussians=None), "binding is of 5 surfels, there are 0"),
    ]
    for bad, sentence in cases:
        with pytest.raises(ValueError, match=sentence):
            save_asset(bad, tmp_path / "bad")
    assert os.listdir(tmp_path) == []


def detailed_asset(share: bool) -> Asset:
    asset, random = small_asset(), torch.Generator().manual_seed(5)
    codes = torch.randint(256, (4, 10, 3), generator=random, dtype=torch.uint8)
    return replace(asset, mesh=replace(asset.mesh, detail=AlbedoDetail(codes, torch.rand(4, generator=random) if share else None)))


@pytest.mark.parametrize("share", [False, True])
def test_what_lies_between_the_vertices_survives_saving_and_loading(tmp_path, share):
    asset = detailed_asset(share)
    save_asset(asset, tmp_path / "a.zip")
    assert_equal_bits(load_asset(tmp_path / "a.zip"), asset)


@pytest.mark.parametrize(
    ("arrays", "said"),
    [
        ({"share": np.ones(4, np.float32)}, "damaged"),
        ({"codes": np.ones((4, 10, 3), np.float32)}, "wrong shape or type"),
        ({"codes": np.ones((4, 9, 3), np.uint8)}, "samples of detail"),
        ({"codes": np.ones((4, 55, 3), np.uint8)}, "at most 8"),
        ({"codes": np.ones((3, 10, 3), np.uint8)}, "of 3 faces, there are 4"),
        ({"codes": np.ones((4, 10, 3), np.uint8), "share": np.ones(3, np.float32)}, "share"),
        ({"codes": np.ones((4, 10, 3), np.uint8), "share": np.full(4, 1.5, np.float32)}, "share"),
        ({"codes": np.ones((4, 10, 3), np.uint8), "share": np.full(4, np.nan, np.float32)}, "share"),
    ],
)
def test_a_wrong_detail_is_refused_in_a_sentence(tmp_path, arrays, said):
    path = tmp_path / "a"
    save_asset(detailed_asset(False), path)
    rewrite_file(path, "detail.safetensors", safetensors.numpy.save(arrays))
    with pytest.raises(ValueError, match=said):
        load_asset(path)
