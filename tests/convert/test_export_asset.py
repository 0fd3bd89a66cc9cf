import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh

from drgs.convert.export_asset import display_sh, export_asset
from drgs.convert.import_mesh import import_mesh
from drgs.exchange.exr import decode_environment
from drgs.exchange.gaussian_ply import decode_gaussian_ply
from drgs.exchange.ply import parse_ply
from drgs.maths.color import srgb_from_linear
from drgs.maths.frames import rotation_from_quat_wxyz
from drgs.maths.spherical_harmonics import evaluate_sh
from drgs.scene.asset import Asset
from drgs.scene.environment import Environment
from drgs.scene.gaussians import Gaussians
from drgs.scene.mesh import TriangleMesh
from tests.exchange.read_spz import read_spz


def ball_asset() -> Asset:
    shape = trimesh.creation.icosphere(3)
    vertices = torch.tensor(np.asarray(shape.vertices), dtype=torch.float32)
    albedo, smooth = 0.1 + 0.8 * (vertices + 1) / 2, (vertices[:, 2] + 1) / 2
    mesh = TriangleMesh(
        vertices + torch.tensor([0, 0, 2.0]), torch.tensor(np.asarray(shape.faces), dtype=torch.int32), vertices, albedo, smooth, 1 - smooth
    )
    random = torch.Generator().manual_seed(0)
    n = 30
    gaussians = Gaussians(
        torch.randn(n, 3, generator=random), torch.randn(n, 2, generator=random) - 3, torch.randn(n, 4, generator=random),
        torch.randn(n, generator=random), 0.1 * torch.randn(n, 16, 3, generator=random), torch.rand(n, 3, generator=random),
        torch.rand(n, generator=random), torch.rand(n, generator=random),
    )  # fmt: skip
    return Asset(gaussians, mesh, None, Environment(torch.rand(4, 8, 3, generator=random)), meters_per_unit=0.5)


@pytest.mark.slow
def test_an_exported_glb_comes_back_with_its_materials_upright_and_in_metres(tmp_path):
    asset = ball_asset()
    export_asset(asset, tmp_path / "a.glb", "glb")
    mesh = import_mesh(tmp_path / "a.glb").mesh
    distance, original = torch.cdist(mesh.vertices, 0.5 * asset.mesh.vertices, compute_mode="donot_use_mm_for_euclid_dist").min(
        1
    )  # unwrapping reorders them
    assert len(mesh.vertices) == len(asset.mesh.vertices) and distance.max() < 1e-6
    assert torch.equal(original[mesh.faces.long()], asset.mesh.faces.long())
    assert torch.allclose(mesh.normals, asset.mesh.normals[original], atol=1e-5)
    for name in ("albedo", "roughness", "metallic"):
        assert (getattr(mesh, name) - getattr(asset.mesh, name)[original]).abs().max() < 0.03, name


def test_a_glb_with_fewer_faces_says_so_and_comes_back_as_the_same_ball(tmp_path):
    asset = ball_asset()
    said = export_asset(asset, tmp_path / "a.glb", "mesh", faces=400)
    mesh = import_mesh(tmp_path / "a.glb").mesh
    assert said == f"{len(mesh.faces)} of the mesh's 1280 faces, the detail of the others in its textures"
    assert 300 < len(mesh.faces) <= 400
    outwards = mesh.vertices / 0.5 - torch.tensor([0, 0, 2.0])
    assert (outwards.norm(dim=-1) - 1).abs().max() < 0.03 and (mesh.normals * outwards).sum(-1).min() > 0.97
    height = (outwards[:, 2] + 1) / 2
    assert (mesh.roughness - height).abs().max() < 0.05 and (mesh.metallic + mesh.roughness - 1).abs().max() < 0.02
    assert (mesh.albedo - (0.1 + 0.4 * (outwards + 1))).abs().max() < 0.05


def test_a_gaussian_ply_keeps_shape_and_materials_and_shows_srgb_colours(tmp_path):
    asset = ball_asset()
    export_asset(asset, tmp_path / "a.ply", "ply")
    data = (tmp_path / "a.ply").read_bytes()
    read = decode_gaussian_ply(data)
    for name in ("centers", "log_scales", "quats_wxyz", "opacity_logits", "albedo", "roughness", "metallic"):
        assert np.array_equal(read[name], getattr(asset.gaussians, name)), name
    assert "scale_2" not in parse_ply(data).elements["vertex"].scalars
    direction = torch.nn.functional.normalize(torch.randn(30, 3), dim=-1)
    shown = evaluate_sh(torch.from_numpy(read["sh"]), direction) + 0.5
    wanted = srgb_from_linear((evaluate_sh(asset.gaussians.sh, direction) + 0.5).clamp(0, 1))
    assert (shown - wanted).abs().max() < 0.05 and (shown - wanted).abs().mean() < 0.01


def test_a_colour_that_is_the_same_from_everywhere_is_converted_exactly():
    sh = torch.zeros(2, 16, 3, dtype=torch.float64)
    found = display_sh(sh)
    assert torch.allclose(found[:, 0] * 0.28209479177387814 + 0.5, srgb_from_linear(torch.tensor(0.5, dtype=torch.float64)))
    assert torch.allclose(found[:, 1:], torch.zeros(1, dtype=torch.float64), atol=1e-12)


def test_the_third_scale_is_there_for_3dgs_viewers_only(tmp_path):
    export_asset(ball_asset(), tmp_path / "a.ply", "ply3")
    assert (parse_ply((tmp_path / "a.ply").read_bytes()).elements["vertex"].scalars["scale_2"] < -8).all()


def test_an_spz_holds_the_gaussians_upright_in_metres(tmp_path):
    asset = ball_asset()
    assert asset.gaussians is not None
    assert export_asset(asset, tmp_path / "a.spz", "spz") == ""
    found = read_spz((tmp_path / "a.spz").read_bytes())
    turn = torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    assert np.abs(found.centers - 0.5 * (asset.gaussians.centers @ turn.T).numpy()).max() < 1e-4
    assert np.abs(found.log_scales[:, :2] - np.log(0.5) - asset.gaussians.log_scales.numpy()).max() < 0.04
    assert (found.log_scales[:, 2] == -10).all(), "as thin as the format goes"
    wanted = turn @ rotation_from_quat_wxyz(asset.gaussians.quats_wxyz)
    there = rotation_from_quat_wxyz(torch.from_numpy(found.quats_xyzw[:, [3, 0, 1, 2]]).float())
    assert (there - wanted).abs().max() < 0.01
    direction = torch.nn.functional.normalize(torch.randn(30, 3), dim=-1)
    shown = evaluate_sh(torch.from_numpy(found.sh).float(), direction @ turn.T)
    assert (shown - evaluate_sh(display_sh(asset.gaussians.sh), direction)).abs().max() < 0.03


def test_splats_too_small_for_an_spz_are_counted(tmp_path):
    asset = replace(ball_asset(), meters_per_unit=1e-3)
    assert asset.gaussians is not None
    small = int((asset.gaussians.log_scales.amin(1) + np.log(1e-3) < -10).sum())
    assert 0 < small < 30
    assert export_asset(asset, tmp_path / "a.spz", "spz") == f"{small} of 30 splats wider than they are"


def test_the_environment_is_exported_bit_for_bit(tmp_path):
    asset = ball_asset()
    export_asset(asset, tmp_path / "sub" / "env.exr", "env")
    assert np.array_equal(decode_environment((tmp_path / "sub" / "env.exr").read_bytes()), asset.environment.radiance)


def test_what_cannot_be_exported_is_refused_with_a_sentence_and_leaves_nothing(tmp_path, monkeypatch):
    asset = ball_asset()
    (tmp_path / "old.usd").write_text("kept")
    monkeypatch.setitem(sys.modules, "pxr", None)
    with pytest.raises(ValueError, match="needs the package usd-core"):
        export_asset(asset, tmp_path / "old.usd", "usd")
    with pytest.raises(ValueError, match="needs the package usd-core"):
        export_asset(asset, tmp_path / "a.usdz", "usdz")
    with pytest.raises(ValueError, match="expected a name ending in"):
        export_asset(asset, tmp_path / "a.txt", "usd")
    with pytest.raises(ValueError, match=r"expected a name ending in \.usdz"):
        export_asset(asset, tmp_path / "a.usda", "usdz")
    with pytest.raises(ValueError, match="needs Gaussians"):
        export_asset(replace(asset, gaussians=None), tmp_path / "a.ply", "ply")
    with pytest.raises(ValueError, match="format 'fbx' is unknown; expected glb, mesh, html, ply, ply3, spz, usdz, usd, env"):
        export_asset(asset, tmp_path / "a.fbx", "fbx")  # pyright: ignore
    with pytest.raises(ValueError, match="100 faces were asked for of format 'ply', which has no textures; expected glb, mesh, usdz, usd"):
        export_asset(asset, tmp_path / "a.ply", "ply", faces=100)
    with pytest.raises(ValueError, match="3 faces were asked for; expected at least 4"):
        export_asset(asset, tmp_path / "a.glb", "glb", faces=3)
    with pytest.raises(ValueError, match="is a folder"):
        export_asset(asset, tmp_path, "glb")
    assert [entry.name for entry in tmp_path.iterdir()] == ["old.usd"] and (tmp_path / "old.usd").read_text() == "kept"
