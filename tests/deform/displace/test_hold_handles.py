"""Handles as an edit: picked points and vertices, pins, targets; in the order of the edits, and prepared once for a whole drag."""

from dataclasses import replace

import pytest
import torch
import trimesh

from drgs.deform.displace import hold_handles as holding
from drgs.deform.pose_scene import pose_scene
from drgs.maths.frames import rotation_from_quat_wxyz
from drgs.scene.asset import Asset
from drgs.scene.edits import parse_edits
from drgs.scene.environment import Environment
from drgs.scene.gaussians import Gaussians, surfel_tangents
from drgs.scene.mesh import TriangleMesh


def bar_asset() -> Asset:
    """A bar along z from -2 to 2, a surfel on every fourth face."""
    bar = trimesh.creation.cylinder(radius=0.5, height=4.0, sections=16).subdivide().subdivide()
    vertices, faces = torch.tensor(bar.vertices, dtype=torch.float32), torch.tensor(bar.faces, dtype=torch.int32)
    normals = torch.tensor(bar.vertex_normals.copy(), dtype=torch.float32)
    grey = torch.full((len(vertices),), 0.5)
    mesh = TriangleMesh(vertices, faces, normals, torch.full_like(vertices, 0.5), grey, grey)
    centers = vertices[faces[::4].long()].mean(1)
    count = len(centers)
    gaussians = Gaussians(
        centers, torch.full((count, 2), -3.0), torch.randn(count, 4), torch.zeros(count), torch.zeros(count, 16, 3),
        torch.full((count, 3), 0.5), torch.full((count,), 0.5), torch.zeros(count),
    )  # fmt: skip
    return Asset(gaussians, mesh, None, Environment(torch.ones(4, 8, 3)))


def pose(asset, *edits):
    return pose_scene(asset, parse_edits(list(edits)))


TOP, BOTTOM = {"point": [0, 0, 2], "radius": 0.6}, {"point": [0, 0, -2], "radius": 0.6}


def handles(*drag, pin=()):
    return {"op": "deform", "handles": {"drag": list(drag), "pin": list(pin)}}


def test_a_picked_point_goes_to_its_target_a_pinned_one_stays_and_undo_returns_the_rest_pose():
    asset = bar_asset()
    scene = pose(asset, handles(TOP | {"target": [1.0, 0, 1.8]}, pin=[BOTTOM]))
    rest = asset.mesh.vertices
    top, bottom = (rest - torch.tensor([0, 0, 2.0])).norm(dim=-1) <= 0.6, (rest - torch.tensor([0, 0, -2.0])).norm(dim=-1) <= 0.6
    assert torch.allclose(scene.mesh.vertices[top], rest[top] + torch.tensor([1.0, 0, -0.2]), atol=5e-3)
    assert torch.allclose(scene.mesh.vertices[bottom], rest[bottom], atol=5e-3)
    middle = rest[:, 2].abs() < 0.2
    assert 0.2 < float(scene.mesh.vertices[middle, 0].mean()) < 0.8
    # Surfels lie on the faces that they lay on, and normals keep pointing out.
    feet = scene.mesh.vertices[asset.mesh.faces[::4].long()].mean(1)
    assert float((scene.surfels.centers - feet).norm(dim=-1).max()) < 0.02
    assert float((scene.mesh.normals * pose(asset).mesh.normals).sum(-1).min()) > 0.5
    undone = pose(asset)
    assert undone.mesh is asset.mesh and undone.surfels.centers is asset.gaussians.centers


def test_a_handle_may_turn_and_vertices_may_be_named():
    asset = bar_asset()
    rest = asset.mesh.vertices
    top, bottom = (torch.nonzero(side).flatten().tolist() for side in (rest[:, 2] > 1.9, rest[:, 2] < -1.9))
    middle = rest[top].mean(0)
    scene = pose(asset, handles({"vertices": top, "target": middle.tolist(), "turn": [0, 0, 90]}, pin=[{"vertices": bottom}]))
    quarter = rotation_from_quat_wxyz(torch.tensor([1.0, 0, 0, 1.0]))
    assert torch.allclose(scene.mesh.vertices[top], (rest[top] - middle) @ quarter.T + middle, atol=5e-3)
    waist = rest[:, 2].abs() < 0.3
    turned = torch.atan2(scene.mesh.vertices[waist, 1], scene.mesh.vertices[waist, 0]) - torch.atan2(rest[waist, 1], rest[waist, 0])
    assert float(torch.remainder(turned + 3.2, 2 * torch.pi).median()) - 3.2 == pytest.approx(torch.pi / 4, abs=0.25)


def test_handles_that_move_as_one_carry_surfels_rigidly():
    asset = bar_asset()
    shift = torch.tensor([0.3, -1.0, 2.0])
    scene = pose(asset, handles(TOP | {"target": [0.3, -1.0, 4.0]}, BOTTOM | {"target": [0.3, -1.0, 0.0]}))
    assert torch.allclose(scene.mesh.vertices, asset.mesh.vertices + shift, atol=2e-5)
    assert torch.allclose(scene.surfels.centers, asset.gaussians.centers + shift, atol=2e-5)
    assert torch.allclose(scene.surfels.tangents, surfel_tangents(asset.gaussians), atol=2e-5)


def test_handles_pull_what_earlier_edits_left_and_pick_on_the_object_at_rest():
    asset = bar_asset()
    stretch = {"op": "deform", "map": {"type": "stretch", "factor": 2.0}}
    scene = pose(asset, stretch, handles(TOP | {"target": [0, 1.0, 4.0]}, BOTTOM | {"target": [0, 1.0, -4.0]}))
    alone = pose(asset, stretch)
    assert torch.allclose(scene.mesh.vertices, alone.mesh.vertices + torch.tensor([0, 1.0, 0]), atol=5e-5)


def test_a_drag_prepares_the_object_once_and_leaves_no_trace(monkeypatch):
    asset, made = bar_asset(), []
    original = holding.HeldObject
    monkeypatch.setattr(holding, "HeldObject", lambda *given: made.append(1) or original(*given))
    for x in (0.2, 0.4, 0.6):
        last = pose(asset, handles(TOP | {"target": [x, 0, 2.0]}, pin=[BOTTOM]))
    assert len(made) == 1
    fresh = pose(replace(asset), handles(TOP | {"target": [0.6, 0, 2.0]}, pin=[BOTTOM]))
    assert (
        len(made) == 2
        and torch.equal(last.mesh.vertices, fresh.mesh.vertices)
        and torch.equal(last.surfels.tangents, fresh.surfels.tangents)
    )
    pose(asset, handles(TOP | {"target": [0.6, 0, 2.0]}))
    assert len(made) == 3  # without its pin it is held otherwise


def test_pins_alone_leave_the_very_same_object():
    asset = bar_asset()
    scene = pose(asset, handles(pin=[TOP, BOTTOM]))
    assert scene.mesh.vertices is asset.mesh.vertices and scene.surfels.centers is asset.gaussians.centers


@pytest.mark.parametrize(
    ("drag", "sentence"),
    [
        ([{"vertices": [10**6], "target": [0, 0, 0]}], "names vertex 1000000; the mesh has"),
        ([TOP | {"vertices": [1], "target": [0, 0, 0]}], "either vertices or point"),
        ([TOP], "target"),
        ([], "drag or pin at least one part"),
        ([TOP | {"target": [0, 0, float("nan")]}], "finite"),
        ([TOP | {"target": [1e300, 0, 0]}, BOTTOM | {"target": [0, 0, 0]}], "target.0: Input should be less than or equal to 1000000000"),
    ],
)
def test_wrong_handles_are_refused_with_a_sentence(drag, sentence):
    with pytest.raises(ValueError, match=sentence):
        pose(bar_asset(), handles(*drag))
