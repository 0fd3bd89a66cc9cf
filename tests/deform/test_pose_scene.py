import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from drgs.deform import pose_scene as pose_module
from drgs.deform.displace.maps import evaluate_map
from drgs.deform.pose_scene import pose_scene
from drgs.exchange.exr import encode_environment
from drgs.maths.frames import rotation_from_quat_wxyz
from drgs.scene.albedo_detail import AlbedoDetail
from drgs.scene.asset import Asset
from drgs.scene.binding import Binding
from drgs.scene.edits import TwistMap, parse_edits
from drgs.scene.environment import Environment
from drgs.scene.gaussians import Gaussians, surfel_tangents
from drgs.scene.mesh import TriangleMesh
from drgs.scene.select_vertices import select_vertices

GRID = 9


def plate_asset() -> Asset:
    """A plate of 9x9 vertices in z = 0.2, left half metal, right half not, a surfel on every face."""
    steps = torch.linspace(-0.8, 0.8, GRID)
    x, y = (values.reshape(-1) for values in torch.meshgrid(steps, steps, indexing="ij"))
    vertices = torch.stack([x, y, torch.full_like(x, 0.2)], -1)
    cell = torch.tensor(
        [[i * GRID + j, (i + 1) * GRID + j, (i + 1) * GRID + j + 1, i * GRID + j + 1] for i in range(GRID - 1) for j in range(GRID - 1)]
    )
    faces = torch.cat([cell[:, [0, 1, 2]], cell[:, [0, 2, 3]]]).int()
    up = torch.tensor([0.0, 0, 1]).expand_as(vertices).contiguous()
    metallic = (x < -0.01).float()
    mesh = TriangleMesh(vertices, faces, up, torch.full_like(vertices, 0.4), torch.full_like(x, 0.6), metallic)
    count = len(faces)
    barycentric = torch.full((count, 3), 1 / 3)
    centers = vertices[faces.long()].mean(1) + torch.tensor([0, 0, 0.01])
    random = torch.Generator().manual_seed(0)
    gaussians = Gaussians(
        centers, torch.full((count, 2), -3.0), torch.randn(count, 4, generator=random), torch.randn(count, generator=random), torch.zeros(count, 16, 3),
        torch.full((count, 3), 0.4), torch.full((count,), 0.6), (centers[:, 0] < 0).float(),
    )  # fmt: skip
    return Asset(
        gaussians,
        mesh,
        Binding(torch.arange(count, dtype=torch.int32), barycentric, torch.full((count,), 0.01)),
        Environment(torch.ones(4, 8, 3)),
    )


def pose(asset, *edits, **keywords):
    return pose_scene(asset, parse_edits(list(edits)), **keywords)


def material(select, mode="absolute", **values):
    return {"op": "material", "select": select, "set": values, "mode": mode}


def twist(rate: float) -> dict:
    return {"op": "deform", "map": {"type": "twist", "rate": rate}}


TWIST = twist(0.6)


def test_without_edits_the_scene_is_the_asset_bit_for_bit():
    asset = plate_asset()
    scene = pose(asset)
    assert scene.mesh is asset.mesh and scene.environment is asset.environment
    assert scene.surfels.centers is asset.gaussians.centers and scene.surfels.materials.albedo is asset.gaussians.albedo
    assert torch.equal(scene.surfels.tangents, surfel_tangents(asset.gaussians))
    assert torch.equal(scene.surfels.opacities, torch.sigmoid(asset.gaussians.opacity_logits))
    assert (scene.environment_rotation_degrees, scene.environment_intensity) == (0.0, 1.0)


def test_an_asset_without_gaussians_is_posed_as_a_mesh():
    scene = pose(replace(plate_asset(), gaussians=None, binding=None), TWIST, material({"all": True}, roughness=0.1))
    assert scene.surfels is None and (scene.mesh.roughness == 0.1).all()


def test_setting_a_material_everywhere_changes_that_number_and_no_tensor_else():
    asset = plate_asset()
    before, after = pose(asset), pose(asset, material({"all": True}, roughness=0.1))
    assert (after.mesh.roughness == 0.1).all() and (after.surfels.materials.roughness == 0.1).all()
    for name in ("vertices", "faces", "normals", "albedo", "metallic"):
        assert getattr(after.mesh, name) is getattr(asset.mesh, name), name
    for name in ("centers", "tangents", "opacities"):
        assert getattr(after.surfels, name) is getattr(before.surfels, name), name
    assert after.surfels.materials.albedo is asset.gaussians.albedo and after.environment is asset.environment


def detailed_plate() -> Asset:
    plate = plate_asset()
    codes = torch.randint(256, (len(plate.mesh.faces), 6, 3), generator=torch.Generator().manual_seed(2), dtype=torch.uint8)
    return replace(plate, mesh=replace(plate.mesh, detail=AlbedoDetail(codes)))


def test_what_is_painted_over_loses_its_pattern_and_the_rest_keeps_it():
    asset = detailed_plate()
    ball = {"sphere": {"center": [0.4, 0, 0.2], "radius": 0.3, "falloff": 0.2}}
    weights = select_vertices(asset.mesh, parse_edits([material(ball, albedo=[0.9, 0.1, 0.1])])[0].select)
    assert bool(((weights > 0) & (weights < 1)).any())
    painted = pose(asset, material(ball, albedo=[0.9, 0.1, 0.1])).mesh.detail
    assert painted is not None and painted.codes is asset.mesh.detail.codes
    torch.testing.assert_close(painted.share, 1 - weights)
    twice = pose(asset, material(ball, albedo=[0.9, 0.1, 0.1]), material(ball, albedo=[0.2, 0.2, 0.2])).mesh.detail
    torch.testing.assert_close(twice.share, (1 - weights) ** 2)
    for kept in (material(ball, roughness=0.1), material(ball, mode="multiply", albedo=[0.5, 0.5, 2.0]), twist(0.3)):
        assert pose(asset, kept).mesh.detail.share is None
    bent = pose(asset, twist(0.3), material({"all": True}, albedo=[0.5, 0.5, 0.5])).mesh.detail
    assert not bool(bent.share.any())


def test_a_deformed_scene_keeps_its_geometry_tensors_while_its_material_and_light_change():
    asset = plate_asset()
    scenes = [pose(asset, TWIST, material({"all": True}, roughness=r), {"op": "environment", "rotation": 100 * r}) for r in (0.1, 0.2)]
    assert scenes[0].mesh.vertices is scenes[1].mesh.vertices and scenes[0].surfels.tangents is scenes[1].surfels.tangents
    assert scenes[0].mesh.roughness is not scenes[1].mesh.roughness
    turned = [
        pose(asset, {"op": "deform", "map": {"type": "twist", "rate": rate}}, material({"all": True}, roughness=0.1)) for rate in (0.1, 0.2)
    ]
    assert turned[0].mesh.roughness is turned[1].mesh.roughness and turned[0].mesh.vertices is not turned[1].mesh.vertices


def test_a_sphere_selects_sharply_inside_and_fades_over_its_falloff():
    asset = plate_asset()
    sphere = {"center": [0, 0, 0.2], "radius": 0.3, "falloff": 0.2}
    scene = pose(asset, material({"sphere": sphere}, albedo=[0.9, 0.6, 0.2]))
    distance = asset.mesh.vertices[:, :2].norm(dim=-1)
    inside, outside = distance <= 0.3, distance >= 0.5
    assert torch.equal(scene.mesh.albedo[inside], torch.tensor([0.9, 0.6, 0.2]).expand(int(inside.sum()), 3))
    assert torch.equal(scene.mesh.albedo[outside], asset.mesh.albedo[outside])
    between = scene.mesh.albedo[~inside & ~outside][:, 0]
    assert len(between) and ((between > 0.4) & (between < 0.9)).all()
    middle = pose(asset, material({"sphere": sphere | {"center": [0.4, 0, 0.2]}}, roughness=0.0)).mesh  # the origin lies half way out
    origin = int(distance.argmin())
    assert math.isclose(float(middle.roughness[origin]), 0.3, abs_tol=1e-6)
    surfel_distance = (asset.gaussians.centers - torch.tensor([0, 0, 0.2])).norm(dim=-1)
    assert torch.equal(scene.surfels.materials.albedo[:, 0] == 0.9, surfel_distance <= 0.3)


def test_a_box_selects_what_lies_inside_it():
    asset = plate_asset()
    scene = pose(asset, material({"box": {"minimum": [-0.1, -1, 0], "maximum": [1, 1, 1]}}, metallic=1.0))
    chosen = asset.mesh.vertices[:, 0] >= -0.1
    assert (scene.mesh.metallic[chosen] == 1).all() and torch.equal(scene.mesh.metallic[~chosen], asset.mesh.metallic[~chosen])


def test_multiplying_scales_and_stays_within_one():
    scene = pose(plate_asset(), material({"all": True}, "multiply", roughness=0.5, albedo=[2, 3, 0]))
    assert torch.allclose(scene.mesh.roughness, torch.tensor(0.3))
    assert torch.allclose(scene.surfels.materials.albedo[0], torch.tensor([0.8, 1.0, 0.0]))


def test_similar_floods_the_picked_material_and_stops_at_the_jump():
    asset = plate_asset()
    scene = pose(asset, material({"similar": {"point": [-0.7, 0, 0.2], "tolerance": 0.1}}, roughness=0.05))
    assert torch.equal(scene.mesh.roughness == 0.05, asset.mesh.metallic == 1)
    corners = asset.mesh.metallic[asset.mesh.faces.long()].sum(-1)
    assert torch.equal(scene.surfels.materials.roughness == 0.05, corners == 3)
    assert torch.allclose(scene.surfels.materials.roughness[corners == 0], torch.tensor(0.6))


def test_regions_are_patches_of_one_material_by_size_and_unknown_ones_are_refused():
    asset = plate_asset()
    larger = pose(asset, material({"region": 0}, roughness=0.0)).mesh.roughness == 0
    smaller = pose(asset, material({"region": 1}, roughness=0.0)).mesh.roughness == 0
    assert torch.equal(larger, asset.mesh.metallic == 0) and torch.equal(smaller, asset.mesh.metallic == 1)
    with pytest.raises(ValueError, match="region 2 does not exist; the object has regions 0 to 1"):
        pose(asset, material({"region": 2}, roughness=0.0))


@pytest.mark.parametrize("bound", [True, False])
def test_painted_weights_reach_the_surfels_of_the_painted_faces(bound):
    asset = plate_asset() if bound else replace(plate_asset(), binding=None)
    weights = (asset.mesh.vertices[:, 1] > 0.3).float()
    scene = pose(asset, material({"vertex_weights": weights.tolist()}, roughness=0.0))
    assert torch.allclose(scene.mesh.roughness, 0.6 * (1 - weights))
    painted = weights[asset.mesh.faces.long()].sum(-1)
    assert (scene.surfels.materials.roughness[painted == 3] == 0).all()
    assert torch.allclose(scene.surfels.materials.roughness[painted == 0], torch.tensor(0.6))
    with pytest.raises(ValueError, match="2 entries, the mesh has 81"):
        pose(asset, material({"vertex_weights": [1, 0]}, roughness=0.0))


def test_selections_refer_to_the_object_at_rest():
    asset = plate_asset()
    edit = material({"sphere": {"center": [0.6, 0, 0.2], "radius": 0.3}}, roughness=0.0)
    lift = {"op": "deform", "map": {"type": "stretch", "factor": 10.0}}
    assert torch.equal(pose(asset, edit).mesh.roughness, pose(asset, lift, edit).mesh.roughness)


def test_material_edits_apply_in_their_order():
    scene = pose(plate_asset(), material({"all": True}, roughness=0.5), material({"all": True}, "multiply", roughness=0.5))
    assert (scene.mesh.roughness == 0.25).all()


def test_one_material_edit_more_costs_one_edit_and_changes_no_bit(monkeypatch):
    asset, applied = plate_asset(), []
    monkeypatch.setattr(
        "drgs.deform.pose_scene.select_vertices", lambda mesh, select: applied.append(select) or select_vertices(mesh, select)
    )
    sphere = {"sphere": {"center": [0.1, 0, 0.2], "radius": 0.3, "falloff": 0.4}}
    edits = [material(sphere, mode="multiply", albedo=[0.9, 0.5 + k / 20, 0.7], roughness=0.3 + k / 20) for k in range(8)]
    for count in range(1, 9):
        scene = pose(asset, *edits[:count])
        assert len(applied) == count
    fresh = pose(plate_asset(), *edits)
    assert torch.equal(scene.mesh.albedo, fresh.mesh.albedo) and torch.equal(scene.mesh.roughness, fresh.mesh.roughness)
    assert scene.surfels is not None and fresh.surfels is not None
    assert torch.equal(scene.surfels.materials.albedo, fresh.surfels.materials.albedo)
    applied.clear()
    pose(asset, *edits[:7])  # undone
    pose(asset, *edits[:7], material({"all": True}, metallic=1.0))  # another one instead
    assert len(applied) == 1
    changed = pose(asset, edits[1], edits[0])  # not a beginning of what was remembered
    assert torch.equal(changed.mesh.albedo, pose(plate_asset(), edits[1], edits[0]).mesh.albedo)


def test_a_map_moves_vertices_normals_centres_and_tangents():
    asset = plate_asset()
    scene = pose(asset, TWIST)
    twist = TwistMap(type="twist", rate=0.6)
    vertices, gradient = evaluate_map(twist, asset.mesh.vertices)
    assert torch.equal(scene.mesh.vertices, vertices)
    cofactor_normal = torch.linalg.inv(gradient).mT[:, :, 2]  # J = 1
    assert torch.allclose(scene.mesh.normals, torch.nn.functional.normalize(cofactor_normal, dim=-1), atol=1e-6)
    centers, gradient = evaluate_map(twist, asset.gaussians.centers)
    assert torch.equal(scene.surfels.centers, centers)
    assert torch.allclose(scene.surfels.tangents, gradient @ surfel_tangents(asset.gaussians), atol=1e-7)
    assert scene.mesh.albedo is asset.mesh.albedo and scene.mesh.faces is asset.mesh.faces


def test_maps_compose_in_their_order():
    asset = plate_asset()
    bend, stretch = {"op": "deform", "map": {"type": "bend", "curvature": 0.4}}, {"op": "deform", "map": {"type": "stretch", "factor": 1.5}}
    both, reverse = pose(asset, bend, stretch), pose(asset, stretch, bend)
    alone = pose(asset, bend)
    scale = torch.tensor([1.5**-0.5, 1.5**-0.5, 1.5])
    assert torch.allclose(both.mesh.vertices, alone.mesh.vertices * scale, atol=1e-6)
    assert torch.allclose(both.surfels.tangents, alone.surfels.tangents * scale[:, None], atol=1e-6)
    assert not torch.allclose(both.mesh.vertices, reverse.mesh.vertices, atol=1e-3)


def test_moved_vertices_of_a_file_carry_surfels_and_normals_rigidly(tmp_path):
    asset = plate_asset()
    turn, shift = rotation_from_quat_wxyz(torch.tensor([0.3, -0.5, 0.2, 0.8])), torch.tensor([1.0, 2.0, 3.0])
    np.savez(tmp_path / "pose.npz", vertices=(asset.mesh.vertices @ turn.T + shift).numpy())
    scene = pose(asset, {"op": "deform", "vertices": "pose.npz"}, base_directory=tmp_path)
    assert torch.allclose(scene.mesh.normals, asset.mesh.normals @ turn.T, atol=1e-5)
    assert torch.allclose(scene.surfels.centers, asset.gaussians.centers @ turn.T + shift, atol=1e-5)
    assert torch.allclose(scene.surfels.tangents, turn @ surfel_tangents(asset.gaussians), atol=1e-6)
    np.savez(tmp_path / "pose.npz", vertices=(asset.mesh.vertices + 1).numpy().astype(np.float64))
    again = pose(asset, {"op": "deform", "vertices": "pose.npz"}, base_directory=tmp_path)
    assert torch.allclose(again.mesh.vertices, asset.mesh.vertices + 1)  # the changed file is read again


def test_a_wrong_vertex_file_is_refused_with_a_sentence(tmp_path):
    asset = plate_asset()
    bad = asset.mesh.vertices.numpy().copy()
    bad[3, 1] = np.nan
    np.savez(tmp_path / "nan.npz", vertices=bad)
    np.savez(tmp_path / "few.npz", vertices=bad[:5])
    np.savez(tmp_path / "name.npz", points=bad)
    np.savez(tmp_path / "pickle.npz", vertices=np.array([[{}] * 3] * len(bad), dtype=object))
    (tmp_path / "text.npz").write_text("hello")
    cases = {
        "nan.npz": "1 values that are not finite", "few.npz": r"shape \(5, 3\).*expected \(81, 3\)", "name.npz": "holds no array 'vertices'",
        "pickle.npz": r"type \|O; expected", "text.npz": "is no zip", "none.npz": "does not exist",
    }  # fmt: skip
    for name, sentence in cases.items():
        with pytest.raises(ValueError, match=sentence):
            pose(asset, {"op": "deform", "vertices": name}, base_directory=tmp_path)
    np.savez(tmp_path / "good.npz", vertices=asset.mesh.vertices.numpy())
    with pytest.raises(ValueError, match="not bound to its mesh"):
        pose(replace(asset, binding=None), {"op": "deform", "vertices": "good.npz"}, base_directory=tmp_path)


def test_files_outside_the_folder_are_refused_when_edits_come_from_strangers(tmp_path):
    (tmp_path / "inside").mkdir()
    (tmp_path / "sky.exr").write_bytes(encode_environment(np.ones((2, 4, 3), np.float32)))
    for name in ("../sky.exr", str(tmp_path / "sky.exr")):
        edit = {"op": "environment", "file": name}
        assert pose(plate_asset(), edit, base_directory=tmp_path / "inside").environment.radiance.shape == (2, 4, 3)
        with pytest.raises(ValueError, match="outside the folder"):
            pose(plate_asset(), edit, base_directory=tmp_path / "inside", confine=True)


def test_light_is_swapped_turned_and_scaled_and_the_last_edit_counts(tmp_path):
    sky = np.random.default_rng(0).random((4, 8, 3), np.float32)
    (tmp_path / "sky.exr").write_bytes(encode_environment(sky))
    asset = plate_asset()
    first, second = {"op": "environment", "file": "sky.exr", "rotation": 30.0}, {"op": "environment", "rotation": 45.0, "intensity": 2.0}
    scene, again = pose(asset, first, second, base_directory=tmp_path), pose(asset, first, base_directory=tmp_path)
    assert np.array_equal(scene.environment.radiance, sky)
    assert (scene.environment_rotation_degrees, scene.environment_intensity) == (45.0, 2.0)
    assert again.environment is scene.environment and scene.mesh is asset.mesh
    named = Environment(torch.ones(2, 4, 3))
    assert pose(asset, {"op": "environment", "file": "forest"}, environments={"forest": named}.__getitem__).environment is named


def test_edits_that_fold_the_object_or_need_what_is_not_there_are_refused():
    cases = [
        ({"op": "deform", "map": {"type": "bend", "curvature": 2.0}}, "folds the object through itself"),
        ({"op": "deform", "map": {"type": "stretch", "factor": 1e300}}, "to infinity"),
        ({"op": "pose", "clip": "walk", "time": 0.4}, "walk/clip.json: does not exist"),
        ({"op": "simulate", "scene": {"gravity": -1}, "time": 0.4}, "simulation scene: gravity"),
        ({"op": "simulate", "scene": {}, "time": 0.4}, "cannot fill a mesh that is flat"),
        ({"op": "environment", "file": "nowhere.exr"}, "does not exist"),
    ]
    for edit, sentence in cases:
        with pytest.raises(ValueError, match=sentence):
            pose(plate_asset(), edit)


def test_nothing_is_remembered_while_an_assets_tensors_are_being_optimised():
    asset = plate_asset()
    asset.gaussians.log_scales.requires_grad_()
    before = pose(asset).surfels.tangents
    with torch.no_grad():
        asset.gaussians.log_scales.add_(1)
    assert torch.allclose(pose(asset).surfels.tangents, before * math.e)
    assert before.requires_grad


def test_posing_leaves_the_asset_as_it_was():
    asset = plate_asset()
    copies = {name: values.clone() for name, values in asset.mesh.columns.items()}
    pose(asset, TWIST, material({"all": True}, albedo=[0, 0, 0]))
    assert all(torch.equal(getattr(asset.mesh, name), values) for name, values in copies.items())


@pytest.mark.slow
def test_one_edit_more_or_a_few_less_cost_one_edit_however_long_the_list(monkeypatch: pytest.MonkeyPatch) -> None:
    asset, applied = plate_asset(), []
    evaluate, select = pose_module.evaluate_map, pose_module.select_vertices
    monkeypatch.setattr(pose_module, "evaluate_map", lambda *given: applied.append("map") or evaluate(*given))
    monkeypatch.setattr(pose_module, "select_vertices", lambda *given: applied.append("material") or select(*given))
    plain = [(twist(1e-4 * k), material({"all": True}, roughness=k / 150)) for k in range(150)]
    edits = parse_edits([edit for pair in plain for edit in pair])
    whole = pose_scene(asset, edits)
    applied.clear()
    pose_scene(asset, [*edits, *parse_edits([twist(0.1), material({"all": True}, roughness=0.5)])])
    assert sorted(applied) == ["map", "map", "material"], "vertices and surfels are mapped"
    for less in (1, 40, 100):
        applied.clear()
        shorter = pose_scene(asset, edits[: len(edits) - 2 * less])
        assert applied.count("material") <= pose_module.CHECKPOINT and applied.count("map") <= 2 * pose_module.CHECKPOINT
    anew = pose_scene(plate_asset(), edits[: len(edits) - 2 * less])
    assert torch.equal(shorter.mesh.vertices, anew.mesh.vertices) and torch.equal(shorter.mesh.roughness, anew.mesh.roughness)
    assert torch.equal(pose_scene(asset, edits).mesh.vertices, whole.mesh.vertices)


def test_painted_weights_of_a_file_are_those_in_the_edit(tmp_path: Path) -> None:
    weights = np.random.default_rng(0).random(GRID * GRID, np.float32)
    weights.astype("<f4").tofile(tmp_path / "painted.f32")
    asset = plate_asset()
    inside = pose(asset, material({"vertex_weights": weights.astype(float).tolist()}, roughness=0.1))
    beside = pose(asset, material({"weights_file": "painted.f32"}, roughness=0.1), base_directory=tmp_path)
    assert torch.equal(inside.mesh.roughness, beside.mesh.roughness)
    weights[:] = 0
    weights[:5].tofile(tmp_path / "few.f32")
    np.full_like(weights, 2).tofile(tmp_path / "many.f32")
    for name, sentence in (
        ("few.f32", "has 20 bytes; expected 324"),
        ("many.f32", r"expected weights in 0\.\.1"),
        ("none.f32", "does not exist"),
    ):
        with pytest.raises(ValueError, match=sentence):
            pose(asset, material({"weights_file": name}, roughness=0.1), base_directory=tmp_path)
    weights.tofile(tmp_path / "painted.f32")
    painted_over = pose(asset, material({"weights_file": "painted.f32"}, roughness=0.1), base_directory=tmp_path)
    assert torch.equal(painted_over.mesh.roughness, asset.mesh.roughness), "a file that was changed is read again"
