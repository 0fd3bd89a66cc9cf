"""Handles: what is held goes where it is told, and the rest follows rigidly."""

import pytest
import torch
import trimesh

from drgs.deform.carry.drive_mesh import vertex_gradients
from drgs.deform.displace.arap import ArapHandles, ArapSettings
from drgs.maths.frames import rotation_from_quat_wxyz


def bar():
    """A bar along z, 4 long, finely divided; its lower and upper ends."""
    mesh = trimesh.creation.cylinder(radius=0.5, height=4.0, sections=24)
    for _ in range(2):
        mesh = mesh.subdivide()
    vertices, faces = torch.tensor(mesh.vertices, dtype=torch.float32), torch.tensor(mesh.faces, dtype=torch.int32)
    ends = [torch.nonzero(side).flatten() for side in (vertices[:, 2] < -1.9, vertices[:, 2] > 1.9)]
    return vertices, faces, ends


@pytest.mark.parametrize("coarse_faces", [20_000, 600])
def test_handles_that_move_rigidly_move_everything_so(coarse_faces):
    vertices, faces, ends = bar()
    handles = torch.cat(ends)
    grip = ArapHandles(vertices, faces, handles, vertices, ArapSettings(coarse_faces=coarse_faces))
    turn, shift = rotation_from_quat_wxyz(torch.tensor([0.3, 0.8, -0.2, 0.1])), torch.tensor([1.0, 2.0, -0.5])
    position, gradient = grip.drag(vertices[handles] @ turn.T + shift)
    assert float((position - (vertices @ turn.T + shift)).norm(dim=-1).max()) < 1e-4
    assert float((gradient - turn).abs().max()) < 3e-4


def test_one_handle_alone_carries_the_object_along_without_turning_it():
    vertices, faces, ends = bar()
    position, _ = ArapHandles(vertices, faces, ends[1][:1], vertices).drag(vertices[ends[1][:1]] + torch.tensor([0.5, 0.0, 2.0]))
    assert torch.allclose(position, vertices + torch.tensor([0.5, 0.0, 2.0]), atol=1e-4)


def bent(grip, vertices, ends, share=1.0):
    targets = vertices[torch.cat(ends)].clone()
    targets[len(ends[0]) :] += share * torch.tensor([1.5, 0.0, -0.3])
    return targets, grip.drag(targets)


def test_a_dragged_end_goes_there_the_other_stays_and_the_bar_keeps_its_thickness():
    vertices, faces, ends = bar()
    handles = torch.cat(ends)
    for coarse_faces in (20_000, 600):
        grip = ArapHandles(vertices, faces, handles, vertices, ArapSettings(coarse_faces=coarse_faces))
        targets, (position, gradient) = bent(grip, vertices, ends)
        assert torch.allclose(position[handles], targets, atol=1e-2)
        assert float(torch.linalg.det(gradient).median()) == pytest.approx(1, abs=0.1)
        middle = vertices[:, 2].abs() < 0.3
        assert float(position[middle, 0].mean()) == pytest.approx(0.75, abs=0.2)
        back, gradient = grip.drag(vertices[handles])
        assert torch.allclose(back, vertices, atol=1e-5) and torch.allclose(gradient, torch.eye(3).expand_as(gradient), atol=1e-4)


@pytest.mark.slow
def test_a_drag_depends_on_its_targets_and_not_on_those_before_it():
    vertices, faces, ends = bar()
    settings = ArapSettings(coarse_faces=600)
    grip = ArapHandles(vertices, faces, torch.cat(ends), vertices, settings)
    _, (first, _) = bent(grip, vertices, ends)
    for share in (-1.0, 0.5, 3.0):
        bent(grip, vertices, ends, share)
    _, (again, _) = bent(grip, vertices, ends)
    _, (fresh, _) = bent(ArapHandles(vertices, faces, torch.cat(ends), vertices, settings), vertices, ends)
    assert torch.equal(first, again) and torch.equal(first, fresh)
    _, (near, _) = bent(grip, vertices, ends, 1.001)
    assert float((near - first).norm(dim=-1).max()) < 5e-3  # a small step of the mouse is a small step of the object
    # Ten times the iterations end at nearly the same pose.
    patient = ArapHandles(vertices, faces, torch.cat(ends), vertices, ArapSettings(coarse_faces=600, coarse_iterations=120, iterations=40))
    _, (converged, _) = bent(patient, vertices, ends)
    assert float((converged - first).norm(dim=-1).max()) < 0.04  # of a length of 4


def test_parts_without_a_handle_stay_and_wrong_handles_are_refused():
    vertices, faces, ends = bar()
    both = torch.cat([vertices, vertices + torch.tensor([3.0, 0, 0])])
    twice = torch.cat([faces, faces + len(vertices)])
    grip = ArapHandles(both, twice, ends[1], both)
    position, _ = grip.drag(vertices[ends[1]] + 1.0)
    assert torch.allclose(position[len(vertices) :], both[len(vertices) :], atol=1e-5)
    assert torch.allclose(position[: len(vertices)], vertices + 1.0, atol=1e-4)
    with pytest.raises(ValueError, match="handles name vertices"):
        ArapHandles(vertices, faces, torch.tensor([10**6]), vertices)
    with pytest.raises(ValueError, match="finite"):
        grip.drag(torch.full((len(ends[1]), 3), torch.nan))


def test_the_gradients_of_a_pose_are_those_of_a_driven_mesh():
    vertices, faces, ends = bar()
    grip = ArapHandles(vertices, faces, ends[0], vertices[:1])
    level = grip._control
    pose = level.rest + 0.2 * torch.sin(2 * level.rest[:, [1, 2, 0]])
    assert torch.allclose(level.gradients(pose), vertex_gradients(level.rest, pose, level.corners), atol=1e-10)
