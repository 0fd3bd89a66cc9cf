"""What `drgs export` wrote behind the mesh of a GLB comes back as the same Gaussians; what is no surfel is refused."""

from dataclasses import fields, replace

import numpy as np
import pytest
import torch

from drgs.convert import bake_transfer
from drgs.convert.export_asset import export_asset
from drgs.convert.import_mesh import import_mesh
from drgs.convert.import_splats import import_splats
from drgs.maths.color import srgb_from_linear
from drgs.maths.frames import rotation_from_quat_wxyz
from drgs.maths.spherical_harmonics import evaluate_sh, radiance_from_sh
from drgs.scene.asset import load_asset, save_asset
from drgs.scene.gaussians import Gaussians
from tests.convert.test_export_asset import ball_asset
from tests.exchange.write_splats import flat_splats, glb_with_splats, with_document


@pytest.fixture(autouse=True)
def few_directions(monkeypatch: pytest.MonkeyPatch) -> None:
    """How finely shadows are baked is not asked here."""
    monkeypatch.setattr(bake_transfer, "DIRECTIONS", 16)


def unit_directions(count: int) -> torch.Tensor:
    return torch.nn.functional.normalize(torch.randn(count, 3, generator=torch.Generator().manual_seed(5)), dim=-1)


@pytest.mark.slow
def test_gaussians_come_back_from_a_glb_in_metres(tmp_path):
    asset = ball_asset()
    export_asset(asset, tmp_path / "a.glb", "glb")
    found = import_mesh(tmp_path / "a.glb")
    given, gaussians = asset.gaussians, found.gaussians
    assert gaussians is not None and len(gaussians.centers) == len(given.centers)
    assert torch.allclose(gaussians.centers, 0.5 * given.centers, atol=1e-6)
    assert torch.allclose(torch.exp(gaussians.log_scales), 0.5 * torch.exp(given.log_scales), rtol=1e-6)
    quats = torch.nn.functional.normalize(given.quats_wxyz, dim=-1)
    assert torch.allclose((gaussians.quats_wxyz * quats).sum(-1).abs(), torch.ones(30), atol=1e-6)
    assert torch.allclose(torch.sigmoid(gaussians.opacity_logits), torch.sigmoid(given.opacity_logits), atol=1e-6)
    assert all(torch.equal(getattr(gaussians, name), getattr(given, name)) for name in ("albedo", "roughness", "metallic"))
    assert len(found.mesh.vertices) == len(asset.mesh.vertices) and found.primary == "mesh"


@pytest.mark.slow
def test_colours_come_back_as_linear_radiance(tmp_path):
    """Sixteen harmonics hold neither curve exactly: what is compared is what is seen."""
    asset = ball_asset()
    export_asset(asset, tmp_path / "a.glb", "glb")
    found, directions = import_splats(tmp_path / "a.glb"), unit_directions(30)
    assert found is not None
    shown, wanted = (srgb_from_linear(radiance_from_sh(sh, directions).clamp(0, 1)) for sh in (found.sh, asset.gaussians.sh))
    assert (shown - wanted).abs().max() < 0.06 and (shown - wanted).abs().mean() < 0.01


def test_linear_colours_are_taken_as_they_are(tmp_path):
    given = flat_splats(color_space="lin_rec709_display")
    (tmp_path / "a.glb").write_bytes(glb_with_splats(given))
    found = import_splats(tmp_path / "a.glb")
    assert found is not None and np.allclose(found.sh, given.sh, atol=1e-6)


def test_a_turned_node_turns_places_axes_and_colours(tmp_path):
    given = flat_splats(color_space="lin_rec709_display")
    quat_xyzw = np.array([0.1, -0.5, 0.3, 0.8]) / np.linalg.norm([0.1, -0.5, 0.3, 0.8])
    turn = rotation_from_quat_wxyz(torch.from_numpy(quat_xyzw[[3, 0, 1, 2]]))

    def place(document: dict) -> None:
        del document["nodes"][1]["matrix"]
        document["nodes"][1] |= {"rotation": quat_xyzw.tolist(), "scale": [2, 2, 2], "translation": [1, 2, 3]}

    (tmp_path / "a.glb").write_bytes(with_document(glb_with_splats(given), place))
    found = import_splats(tmp_path / "a.glb")
    assert found is not None
    world_from_gltf = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]], dtype=torch.float64)
    world_from_splats = world_from_gltf @ turn
    centers = 2 * torch.from_numpy(given.centers).double() @ world_from_splats.T + torch.tensor([1.0, -3, 2])
    assert torch.allclose(found.centers.double(), centers, atol=1e-5)
    assert np.allclose(torch.exp(found.log_scales), 2 * given.scales[:, :2], rtol=1e-5)
    axes = world_from_splats @ rotation_from_quat_wxyz(torch.from_numpy(given.quats_xyzw[:, [3, 0, 1, 2]]).double())
    assert torch.allclose(rotation_from_quat_wxyz(found.quats_wxyz).double(), axes, atol=1e-5)
    directions = unit_directions(5).double()
    colors = evaluate_sh(torch.from_numpy(given.sh).double(), directions)
    assert torch.allclose(evaluate_sh(found.sh.double(), directions @ world_from_splats.T), colors, atol=1e-5)


@pytest.mark.slow
def test_what_came_back_is_an_asset_whose_gaussians_follow_its_mesh(tmp_path):
    export_asset(ball_asset(), tmp_path / "a.glb", "glb")
    found = import_mesh(tmp_path / "a.glb")
    save_asset(found, tmp_path / "asset")
    read = load_asset(tmp_path / "asset")
    assert read.gaussians is not None and read.binding is not None and len(read.binding.face) == 30
    export_asset(read, tmp_path / "b.glb", "glb")
    again = import_splats(tmp_path / "b.glb")
    assert again is not None and torch.allclose(again.centers, found.gaussians.centers, atol=1e-6)


@pytest.mark.slow
def test_the_mesh_alone_is_there_for_who_wants_a_small_file(tmp_path):
    asset = ball_asset()
    export_asset(asset, tmp_path / "both.glb", "glb")
    export_asset(asset, tmp_path / "mesh.glb", "mesh")
    export_asset(replace(asset, gaussians=None), tmp_path / "none.glb", "glb")
    export_asset(
        replace(asset, gaussians=Gaussians(**{e.name: getattr(asset.gaussians, e.name)[:0] for e in fields(Gaussians)})),
        tmp_path / "no.glb",
        "glb",
    )
    mesh = (tmp_path / "mesh.glb").read_bytes()
    assert b"KHR_" not in mesh and mesh == (tmp_path / "none.glb").read_bytes() == (tmp_path / "no.glb").read_bytes()
    more = (tmp_path / "both.glb").stat().st_size - len(mesh)
    assert 30 * 260 < more < 30 * 260 + 8000, "260 bytes a Gaussian, and their JSON"
    found = import_mesh(tmp_path / "mesh.glb")
    assert found.gaussians is None and found.binding is None and found.primary is None


def test_what_is_no_surfel_is_refused(tmp_path):
    path = tmp_path / "a.glb"

    def refused(data: bytes, sentence: str) -> None:
        path.write_bytes(data)
        with pytest.raises(ValueError, match=sentence):
            import_mesh(path)

    round_ones, points = flat_splats(), flat_splats()
    round_ones.scales[1:, 2] = 0.05
    points.scales[:2, 0] = 0
    bright = flat_splats()
    bright.materials["_ALBEDO"][0] = 2
    refused(glb_with_splats(round_ones), r"3D Gaussians: the third scale of 4 of 5 splats is above 0\.01 of the others; expected flat ones")
    refused(glb_with_splats(points), r"2 of its 5 splats have no width")
    refused(glb_with_splats(bright), r"_ALBEDO of its splats spans 0.* to 2; expected 0 to 1")
    uneven, mirrored = ({"scale": scale, "mesh": 1} for scale in ([1, 2, 1], [1, 1, -1]))
    for node in (uneven, mirrored):
        refused(
            with_document(glb_with_splats(), lambda d, node=node: d["nodes"].__setitem__(1, node)), "a node mirrors its splats or stretches"
        )
    far = {"translation": [1e29, 0, 0], "scale": [1e8] * 3, "mesh": 1}
    refused(
        with_document(glb_with_splats(), lambda d: d["nodes"].extend([far, {"scale": [1e9] * 3, "children": [2]}])),
        "reach .* expected an object",
    )
    refused(with_document(glb_with_splats(), lambda d: d.update(scene=1)), "holds 5 splats and no triangles; an asset needs a mesh")
