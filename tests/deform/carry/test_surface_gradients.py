import torch

from drgs.deform.carry.drive_mesh import vertex_gradients
from drgs.deform.carry.surface_gradients import prepare_surface, surface_gradients


def crumpled_sheet(device):
    """A sheet of 12x12 with a face without area and a vertex that belongs to no face."""
    steps = torch.linspace(0, 1, 12)
    x, y = (v.reshape(-1) for v in torch.meshgrid(steps, steps, indexing="ij"))
    vertices = torch.stack([x, y, 0.1 * torch.sin(9 * x * y)], -1)
    cell = torch.tensor([[i * 12 + j, (i + 1) * 12 + j, (i + 1) * 12 + j + 1, i * 12 + j + 1] for i in range(11) for j in range(11)])
    faces = torch.cat([cell[:, [0, 1, 2]], cell[:, [0, 2, 3]], torch.tensor([[3, 3, 4]])]).int()
    return torch.cat([vertices, torch.ones(1, 3)]).to(device), faces.to(device)


def test_gradients_are_those_of_the_specification(device):
    vertices, faces = crumpled_sheet(device)
    moved = vertices.double() @ torch.tensor([[1.2, 0.3, 0], [0, 0.7, 0.2], [0.5, 0, 1]], dtype=torch.float64, device=device)
    moved = moved + 0.05 * torch.sin(20 * moved.flip(-1))
    expected = vertex_gradients(vertices.double(), moved, faces)
    found = surface_gradients(prepare_surface(vertices, faces), moved)
    assert torch.allclose(found, expected, atol=1e-12) and torch.equal(found[-1], torch.eye(3, dtype=torch.float64, device=device))


def test_what_was_prepared_serves_every_pose(device):
    vertices, faces = crumpled_sheet(device)
    rest = prepare_surface(vertices, faces)
    turn = torch.tensor([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]], dtype=torch.float64, device=device)
    surface_gradients(rest, vertices * 3)
    found = surface_gradients(rest, vertices.double() @ turn.T)
    assert torch.allclose(found[:-1], turn.expand(len(vertices) - 1, 3, 3), atol=1e-12)
