"""The corrected rule of mesh-driven surfels beside the one printed in the paper."""

import math

import pytest
import torch
import trimesh

from drgs.deform.carry.carry_gaussians import carry_tangents
from drgs.deform.carry.drive_mesh import drive_surfels, vertex_gradients
from drgs.maths.frames import rotation_from_quat_wxyz
from drgs.scene.binding import Binding


def ball():
    """Vertices, faces, a binding of one surfel 0.1 outside every face, centres, tangents."""
    mesh = trimesh.creation.icosphere(subdivisions=2)
    vertices, faces = torch.tensor(mesh.vertices, dtype=torch.float32), torch.tensor(mesh.faces, dtype=torch.int32)
    normals = torch.tensor(mesh.face_normals, dtype=torch.float32)
    count = len(faces)
    binding = Binding(torch.arange(count, dtype=torch.int32), torch.full((count, 3), 1 / 3), torch.full((count,), 0.1))
    first = torch.nn.functional.normalize(torch.linalg.cross(normals, torch.tensor([0.3, 0.5, 0.8]).expand_as(normals)), dim=-1)
    tangents = torch.stack([0.1 * first, 0.05 * torch.linalg.cross(normals, first)], -1)
    return vertices, faces, binding, vertices[faces.long()].mean(1) + 0.1 * normals, tangents


def driven(moved, variant):
    vertices, faces, binding, centers, tangents = ball()
    gradients = vertex_gradients(vertices, moved, faces)
    return drive_surfels(vertices, moved, faces, gradients, binding, centers, tangents, variant)


@pytest.mark.parametrize("angle", [0.2, 1.0, 1.57, 3.14])
def test_the_printed_rule_does_not_turn_the_offset_from_the_mesh_and_ours_does(angle):
    turn = rotation_from_quat_wxyz(torch.tensor([math.cos(angle / 2), 0.0, 0.0, math.sin(angle / 2)]))
    vertices, _, _, centers, tangents = ball()
    position, moved_tangents = driven(vertices @ turn.T, "corrected")
    assert torch.allclose(position, centers @ turn.T, atol=2e-6) and torch.allclose(moved_tangents, turn @ tangents, atol=1e-6)
    printed, _ = driven(vertices @ turn.T, "paper")
    error = (printed - centers @ turn.T).norm(dim=-1)
    bound = 2 * 0.1 * math.sin(angle / 2)
    assert 0.9 * bound < float(error.max()) <= bound * 1.001


def test_similarities_are_reproduced_and_the_offset_grows_with_the_object():
    turn = rotation_from_quat_wxyz(torch.tensor([0.3, -0.5, 0.2, 0.8]))
    vertices, _, _, centers, tangents = ball()
    position, moved_tangents = driven(1.7 * vertices @ turn.T + 2.0, "corrected")
    assert torch.allclose(position, 1.7 * centers @ turn.T + 2.0, atol=5e-6)
    assert torch.allclose(moved_tangents, 1.7 * turn @ tangents, atol=2e-6)


def test_affine_maps_of_a_flat_mesh_are_exact_for_surfels_in_its_plane():
    steps = torch.linspace(-1, 1, 5)
    x, y = (values.reshape(-1) for values in torch.meshgrid(steps, steps, indexing="ij"))
    vertices = torch.stack([x, y, 0 * x], -1)
    corner = torch.tensor([5 * i + j for i in range(4) for j in range(4)])
    faces = torch.cat([torch.stack([corner, corner + 5, corner + 6], -1), torch.stack([corner, corner + 6, corner + 1], -1)]).int()
    weights = torch.nn.functional.normalize(torch.rand(len(faces), 3, generator=torch.Generator().manual_seed(0)), p=1, dim=-1)
    binding = Binding(torch.arange(len(faces), dtype=torch.int32), weights, torch.zeros(len(faces)))
    centers = (vertices[faces.long()] * weights[..., None]).sum(1)
    tangents = torch.zeros(len(faces), 3, 2)
    tangents[:, :2] = torch.tensor([[0.3, -0.1], [0.1, 0.2]])
    affine = torch.tensor([[1.2, 0.7, 0.1], [-0.3, 0.8, 0.4], [0.5, 0.2, 1.1]])
    moved = vertices @ affine.T
    gradients = vertex_gradients(vertices, moved, faces)
    position, moved_tangents = drive_surfels(vertices, moved, faces, gradients, binding, centers, tangents)
    assert torch.allclose(position, centers @ affine.T, atol=1e-6) and torch.allclose(moved_tangents, affine @ tangents, atol=1e-6)


def test_the_printed_rule_shrinks_surfels_where_rotations_differ():
    vertices = ball()[0]
    turn = 2.5 * vertices[:, 2]
    twisted = torch.stack(
        [
            vertices[:, 0] * turn.cos() - vertices[:, 1] * turn.sin(),
            vertices[:, 0] * turn.sin() + vertices[:, 1] * turn.cos(),
            vertices[:, 2],
        ],
        -1,
    )
    ours, printed = driven(twisted, "corrected")[1], driven(twisted, "paper")[1]
    assert torch.isfinite(printed).all() and not torch.allclose(ours, printed, atol=1e-2)


def test_the_identity_pose_gives_back_the_rest_in_both_variants():
    vertices, _, _, centers, tangents = ball()
    for variant in ("corrected", "paper"):
        position, moved = driven(vertices.clone(), variant)
        assert torch.allclose(position, centers, atol=1e-6) and torch.allclose(moved, tangents, atol=1e-6)


@pytest.mark.parametrize(
    ("gradient", "ascending", "degrees"),
    [
        (torch.diag(torch.tensor([1.5, 1.5, 1.5])), 0.0, 0.0),
        (torch.diag(torch.tensor([2.0, 1.0, 1.0])), 0.75, 0.0),
        (torch.tensor([[1.0, 0, 0.5], [0, 1, 0], [0, 0, 1]]), 0.35, 14.0),
        (torch.tensor([[1.0, 0, 1.0], [0, 1, 0], [0, 0, 1]]), 0.63, 26.6),
        (torch.tensor([[1.0, 0.5, 0], [0, 1, 0], [0, 0, 1]]), 0.43, 0.0),
    ],
)
def test_equation_7_errs_by_what_is_known_where_the_exact_rule_does_not(gradient, ascending, degrees):
    tangents = torch.tensor([[[1.0, 0.0], [0.0, 0.5], [0.0, 0.0]]])
    exact, paper = carry_tangents(tangents, gradient[None]), carry_tangents(tangents, gradient[None], variant="paper")
    covariance = gradient @ tangents @ tangents.mT @ gradient.T
    assert torch.allclose(exact @ exact.mT, covariance, atol=1e-6)
    assert float((paper @ paper.mT - covariance).norm() / covariance.norm()) == pytest.approx(ascending, abs=0.02)
    normals = [torch.nn.functional.normalize(torch.linalg.cross(b[..., 0], b[..., 1]), dim=-1) for b in (exact, paper)]
    assert math.degrees(math.acos(min(1.0, float((normals[0] * normals[1]).sum())))) == pytest.approx(degrees, abs=0.1)
