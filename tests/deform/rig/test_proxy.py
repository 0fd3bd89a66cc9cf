import math
import os
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.nn.functional import normalize

from drgs.deform.pose_scene import pose_scene
from drgs.deform.rig.proxy import bind_to_proxy, carry_points
from drgs.deform.rig.rig_clip import align_rig
from drgs.deform.rig.skeleton import RigPose, pose_rig, rig_gradients
from drgs.exchange.glb import GlbMesh, encode_glb
from drgs.exchange.gltf_rig import read_gltf_rig
from drgs.maths.frames import rotation_from_quat_wxyz
from drgs.scene.asset import Asset
from drgs.scene.edits import RigBinding, parse_edits
from drgs.scene.environment import Environment
from drgs.scene.gaussians import Gaussians, surfel_tangents
from drgs.scene.mesh import TriangleMesh, vertex_normals
from tests.exchange.write_rig import tower, two_bones

METHODS = ["auto", "closest", "mls"]


def rig_pose(vertices, faces) -> RigPose:
    vertices = torch.as_tensor(vertices, dtype=torch.float64)
    return RigPose(vertices, torch.as_tensor(faces, dtype=torch.int32), torch.zeros(len(vertices), dtype=torch.int32))


def rotation(degrees: float, axis=(1.0, 2.0, 3.0)) -> torch.Tensor:
    axis = normalize(torch.tensor(axis, dtype=torch.float64), dim=0)
    half = math.radians(degrees) / 2
    return rotation_from_quat_wxyz(torch.cat([torch.tensor([math.cos(half)], dtype=torch.float64), math.sin(half) * axis]))


def column_asset(meters_per_unit: float = 1.0, surfels: int = 300) -> Asset:
    """A round column about z, of radius 0.28 and height 2, finer than the tower that drives it; surfels hover about its side."""
    around, levels = 24, 25
    angle = torch.arange(around) * (2 * math.pi / around)
    z = torch.linspace(0.02, 1.98, levels)
    vertices = torch.stack([0.28 * angle.cos().repeat(levels), 0.28 * angle.sin().repeat(levels), z.repeat_interleave(around)], -1)
    faces = torch.tensor([
        face for r in range(levels - 1) for k in range(around)
        for a, b in [(r * around + k, r * around + (k + 1) % around)]
        for face in ([a, b, b + around], [a, b + around, a + around])
    ]).int()  # fmt: skip
    count = len(vertices)
    mesh = TriangleMesh(
        vertices, faces, vertex_normals(vertices, faces), torch.full((count, 3), 0.5), torch.full((count,), 0.5), torch.zeros(count)
    )
    random = torch.Generator().manual_seed(1)
    turn, high = torch.rand(surfels, generator=random) * 2 * math.pi, torch.rand(surfels, generator=random) * 1.9 + 0.05
    radius = 0.28 + 0.01 * torch.randn(surfels, generator=random)
    centers = torch.stack([radius * turn.cos(), radius * turn.sin(), high], -1)
    gaussians = Gaussians(
        centers, torch.full((surfels, 2), -3.5), torch.randn(surfels, 4, generator=random), torch.zeros(surfels), torch.zeros(surfels, 16, 3),
        torch.full((surfels, 3), 0.5), torch.full((surfels,), 0.5), torch.zeros(surfels),
    )  # fmt: skip
    return Asset(gaussians, mesh, None, Environment(torch.ones(4, 8, 3)), meters_per_unit=meters_per_unit)


def pose(asset, folder, clip="rig.glb#Bend", time=0.5, **rig):
    edit = {"op": "pose", "clip": clip, "time": time} | ({"rig": rig} if rig else {})
    return pose_scene(asset, parse_edits([edit]), folder, confine=True)


@pytest.fixture
def rig_folder(tmp_path):
    two_bones().save(tmp_path / "rig.glb")
    return tmp_path


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_a_similarity_of_the_proxy_is_the_same_similarity_of_every_point(method):
    vertices, faces = tower(5, 2.0, 0.3)
    rest = rig_pose(vertices, faces)
    generator = torch.Generator().manual_seed(0)
    points = torch.randn(200, 3, generator=generator) * torch.tensor([0.4, 1.0, 0.4]) + torch.tensor([0, 1.0, 0])
    matrix, shift = 1.7 * rotation(100), torch.tensor([3.0, -1, 2], dtype=torch.float64)
    moved = replace(rest, vertices=rest.vertices @ matrix.T + shift)
    binding = bind_to_proxy(rest.vertices, rest.faces, points, normalize(points, dim=-1), method)
    positions = carry_points(binding, moved.vertices, rig_gradients(rest, moved))
    assert torch.allclose(positions, points.double() @ matrix.T + shift, atol=1e-12 if method == "closest" else 3e-6)


def test_points_on_the_proxy_go_where_its_triangles_go():
    vertices, faces = tower(5, 2.0, 0.3)
    rest = rig_pose(vertices, faces)
    moved = replace(rest, vertices=rest.vertices + 0.1 * torch.sin(7 * rest.vertices).flip(-1))
    corners = rest.vertices[rest.faces.long()]
    weights = torch.tensor([0.2, 0.3, 0.5], dtype=torch.float64)[:, None]
    points, goal = (corners * weights).sum(1), (moved.vertices[rest.faces.long()] * weights).sum(1)
    normals = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    binding = bind_to_proxy(rest.vertices, rest.faces, points.float(), normals.float())
    assert float(binding.offset.norm(dim=-1).max()) < 1e-6
    assert torch.allclose(carry_points(binding, moved.vertices, rig_gradients(rest, moved)), goal, atol=2e-6)


@pytest.mark.parametrize("inside_out", [False, True])
def test_of_two_nearby_legs_each_point_follows_its_own(inside_out):
    vertices, faces = tower(5, 2.0, 0.3)
    faces = faces[:, ::-1].copy() if inside_out else faces
    both = np.concatenate([vertices, np.add(vertices, [0.64, 0, 0])])  # 0.04 apart
    rest = rig_pose(both, np.concatenate([faces, faces + len(vertices)]))
    apart = rest.vertices.clone()
    apart[len(vertices) :, 0] += 1
    moved = replace(rest, vertices=apart)
    # The scanned left leg is thicker than its proxy: its inner side lies nearer to the other leg's. It has other sides too.
    y, z = torch.meshgrid(torch.linspace(0.2, 1.8, 9), torch.linspace(-0.25, 0.25, 5), indexing="ij")
    inner = torch.stack([torch.full_like(y, 0.325), y, z], -1).reshape(-1, 3)
    points = torch.cat([inner, inner * torch.tensor([-1.0, 1, 1]), inner[:, [2, 1, 0]]])
    normals = torch.tensor([[1.0, 0, 0], [-1, 0, 0], [0, 0, 1]]).repeat_interleave(len(inner), 0)
    binding = bind_to_proxy(rest.vertices, rest.faces, points, normals)
    assert torch.allclose(carry_points(binding, moved.vertices, rig_gradients(rest, moved)), points.double(), atol=1e-12)
    blind = bind_to_proxy(rest.vertices, rest.faces, points, torch.zeros_like(points))  # as good as facing nowhere
    torn = carry_points(blind, moved.vertices, rig_gradients(rest, moved)) - points
    assert torch.allclose(
        torn[: len(inner), 0], torch.ones(len(inner), dtype=torch.float64), atol=1e-6
    )  # without normals, the inner side would go along


def test_a_face_without_area_carries_nothing():
    vertices, faces = tower(3, 2.0, 0.3)
    rest = rig_pose(np.concatenate([vertices, [[0.31, 1, 0]]]), np.concatenate([faces, [[len(vertices)] * 3]]))
    matrix = rotation(40)
    moved = replace(rest, vertices=rest.vertices @ matrix.T)
    points = torch.tensor([[0.31, 1.0, 0]])
    binding = bind_to_proxy(rest.vertices, rest.faces, points, torch.tensor([[1.0, 0, 0]]))
    assert torch.allclose(carry_points(binding, moved.vertices, rig_gradients(rest, moved)), points.double() @ matrix.T, atol=1e-12)
    with pytest.raises(ValueError, match="no faces with area"):
        bind_to_proxy(rest.vertices, rest.faces[-1:], points, points)


@pytest.mark.parametrize("method", METHODS)
def test_a_rigidly_moved_rig_moves_the_object_rigidly(rig_folder, method):
    asset = column_asset()
    scene = pose(asset, rig_folder, "rig.glb#Turn", 0.6, method=method)
    # The file's y up is our z up: x, y, z -> x, -z, y.
    upright = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]], dtype=torch.float64)
    matrix = upright @ rotation(60) @ upright.T
    shift = upright @ torch.tensor([0.18, -0.12, 0.3], dtype=torch.float64)
    for moved, rest in ((scene.mesh.vertices, asset.mesh.vertices), (scene.surfels.centers, asset.gaussians.centers)):
        assert torch.allclose(moved.double(), rest.double() @ matrix.T + shift, atol=2e-6)
    # The weights of mls are summed in float32, which the gradient of the mesh sees divided by the length of an edge.
    near = 2e-6 if method == "closest" else 2e-5
    assert torch.allclose(scene.mesh.normals.double(), asset.mesh.normals.double() @ matrix.T, atol=near)
    tangents = surfel_tangents(asset.gaussians).double()
    assert torch.allclose(scene.surfels.tangents.double(), matrix @ tangents, atol=near * float(tangents.abs().max()))


def test_far_from_a_loose_proxy_moving_least_squares_do_not_tear():
    vertices, faces = tower(9, 2.0, 0.3)
    rest = rig_pose(vertices, faces)
    tilted = rest.vertices.clone()
    tilted[rest.vertices[:, 0] > 0] += torch.tensor([0, 0.2, 0], dtype=torch.float64)  # one side slides along the other
    moved = replace(rest, vertices=tilted)
    # Along the tower's axis, where the closest triangle is now one side's, now the other's.
    x = torch.linspace(-0.2, 0.2, 80)
    points = torch.stack([x, torch.ones_like(x), torch.zeros_like(x)], -1)
    step = {}
    for method in METHODS:
        binding = bind_to_proxy(rest.vertices, rest.faces, points, torch.zeros_like(points), method)
        rise = carry_points(binding, moved.vertices, rig_gradients(rest, moved))[:, 1]
        step[method] = float(rise.diff().abs().max())
    assert step["mls"] < 0.03 < 0.09 < step["closest"] and step["auto"] == step["mls"]


@pytest.mark.parametrize("method", METHODS)
def test_a_bent_rig_bends_the_object_about_its_joint(rig_folder, method):
    asset = column_asset()
    scene = pose(asset, rig_folder, time=1, method=method)
    top, bottom = asset.mesh.vertices[:, 2] > 1.85, asset.mesh.vertices[:, 2] < 0.15
    assert torch.allclose(scene.mesh.vertices[bottom], asset.mesh.vertices[bottom], atol=1e-4)
    rest = asset.mesh.vertices[top]
    # 90 degrees about the file's z, which is our -y, through (0, 0, 1).
    expected = torch.stack([-(rest[:, 2] - 1), rest[:, 1], 1 + rest[:, 0]], -1)
    assert torch.allclose(scene.mesh.vertices[top], expected, atol=1e-4)
    turned = torch.stack([-asset.mesh.normals[top][:, 2], asset.mesh.normals[top][:, 1], asset.mesh.normals[top][:, 0]], -1)
    assert torch.allclose(scene.mesh.normals[top], turned, atol=1e-3)
    around = scene.mesh.vertices[24:-24]
    assert float((around[1:] - around[:-1]).norm(dim=-1).max()) < 0.45  # nothing is torn


@pytest.mark.parametrize("method", METHODS)
def test_undo_returns_the_rest_pose_bit_for_bit(rig_folder, method):
    asset = column_asset()
    before = pose_scene(asset, [], rig_folder)
    moved = pose(asset, rig_folder, time=0.7, method=method)
    assert float((moved.mesh.vertices - before.mesh.vertices).abs().max()) > 0.1
    after = pose_scene(asset, [], rig_folder)
    assert after.mesh.vertices is before.mesh.vertices and after.mesh.normals is before.mesh.normals
    assert torch.equal(after.surfels.centers, before.surfels.centers) and torch.equal(after.surfels.tangents, before.surfels.tangents)


@pytest.mark.parametrize(("clip", "time"), [("Bend", 0), ("Still", 0.37)])
def test_a_rig_at_rest_leaves_the_very_tensors_of_the_asset(rig_folder, clip, time):
    asset = column_asset()
    scene = pose(asset, rig_folder, f"rig.glb#{clip}", time)
    assert scene.mesh.vertices is asset.mesh.vertices and scene.surfels.centers is asset.gaussians.centers


def test_scrubbing_shows_what_opening_there_shows(rig_folder):
    scrubbed = column_asset()
    for time in (0.9, 0.1, 0.5):
        scene = pose(scrubbed, rig_folder, time=time)
    assert torch.equal(scene.mesh.vertices, pose(column_asset(), rig_folder, time=0.5).mesh.vertices)


def test_after_its_end_an_animation_holds_or_starts_again(rig_folder):
    asset = column_asset()
    end, held = pose(asset, rig_folder, time=1), pose(asset, rig_folder, time=1.25)
    assert torch.equal(end.mesh.vertices, held.mesh.vertices)
    again, early = pose(asset, rig_folder, time=1.25, loop=True), pose(asset, rig_folder, time=0.25)
    assert torch.equal(again.mesh.vertices, early.mesh.vertices)


def test_rest_may_be_a_moment_of_the_animation(rig_folder):
    asset = column_asset()
    assert pose(asset, rig_folder, "rig.glb#Turn", 0.4, rest=0.4, fit=True).mesh.vertices is asset.mesh.vertices
    assert pose(asset, rig_folder, "rig.glb#Turn", 0.0, rest=0.4, fit=True).mesh.vertices is not asset.mesh.vertices


def test_fit_lays_a_rig_of_any_size_and_place_over_the_object(tmp_path):
    asset = column_asset()
    two_bones().save(tmp_path / "rig.glb")
    two_bones(height=180, radius=27, base=(400, -30, 55)).save(tmp_path / "far.glb")
    near, far = (pose(asset, tmp_path, f"{name}.glb#Bend", 1, fit=True) for name in ("rig", "far"))
    # Rounding may put a sample into the next patch.
    assert torch.allclose(near.mesh.vertices, far.mesh.vertices, atol=3e-3)
    top = int(asset.mesh.vertices[:, 2].argmax())
    assert float(far.mesh.vertices[top, 0]) < -0.8  # bent towards -x


def test_turn_scale_and_translation_place_the_rig(tmp_path):
    asset = column_asset()
    # About z by 90 degrees: what bent towards -x bends towards -y. The rig of half the size stands 5 above, and is brought back.
    two_bones(height=1, radius=0.15, base=(0, 2.5, 0)).save(tmp_path / "high.glb")
    scene = pose(asset, tmp_path, "high.glb#Bend", 1, turn=[0, 0, 90], scale=2, translation=[0, 0, -5])
    top = asset.mesh.vertices[:, 2] > 1.85
    rest = asset.mesh.vertices[top]
    expected = torch.stack([rest[:, 0], -(rest[:, 2] - 1), 1 + rest[:, 1]], -1)
    assert torch.allclose(scene.mesh.vertices[top], expected, atol=1e-4)


def test_an_exported_object_that_was_rigged_needs_no_alignment(tmp_path):
    asset = column_asset(meters_per_unit=0.05)
    mesh = GlbMesh({"POSITION": asset.mesh.vertices.numpy()}, asset.mesh.faces.numpy())
    (tmp_path / "exported.glb").write_bytes(encode_glb(mesh, asset.meters_per_unit))
    rest = pose_rig(read_gltf_rig(tmp_path / "exported.glb"))
    placed = align_rig(rest.vertices, asset.mesh.vertices, asset.meters_per_unit, RigBinding()).place(rest)
    assert torch.allclose(placed.vertices.float(), asset.mesh.vertices, atol=1e-6)


def test_a_changed_rig_is_read_again(rig_folder):
    asset = column_asset()
    before = pose(asset, rig_folder, time=1)
    two_bones(height=2.2).save(rig_folder / "rig.glb")
    os.utime(rig_folder / "rig.glb", ns=(1, 1))
    assert not torch.equal(pose(asset, rig_folder, time=1).mesh.vertices, before.mesh.vertices)


def test_an_asset_without_gaussians_follows_a_rig(rig_folder):
    scene = pose(replace(column_asset(), gaussians=None), rig_folder)
    assert scene.surfels is None and float(scene.mesh.vertices[:, 0].min()) < -0.4


@pytest.mark.parametrize(
    ("clip", "rig", "sentence"),
    [
        ("rig.glb", {}, "3 animations.*'Bend'.*name one"),
        ("rig.glb#Run", {}, "no animation 'Run'"),
        ("far.glb#Bend", {}, "away from the object.*fit"),
        ("none.glb#Bend", {}, "does not exist"),
        ("../rig.glb#Bend", {}, "outside"),
        ("still.glb", {}, "no animations"),
        ("bad.gltf", {}, r"bad\.gltf: .*JSON"),
        ("folder", {"fit": True}, "gltf or .fbx file only"),
        ("rig.glb#Bend", {"scale": 0}, "greater than or equal to 0.000000000001"),
        ("rig.glb#Bend", {"method": "magic"}, "method"),
    ],
)
def test_edits_that_do_not_fit_are_refused_with_a_sentence(rig_folder, clip, rig, sentence):
    two_bones(base=(40, 0, 0)).save(rig_folder / "far.glb")
    still = two_bones()
    still.document["animations"] = []
    still.save(rig_folder / "still.glb")
    (rig_folder / "bad.gltf").write_text("{")
    with pytest.raises(ValueError, match=sentence):
        pose(column_asset(), rig_folder, clip, **rig)


def test_an_animation_may_be_called_by_its_number(rig_folder):
    asset = column_asset()
    assert torch.equal(pose(asset, rig_folder, "rig.glb#0").mesh.vertices, pose(asset, rig_folder, "rig.glb#Bend").mesh.vertices)
