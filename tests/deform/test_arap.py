"""Handles: what is held goes where it is told, and the rest follows rigidly."""

import pytest
import torch
import trimesh

from drgs.deform.arap import ArapHandles, ArapSettings
from drgs.maths.frames import rotation_from_quat_wxyz


def bar():
    """A bar along z, 4 long, finely divided; its lower and upper ends."""
    mesh = trimesh.creation.cylinder(radius=0.5, height=4.0, sections=24)
    for _ in range(2):
        mesh = mesh.subdivide()
    vertices, faces = torch.tensor(mesh.vertices, dtype=torch.float32), torch.tensor(mesh.faces, dtype=torch.int32)
    ends = [torch.nonzero(side).flatten() for side in (vertices[:, 2] < -1.9, vertices[:, 2] > 1.9)]
    return vertices, faces, ends


@pytest.mark.parametrize("control_faces", [20_000, 600])
def test_handles_that_move_rigidly_move_everything_so(control_faces):
    vertices, faces, ends = bar()
    handles = torch.cat(ends)
    grip = ArapHandles(vertices, faces, handles, vertices, ArapSettings(control_faces, iterations=30))
    turn, shift = rotation_from_quat_wxyz(torch.tensor([0.9, 0.1, -0.2, 0.1])), torch.tensor([1.0, 2.0, -0.5])
    for _ in range(4):
        position, gradient = grip.drag(vertices[handles] @ turn.T + shift)
    assert float((position - (vertices @ turn.T + shift)).norm(dim=-1).max()) < 0.04
    assert float((gradient - turn).abs().max()) < 0.1


def test_a_dragged_end_goes_there_the_other_stays_and_the_bar_keeps_its_thickness():
    vertices, faces, ends = bar()
    handles = torch.cat(ends)
    targets = vertices[handles].clone()
    targets[len(ends[0]) :] += torch.tensor([1.5, 0.0, -0.3])
    grip = ArapHandles(vertices, faces, handles, vertices, ArapSettings(iterations=30))
    for _ in range(3):
        position, gradient = grip.drag(targets)
    assert torch.allclose(position[handles], targets, atol=1e-2)
    assert float(torch.linalg.det(gradient).median()) == pytest.approx(1, abs=0.1)
    middle = vertices[:, 2].abs() < 0.3
    assert float(position[middle, 0].mean()) == pytest.approx(0.75, abs=0.2)
    back, gradient = grip.drag(vertices[handles])
    for _ in range(5):
        back, gradient = grip.drag(vertices[handles])
    assert float((back - vertices).norm(dim=-1).max()) < 0.02


def test_parts_without_a_handle_stay_and_wrong_handles_are_refused():
    vertices, faces, ends = bar()
    both = torch.cat([vertices, vertices + torch.tensor([3.0, 0, 0])])
    twice = torch.cat([faces, faces + len(vertices)])
    grip = ArapHandles(both, twice, ends[1], both)
    position, _ = grip.drag(vertices[ends[1]] + 1.0)
    assert torch.allclose(position[len(vertices) :], both[len(vertices) :], atol=1e-5)
    with pytest.raises(ValueError, match="handles name vertices"):
        ArapHandles(vertices, faces, torch.tensor([10**6]), vertices)
    with pytest.raises(ValueError, match="finite"):
        grip.drag(torch.full((len(ends[1]), 3), torch.nan))
