import pytest
import torch

from drgs.deform.carry.carry_gaussians import (
    LARGEST_STRETCH,
    SMALLEST_STRETCH,
    carry_normals,
    carry_tangents,
    cofactor,
    decompose_tangents,
    guard_gradient,
)
from drgs.deform.carry.drive_mesh import drive_surfels, vertex_gradients
from drgs.maths.frames import rotation_from_quat_wxyz
from drgs.scene.binding import Binding


def random(*shape, dtype=torch.float64):
    return torch.randn(shape, dtype=dtype)


def random_gradients(count=200, dtype=torch.float64):
    return rotation_from_quat_wxyz(random(count, 4, dtype=dtype)) @ (torch.eye(3, dtype=dtype) + 0.15 * random(count, 3, 3, dtype=dtype))


def random_tangents(count=200, dtype=torch.float64):
    return rotation_from_quat_wxyz(random(count, 4, dtype=dtype))[:, :, :2] * torch.exp(0.5 * random(count, 1, 2, dtype=dtype))


def test_the_covariance_of_a_carried_surfel_is_f_b_bt_ft():
    gradient, tangents = random_gradients(dtype=torch.float32), random_tangents(dtype=torch.float32)
    moved = carry_tangents(tangents, gradient).double()
    expected = gradient.double() @ tangents.double() @ tangents.double().mT @ gradient.double().mT
    assert ((moved @ moved.mT - expected).norm(dim=(1, 2)) / expected.norm(dim=(1, 2))).max() < 2e-6


def test_the_cofactor_normal_stays_orthogonal_to_the_carried_tangents():
    gradient, tangents = random_gradients(), random_tangents()
    normal = torch.nn.functional.normalize(torch.linalg.cross(tangents[..., 0], tangents[..., 1]), dim=-1)
    moved, moved_normal = carry_tangents(tangents, gradient), carry_normals(normal, gradient)
    assert (moved * moved_normal[..., None]).sum(1).abs().max() < 1e-12
    assert (torch.linalg.cross(moved[..., 0], moved[..., 1]) * moved_normal).sum(-1).min() > 0
    shear = torch.tensor([[[1.0, 0, 1], [0, 1, 0], [0, 0, 1]]], dtype=torch.float64)
    up = torch.tensor([[0.0, 0, 1]], dtype=torch.float64)
    assert torch.allclose(carry_normals(up, shear), up)  # a polar rotation would be 26.6 degrees off
    assert torch.allclose(cofactor(gradient), torch.linalg.det(gradient)[:, None, None] * torch.linalg.inv(gradient).mT)


def test_proper_gradients_pass_the_guard_untouched():
    gradient = random_gradients()
    assert guard_gradient(gradient) is gradient


@pytest.mark.parametrize(
    "gradient", [torch.diag(torch.tensor([1.0, 1, -1])), torch.zeros(3, 3), torch.diag(torch.tensor([1e5, 1, 1])), torch.full((3, 3), torch.nan),
                 torch.diag(torch.tensor([-1.0, -1, -1])), torch.diag(torch.tensor([50.0, 50, 1e-7]))]
)  # fmt: skip
def test_folded_flat_and_broken_gradients_become_proper_ones_and_neighbours_stay(gradient):
    healthy = random_gradients(1, torch.float32)[0]
    guarded = guard_gradient(torch.stack([gradient, healthy]))
    stretches = torch.linalg.svdvals(guarded[0])
    assert torch.linalg.det(guarded[0].double()) > 0
    assert stretches.min() > 0.99 * SMALLEST_STRETCH and stretches.max() < 1.01 * LARGEST_STRETCH
    assert torch.equal(guarded[1], healthy)


def test_the_guard_changes_a_gradient_no_more_than_it_must():
    turn = rotation_from_quat_wxyz(random(1, 4))
    stretch = torch.diag(torch.tensor([2.0, 1.0, 1e-3], dtype=torch.float64))
    expected = turn @ torch.diag(torch.tensor([2.0, 1.0, SMALLEST_STRETCH], dtype=torch.float64))
    assert torch.allclose(guard_gradient(turn @ stretch), expected)


def test_decomposed_tangents_rebuild_the_covariance_and_the_side():
    tangents = (random_gradients(dtype=torch.float32) @ random_tangents(dtype=torch.float32)).contiguous()
    quats, log_scales = decompose_tangents(tangents)
    rotation = rotation_from_quat_wxyz(quats)
    rebuilt = rotation[:, :, :2] * torch.exp(log_scales)[:, None, :]
    covariance = tangents @ tangents.mT
    assert ((rebuilt @ rebuilt.mT - covariance).norm(dim=(1, 2)) / covariance.norm(dim=(1, 2))).max() < 5e-6
    assert (log_scales[:, 0] >= log_scales[:, 1]).all()
    normal = torch.nn.functional.normalize(torch.linalg.cross(tangents[..., 0], tangents[..., 1]), dim=-1)
    assert ((rotation[..., 2] * normal).sum(-1) > 1 - 1e-5).all()


def test_the_short_scale_of_a_sliver_keeps_its_digits():
    turn = rotation_from_quat_wxyz(random(100, 4, dtype=torch.float32))[:, :, :2]
    angle = torch.rand(100) * 6
    spin = torch.stack([torch.stack([angle.cos(), -angle.sin()], -1), torch.stack([angle.sin(), angle.cos()], -1)], -2)
    tangents = turn * torch.tensor([1.0, 1e-3]) @ spin
    assert (torch.exp(decompose_tangents(tangents)[1][:, 1]) / 1e-3 - 1).abs().max() < 1e-3


def bound_surfels(dtype=torch.float64):
    """An octahedron with surfels off its faces, whose feet are not all straight below them."""
    vertices = torch.tensor([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], dtype=dtype)
    faces = torch.tensor([[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]], dtype=torch.int32)
    barycentric = torch.rand(8, 3, dtype=dtype)
    barycentric = barycentric / barycentric.sum(-1, keepdim=True)
    centers = (vertices[faces.long()] * barycentric[..., None]).sum(1) + 0.1 * random(8, 3, dtype=dtype)
    binding = Binding(torch.arange(8, dtype=torch.int32), barycentric, random(8, dtype=dtype))
    return vertices, faces, binding, centers, random_tangents(8, dtype)


@pytest.mark.parametrize("scale", [1.0, 0.4, 3.0])
def test_a_similarity_of_the_mesh_moves_the_surfels_with_it_exactly(scale):
    vertices, faces, binding, centers, tangents = bound_surfels()
    turn, shift = rotation_from_quat_wxyz(random(4)), random(3)
    moved = scale * vertices @ turn.T + shift
    gradients = vertex_gradients(vertices, moved, faces)
    found_centers, found_tangents = drive_surfels(vertices, moved, faces, gradients, binding, centers, tangents)
    assert torch.allclose(found_centers, scale * centers @ turn.T + shift, atol=1e-13)
    assert torch.allclose(found_tangents, scale * turn @ tangents, atol=1e-13)


def test_the_pose_at_rest_gives_back_every_surfel():
    vertices, faces, binding, centers, tangents = bound_surfels()
    gradients = vertex_gradients(vertices, vertices, faces)
    found_centers, found_tangents = drive_surfels(vertices, vertices, faces, gradients, binding, centers, tangents)
    assert torch.allclose(found_centers, centers, atol=1e-14) and torch.allclose(found_tangents, tangents, atol=1e-14)


def test_a_sliver_without_area_does_not_disturb_its_neighbours():
    vertices, faces, *_ = bound_surfels()
    vertices = torch.cat([vertices, vertices[:1], vertices[:1]])  # a face of three equal points, touching vertex 0
    faces = torch.cat([faces, torch.tensor([[0, 6, 7]], dtype=torch.int32)])
    turn = rotation_from_quat_wxyz(random(4))
    gradients = vertex_gradients(vertices, vertices @ turn.T, faces)
    assert torch.allclose(gradients[:6], turn.expand(6, 3, 3), atol=1e-13)
    assert torch.allclose(gradients[6:], torch.eye(3, dtype=torch.float64).expand(2, 3, 3))
