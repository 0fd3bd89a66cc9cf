"""Binding surfels to a mesh and back."""

import math

import pytest
import torch

from drgs.reconstruct.geometry.bind_gaussians import bind_gaussians, nearest_surfels, points_from_binding
from drgs.scene.mesh import TriangleMesh, vertex_normals


def triangle_mesh(vertices: torch.Tensor, faces: torch.Tensor) -> TriangleMesh:
    count = vertices.shape[0]
    normals = vertex_normals(vertices, faces)
    return TriangleMesh(vertices, faces, normals, torch.full((count, 3), 0.5), torch.full((count,), 0.5), torch.zeros(count))


def bumpy_torus(sectors: int = 48, rings: int = 24) -> TriangleMesh:
    i, j = torch.meshgrid(torch.arange(sectors), torch.arange(rings), indexing="ij")
    a, b = i * 2 * math.pi / sectors, j * 2 * math.pi / rings
    tube = 0.25 + 0.03 * torch.sin(5 * a) * torch.cos(3 * b)
    vertices = torch.stack(
        [(0.6 + tube * torch.cos(b)) * torch.cos(a), (0.6 + tube * torch.cos(b)) * torch.sin(a), tube * torch.sin(b)], -1
    )

    def index(s: torch.Tensor, r: torch.Tensor) -> torch.Tensor:
        return (s % sectors) * rings + r % rings

    quads = [index(i, j), index(i + 1, j), index(i + 1, j + 1), index(i, j + 1)]
    faces = torch.cat(
        [torch.stack([quads[0], quads[1], quads[2]], -1).reshape(-1, 3), torch.stack([quads[0], quads[2], quads[3]], -1).reshape(-1, 3)]
    )
    return triangle_mesh(vertices.reshape(-1, 3).float(), faces.int())


def centers_above_faces(mesh: TriangleMesh, offset: float, seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    """A point above the middle part of every face, and the faces' unit normals."""
    generator = torch.Generator().manual_seed(seed)
    weights = 0.15 + torch.rand(mesh.faces.shape[0], 3, generator=generator)
    weights = weights / weights.sum(-1, keepdim=True)
    corners = mesh.vertices[mesh.faces.long()]
    normal = torch.nn.functional.normalize(torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), dim=-1)
    return (corners * weights[..., None]).sum(1) + offset * normal, normal


@pytest.mark.parametrize("offset", [0.002, -0.002, 0.0])
def test_binding_reproduces_centers_that_project_inside_a_face(offset):
    mesh = bumpy_torus()
    centers, _ = centers_above_faces(mesh, offset, seed=0)
    binding = bind_gaussians(centers, mesh)
    assert torch.equal(binding.face, torch.arange(mesh.faces.shape[0], dtype=torch.int32))
    torch.testing.assert_close(points_from_binding(binding, mesh.vertices, mesh.faces), centers, atol=2e-6, rtol=0)
    torch.testing.assert_close(binding.normal_offset, torch.full_like(binding.normal_offset, offset), atol=2e-6, rtol=0)


def test_barycentrics_are_convex_weights():
    mesh = bumpy_torus()
    centers = torch.randn(500, 3, generator=torch.Generator().manual_seed(1))
    binding = bind_gaussians(centers, mesh)
    assert (binding.barycentric >= 0).all()
    torch.testing.assert_close(binding.barycentric.sum(-1), torch.ones(500))
    assert binding.face.dtype == torch.int32 and (binding.face >= 0).all() and (binding.face < mesh.faces.shape[0]).all()


def test_bound_face_is_the_closest_of_all():
    mesh = bumpy_torus(16, 8)
    centers = torch.randn(60, 3, generator=torch.Generator().manual_seed(2)) * 0.7
    binding = bind_gaussians(centers, mesh)
    corners = mesh.vertices[mesh.faces.long()]
    foot = (corners[binding.face.long()] * binding.barycentric[..., None]).sum(1)
    # No point of a dense sampling of every face is closer than the foot.
    generator = torch.Generator().manual_seed(3)
    weights = torch.rand(400, 3, generator=generator)
    weights = weights / weights.sum(-1, keepdim=True)
    samples = torch.einsum("fcx,sc->fsx", corners, weights).reshape(-1, 3)
    nearest = torch.cdist(centers, samples).amin(1)
    assert ((centers - foot).norm(dim=-1) <= nearest + 1e-6).all()


def test_bound_points_follow_a_rigid_motion():
    mesh = bumpy_torus()
    centers, _ = centers_above_faces(mesh, 0.003, seed=4)
    binding = bind_gaussians(centers, mesh)
    rotation = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(5)))[0]
    rotation = rotation * torch.linalg.det(rotation)
    shift = torch.tensor([1.0, -2.0, 0.5])
    moved = points_from_binding(binding, mesh.vertices @ rotation.T + shift, mesh.faces)
    torch.testing.assert_close(moved, centers @ rotation.T + shift, atol=5e-6, rtol=0)


def test_center_beyond_an_edge_returns_within_its_distance_to_the_mesh():
    mesh = triangle_mesh(torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), torch.tensor([[0, 1, 2]], dtype=torch.int32))
    center = torch.tensor([[0.5, -0.3, 0.4]])
    binding = bind_gaussians(center, mesh)
    assert binding.normal_offset.item() == pytest.approx(0.4)
    torch.testing.assert_close(points_from_binding(binding, mesh.vertices, mesh.faces), torch.tensor([[0.5, 0.0, 0.4]]))


def test_offset_is_negative_inside():
    mesh = bumpy_torus()
    assert bind_gaussians(torch.tensor([[0.6, 0.0, 0.0]]), mesh).normal_offset.item() < -0.15


def test_binding_gradient_reaches_the_vertices():
    mesh = bumpy_torus(8, 6)
    centers, _ = centers_above_faces(mesh, 0.01, seed=6)
    binding = bind_gaussians(centers, mesh)
    vertices = mesh.vertices.double().requires_grad_()
    assert torch.autograd.gradcheck(lambda v: points_from_binding(binding, v, mesh.faces), (vertices,))


def test_far_away_centers_are_bound_too():
    mesh = bumpy_torus(8, 6)
    assert bind_gaussians(torch.tensor([[1e4, 0.0, 0.0]]), mesh).normal_offset.item() > 0


def test_bad_input_is_refused():
    mesh = bumpy_torus(8, 6)
    with pytest.raises(ValueError, match="1 of 2 centres are not finite"):
        bind_gaussians(torch.tensor([[0.0, 0, 0], [0, torch.nan, 0]]), mesh)
    with pytest.raises(ValueError, match="without faces"):
        bind_gaussians(torch.zeros(1, 3), triangle_mesh(mesh.vertices, torch.zeros(0, 3, dtype=torch.int32)))
    with pytest.raises(ValueError, match="no area"):
        bind_gaussians(torch.ones(1, 3), triangle_mesh(mesh.vertices, torch.zeros(2, 3, dtype=torch.int32)))


def test_no_centers_give_an_empty_binding():
    assert bind_gaussians(torch.zeros(0, 3), bumpy_torus(8, 6)).face.shape == (0,)


def test_nearest_surfels_agree_with_all_pairs():
    generator = torch.Generator().manual_seed(7)
    points, centers = torch.randn(40, 3, generator=generator), torch.randn(200, 3, generator=generator)
    indices, distances = nearest_surfels(points, centers, 4)
    expected = torch.cdist(points, centers).topk(4, largest=False)
    assert torch.equal(indices, expected.indices)
    torch.testing.assert_close(distances, expected.values, atol=1e-5, rtol=1e-5)
    assert nearest_surfels(points, centers, 1)[0].shape == (40, 1)
    with pytest.raises(ValueError, match="nearest of 2"):
        nearest_surfels(points, centers[:2], 3)
