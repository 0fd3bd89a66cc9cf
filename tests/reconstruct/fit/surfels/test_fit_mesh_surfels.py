"""Fine-tuning on the faces of a mesh: surfels stay there, the picture gets better, and each ablation holds what it must."""

from dataclasses import replace

import pytest
import torch

from drgs.deform.carry.drive_mesh import drive_surfels, vertex_gradients
from drgs.maths.frames import rotation_from_quat_wxyz
from drgs.reconstruct.capture.load_views import load_views
from drgs.reconstruct.checkpoints import fit_tensors, restore_fit
from drgs.reconstruct.fit.light.environment_pyramid import ENVIRONMENT_PYRAMID
from drgs.reconstruct.fit.surfels.fit_mesh_surfels import (
    MeshFitSettings,
    fit_mesh_surfels,
    gaussians_from_mesh_fit,
    start_mesh_fit,
    surfels_on_faces,
)
from drgs.reconstruct.geometry.bind_gaussians import foot_and_normal, points_from_binding
from drgs.reconstruct.geometry.mesh_from_gaussians import chosen_surfels, reduced_mesh
from drgs.reconstruct.geometry.mesh_surfels import mesh_surfels
from drgs.scene.gaussians import surfel_tangents
from tests.reconstruct.geometry.test_mesh_surfels import ball, grey_mesh
from tests.reconstruct.surfel_spheres import surfel_sphere
from tests.reconstruct.tiny_capture import SPHERE_CENTER, SPHERE_RADIUS, write_nerf_synthetic

SETTINGS = MeshFitSettings(iterations=6)
RADIUS = 1.0


@pytest.fixture(scope="module")
def views(tmp_path_factory):
    return load_views(write_nerf_synthetic(tmp_path_factory.mktemp("capture")), max_side=72)


def sphere_mesh():
    unit = ball(3)
    return grey_mesh(unit.vertices * SPHERE_RADIUS + torch.tensor(SPHERE_CENTER, dtype=torch.float32), unit.faces)


def started(settings=SETTINGS):
    mesh = sphere_mesh()
    gaussians = surfel_sphere(900, radius=SPHERE_RADIUS * 1.02, center=tuple(SPHERE_CENTER.tolist()), overlap=1.2)
    gaussians = replace(gaussians, sh=torch.zeros_like(gaussians.sh))
    light = {f"environment_{rows}": torch.zeros(1, 3, rows, 2 * rows) for rows in ENVIRONMENT_PYRAMID}
    return start_mesh_fit(*mesh_surfels(gaussians, mesh), mesh, light, settings)


def fitted(views, settings=SETTINGS):
    reports = []
    return fit_mesh_surfels(views, started(settings), settings, RADIUS, reports.append), reports


@pytest.fixture(scope="module")
def fit(views):
    """One fit, never stopped, and its reports."""
    return fitted(views)


@pytest.mark.slow
def test_the_picture_gets_better_and_no_surfel_leaves_its_face(fit):
    state, reports = fit
    assert reports[-1].iteration == 6 and reports[-1].psnr > reports[0].psnr + 0.2
    gaussians, binding = gaussians_from_mesh_fit(state)
    mesh = state.mesh
    assert torch.equal(binding.face, started().face)
    assert torch.allclose(points_from_binding(binding, mesh.vertices, mesh.faces), gaussians.centers, atol=1e-6)
    foot, _ = foot_and_normal(binding.face, binding.barycentric, mesh.vertices, mesh.faces)
    assert float((gaussians.centers - foot).norm(dim=-1).max()) <= float(binding.normal_offset.abs().max()) + 1e-6
    assert float((gaussians.log_scales.exp() - state.longest_edge[:, None]).max()) < 1e-6
    assert not any(value.requires_grad for record in (gaussians, binding) for value in vars(record).values())
    assert not torch.equal(binding.normal_offset, gaussians_from_mesh_fit(started())[1].normal_offset)


@pytest.mark.parametrize(("name", "still"), [("learn_offset", "offsets"), ("learn_opacity", "opacity_logits")])
def test_an_ablation_keeps_its_group_as_it_was_and_moves_the_rest(views, name, still):
    settings = replace(SETTINGS, iterations=1, **{name: False})
    before = started(settings)
    state, _ = fitted(views, settings)
    assert torch.equal(state.fit.parameters[still], before.fit.parameters[still])
    if name == "learn_offset":
        assert (state.fit.parameters[still] == 0).all()
    for other in {"offsets", "opacity_logits", "barycentric_logits", "log_scales", "quats", "albedo_logits"} - {still}:
        assert not torch.equal(state.fit.parameters[other], before.fit.parameters[other]), other


@pytest.mark.slow
def test_a_fit_restored_half_way_ends_with_the_same_bits(views, fit):
    through, _ = fit
    half = fit_mesh_surfels(views, started(), SETTINGS, RADIUS, should_stop=iter([False] * 3 + [True]).__next__)
    assert half.fit.iteration == 3
    tensors = {name: value.detach().clone() for name, value in fit_tensors(half.fit).items()}
    resumed = started()
    restore_fit(tensors, resumed.fit)
    fit_mesh_surfels(views, resumed, SETTINGS, RADIUS)
    for name, value in through.fit.parameters.items():
        assert torch.equal(resumed.fit.parameters[name], value), name


def test_gradients_reach_barycentrics_and_offsets_as_the_geometry_says():
    state = started()
    centers = surfels_on_faces(state)["centers"]
    direction = torch.nn.functional.normalize(torch.tensor([0.3, -0.2, 0.9]), dim=0)
    (centers @ direction).sum().backward()
    _, normal = foot_and_normal(
        state.face, torch.softmax(state.fit.parameters["barycentric_logits"], -1), state.mesh.vertices, state.mesh.faces
    )
    assert torch.allclose(state.fit.parameters["offsets"].grad, state.unit * (normal @ direction), atol=1e-6)
    assert torch.allclose(
        state.fit.parameters["barycentric_logits"].grad.sum(-1), torch.zeros(()), atol=1e-6
    )  # softmax: weights keep their sum


def test_bound_surfels_follow_a_rigid_motion_of_the_mesh_exactly(fit):
    state, _ = fit
    gaussians, binding = gaussians_from_mesh_fit(state)
    turn, shift = rotation_from_quat_wxyz(torch.tensor([0.3, -0.5, 0.2, 0.8])), torch.tensor([1.0, 2.0, 3.0])
    mesh = state.mesh
    moved = mesh.vertices @ turn.T + shift
    gradients = vertex_gradients(mesh.vertices, moved, mesh.faces)
    centers, tangents = drive_surfels(mesh.vertices, moved, mesh.faces, gradients, binding, gaussians.centers, surfel_tangents(gaussians))
    assert torch.allclose(centers, gaussians.centers @ turn.T + shift, atol=2e-6)
    assert torch.allclose(tangents, turn @ surfel_tangents(gaussians), atol=1e-6)


def test_a_reduced_mesh_keeps_the_shape_with_the_faces_allowed():
    mesh = sphere_mesh()
    assert reduced_mesh(mesh, len(mesh.faces), RADIUS) is mesh
    coarse = reduced_mesh(mesh, 600, RADIUS)
    assert 300 < len(coarse.faces) <= 600
    distance = (coarse.vertices - torch.tensor(SPHERE_CENTER, dtype=torch.float32)).norm(dim=-1) / SPHERE_RADIUS
    assert float(distance.min()) > 0.97 and float(distance.max()) < 1.03
    outward = (coarse.normals * (coarse.vertices - torch.tensor(SPHERE_CENTER, dtype=torch.float32))).sum(-1)
    assert float(outward.min()) > 0
    gaussians, binding = mesh_surfels(surfel_sphere(900), coarse)
    kept = torch.arange(len(binding.face)) % 3 == 0
    assert len(chosen_surfels(gaussians, kept).sh) == len(chosen_surfels(binding, kept).face) == int(kept.sum())
