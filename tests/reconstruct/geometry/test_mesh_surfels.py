"""Surfels rebuilt on the faces of a mesh: what they take over, what faces without any get, and slivers."""

import math
from dataclasses import replace

import pytest
import torch
import trimesh

from drgs.maths.frames import rotation_from_quat_wxyz
from drgs.reconstruct.geometry.bind_gaussians import bind_gaussians, points_from_binding
from drgs.reconstruct.geometry.mesh_surfels import EMPTY_OPACITY, SLIVER, face_frames, gathered_opacity, larger_first, mesh_surfels
from drgs.scene.gaussians import surfel_tangents
from drgs.scene.mesh import TriangleMesh, vertex_normals
from tests.reconstruct.surfel_spheres import surfel_sphere


def grey_mesh(vertices: torch.Tensor, faces: torch.Tensor) -> TriangleMesh:
    grey = torch.full((len(vertices),), 0.5)
    return TriangleMesh(vertices, faces.int(), vertex_normals(vertices, faces), grey[:, None].repeat(1, 3), grey, 0 * grey)


def ball(subdivisions: int = 3) -> TriangleMesh:
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions)
    return grey_mesh(torch.tensor(mesh.vertices, dtype=torch.float32), torch.tensor(mesh.faces))


def one_triangle(*corners) -> TriangleMesh:
    return grey_mesh(torch.tensor(corners, dtype=torch.float32), torch.tensor([[0, 1, 2]]))


@pytest.mark.parametrize("variant", ["corrected", "paper"])
def test_every_face_gets_a_surfel_whose_binding_gives_its_centre_back(variant):
    mesh = ball()
    gaussians, binding = mesh_surfels(surfel_sphere(3000, radius=1.01), mesh, variant)
    assert binding.face.tolist() == list(range(len(mesh.faces)))
    assert torch.allclose(binding.barycentric.sum(-1), torch.ones(len(binding.face)), atol=1e-6) and float(binding.barycentric.min()) >= 0
    assert torch.equal(points_from_binding(binding, mesh.vertices, mesh.faces), gaussians.centers)
    normals = rotation_from_quat_wxyz(gaussians.quats_wxyz)[:, :, 2]
    assert float((normals * gaussians.centers).sum(-1).min()) > 0.9  # they face outward
    again = bind_gaussians(gaussians.centers, mesh)
    assert float((again.face == binding.face).float().mean()) > 0.99


def test_surfels_take_over_the_offset_of_their_candidates_and_the_paper_leaves_them_on_the_face():
    mesh = ball(2)
    fitted = surfel_sphere(3000, radius=1.03)
    ours, printed = mesh_surfels(fitted, mesh)[1], mesh_surfels(fitted, mesh, "paper")[1]
    flat = face_frames(mesh).center.norm(dim=-1)  # faces lie within the unit sphere
    assert torch.allclose(ours.normal_offset, 1.03 - flat, atol=0.02)
    assert (printed.normal_offset == 0).all()


def test_materials_colour_and_opacity_are_the_candidates_means_by_opacity():
    mesh = one_triangle([0, 0, 0], [1, 0, 0], [0, 1, 0])
    fitted = surfel_sphere(8, radius=50.0)  # far away, but enough neighbours
    near = torch.tensor([[0.2, 0.2, 0.1], [0.4, 0.2, 0.3]])
    centers = fitted.centers.clone()
    centers[:2] = near
    opacity = fitted.opacity_logits.clone()
    opacity[:2] = torch.logit(torch.tensor([0.9, 0.3]))
    roughness = fitted.roughness.clone()
    roughness[:2] = torch.tensor([0.2, 0.6])
    sh = fitted.sh.clone()
    sh[:2, 0, 0] = torch.tensor([1.0, 5.0])
    gaussians, binding = mesh_surfels(replace(fitted, centers=centers, opacity_logits=opacity, roughness=roughness, sh=sh), mesh)
    assert float(torch.sigmoid(gaussians.opacity_logits)) == pytest.approx(0.6, abs=1e-5)  # activated first, then averaged
    assert float(gaussians.roughness) == pytest.approx((0.9 * 0.2 + 0.3 * 0.6) / 1.2, abs=1e-5)
    assert float(gaussians.sh[0, 0, 0]) == pytest.approx((0.9 * 1 + 0.3 * 5) / 1.2, abs=1e-4)
    assert float(binding.normal_offset) == pytest.approx(0.2, abs=1e-6)
    assert torch.allclose(gaussians.centers[0], torch.tensor([0.3, 0.2, 0.2]), atol=1e-6)


def test_faces_without_candidates_are_as_opaque_as_what_covers_them():
    mesh = ball(4)  # 5120 faces under 600 surfels: most have no candidate
    fitted = surfel_sphere(600, opacity=0.9, overlap=1.2)
    has = torch.zeros(len(mesh.faces), dtype=torch.bool)
    has[bind_gaussians(fitted.centers, mesh).face.long()] = True
    ours, _ = mesh_surfels(fitted, mesh)
    printed, _ = mesh_surfels(fitted, mesh, "paper")
    assert float(has.float().mean()) < 0.15
    assert float(torch.sigmoid(ours.opacity_logits)[~has].min()) > 0.5
    assert torch.allclose(torch.sigmoid(printed.opacity_logits)[~has], torch.tensor(EMPTY_OPACITY))
    assert torch.isfinite(ours.albedo).all() and torch.allclose(ours.albedo, torch.tensor(0.5), atol=1e-3)


def test_far_from_every_surfel_a_face_keeps_the_least_opacity():
    mesh = ball(1)
    shifted = grey_mesh(mesh.vertices + torch.tensor([9.0, 0, 0]), mesh.faces)
    gaussians, binding = mesh_surfels(surfel_sphere(500), shifted)
    assert torch.allclose(torch.sigmoid(gaussians.opacity_logits), torch.tensor(EMPTY_OPACITY)) and (binding.normal_offset == 0).all()
    assert torch.isfinite(gaussians.albedo).all() and torch.isfinite(gaussians.sh).all()


def test_gathered_opacity_is_a_surfels_own_at_its_centre_and_none_far_off():
    surfel = surfel_sphere(64, radius=100.0, opacity=0.7)
    surfel = replace(surfel, log_scales=torch.zeros(64, 2))
    there = gathered_opacity(surfel.centers[:3], surfel)
    assert torch.allclose(there, torch.tensor(0.7), atol=1e-4)
    tangent = surfel_tangents(surfel)[:3, :, 0]
    assert torch.allclose(gathered_opacity(surfel.centers[:3] + tangent, surfel), torch.tensor(0.7 * math.exp(-0.5)), atol=1e-4)
    assert float(gathered_opacity(torch.zeros(1, 3), surfel)) < 1e-6


def test_scales_and_axes_follow_the_triangles_second_moment():
    equilateral = face_frames(one_triangle([0, 0, 0], [1, 0, 0], [0.5, math.sqrt(0.75), 0]))
    assert torch.allclose(equilateral.scales, torch.tensor(1 / math.sqrt(3)), atol=1e-6)  # the spacing of centres in such a mesh
    corners = torch.tensor([[0.0, 0, 0], [3, 0.2, 0], [1, 1, 0]])
    turn = rotation_from_quat_wxyz(torch.tensor([0.3, -0.5, 0.2, 0.8]))
    frame = face_frames(one_triangle(*(corners @ turn.T).tolist()))
    axes, scales = frame.rotation[0, :, :2], frame.scales[0]
    centred = (corners - corners.mean(0)) @ turn.T
    moment = centred.T @ centred / 12
    assert torch.allclose((axes * scales**2) @ axes.T, 8 * moment, atol=1e-5)
    assert torch.allclose(torch.linalg.det(frame.rotation), torch.tensor(1.0), atol=1e-6)
    assert torch.allclose(frame.rotation[0, :, 2], turn[:, 2], atol=1e-6)


def test_a_build_has_as_many_faces_as_a_device_can_take(device):
    corners = torch.rand(220_000, 3, 3, generator=torch.Generator().manual_seed(0))
    mesh = grey_mesh(corners.reshape(-1, 3), torch.arange(3 * len(corners)).reshape(-1, 3))
    frames = face_frames(TriangleMesh(**{name: value.to(device) for name, value in mesh.columns.items()}))
    axes, scales = frames.rotation[:, :, :2].double(), frames.scales.double()
    centred = (corners - corners.mean(1, keepdim=True)).to(device).double()
    ample = scales[:, 1] > 2 * SLIVER * scales[:, 0]
    made = (axes * scales[:, None] ** 2) @ axes.mT
    torch.testing.assert_close(made[ample], (8 / 12 * centred.mT @ centred)[ample], atol=1e-5, rtol=0)


def test_eigenvalues_in_closed_form_are_those_of_a_library():
    half = torch.randn(1000, 2, 2, generator=torch.Generator().manual_seed(0)).double() * 10 ** torch.linspace(-6, 3, 1000)[:, None, None]
    half[0], half[1], half[2, 1] = 0, torch.eye(2), 0
    moment = half @ half.mT
    values, first = larger_first(moment)
    torch.testing.assert_close(values.flip(-1), torch.linalg.eigvalsh(moment).clamp(min=0), rtol=1e-9, atol=1e-20)
    torch.testing.assert_close(first.norm(dim=-1), torch.ones(1000).double())
    torch.testing.assert_close((moment @ first[..., None])[..., 0], values[:, :1] * first, rtol=1e-9, atol=1e-20)


def test_normals_are_the_surfels_where_they_agree_with_the_face_and_the_faces_elsewhere():
    mesh = one_triangle([0, 0, 0], [1, 0, 0], [0, 1, 0])
    fitted = surfel_sphere(8)
    fitted = replace(fitted, centers=torch.tensor([0.3, 0.3, 0.01]) + 0.01 * fitted.centers, opacity_logits=torch.full((8,), 3.0))
    for angle, expected in ((0.4, 0.4), (1.3, 0.0)):  # turned about x, one half of them seen from behind
        turned = torch.tensor(
            [[math.cos(angle / 2), math.sin(angle / 2), 0, 0]] * 4 + [[-math.sin(angle / 2), math.cos(angle / 2), 0, 0]] * 4
        )
        gaussians, _ = mesh_surfels(replace(fitted, quats_wxyz=turned), mesh)
        frame = rotation_from_quat_wxyz(gaussians.quats_wxyz)[0]
        assert torch.allclose(frame[:, 2], torch.tensor([0, -math.sin(expected), math.cos(expected)]), atol=1e-5)
        assert torch.allclose(frame.T @ frame, torch.eye(3), atol=1e-5)
        printed = rotation_from_quat_wxyz(mesh_surfels(replace(fitted, quats_wxyz=turned), mesh, "paper")[0].quats_wxyz)[0]
        assert torch.allclose(printed[:, 2], torch.tensor([0.0, 0, 1]), atol=1e-6)


def test_slivers_get_bounded_scales_and_faces_without_area_get_nothing():
    vertices = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [2, 1e-4, 0], [4, 0, 0]])
    faces = torch.tensor([[0, 1, 2], [0, 4, 3], [0, 1, 4]])  # a good one, a sliver, one without area
    mesh = grey_mesh(vertices, faces)
    gaussians, binding = mesh_surfels(surfel_sphere(100), mesh)
    assert binding.face.tolist() == [0, 1]
    scales = gaussians.log_scales.exp()
    assert float(scales[1, 1] / scales[1, 0]) == pytest.approx(SLIVER, rel=1e-4) and float(scales.max()) <= 4.0
    for variant in ("corrected", "paper"):
        frames = face_frames(mesh, variant)
        assert all(torch.isfinite(value).all() for value in vars(frames).values())
    assert float(face_frames(mesh).unit[1]) < 4 < 1000 < float(face_frames(mesh, "paper").unit[1])  # the circumradius blows up


def test_what_cannot_be_rebuilt_is_refused_with_a_sentence():
    with pytest.raises(ValueError, match="no area"):
        mesh_surfels(surfel_sphere(20), one_triangle([0, 0, 0], [1, 0, 0], [2, 0, 0]))
    with pytest.raises(ValueError, match="expected 8 or more"):
        mesh_surfels(surfel_sphere(5), ball(1))
