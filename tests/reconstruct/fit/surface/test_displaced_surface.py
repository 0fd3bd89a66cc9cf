"""The surface displaced by what pixels show: what rays see of displaced faces, in float64 and by differences; positions, normals, settling."""

from dataclasses import replace

import pytest
import torch

from drgs.reconstruct.fit.fit_loop import FitState
from drgs.reconstruct.fit.surface.displaced_surface import DisplacedSurface, weights_where_seen
from drgs.reconstruct.fit.surface.fit_mesh_materials import MeshMaterialSettings, start_mesh_materials
from drgs.reconstruct.fit.surface.fit_surface import SurfaceSettings, start_surface
from drgs.reconstruct.fit.surface.moving_surface import MovingSurface
from drgs.reconstruct.fit.surface.shade_surface import SeenPlaces, seen_places
from drgs.reconstruct.fit.view_targets import ViewTarget, view_targets
from drgs.reconstruct.geometry.integrate_normals import TURNED
from drgs.render.intersect.trace_rays import build_tracer, trace_rays
from drgs.scene.mesh import vertex_normals
from drgs.scene.views import Views
from tests.reconstruct.fit.painted_sphere import CENTER, grey_light, painted_views, placed_sphere
from tests.reconstruct.surfel_spheres import surfel_sphere
from tests.reconstruct.tiny_capture import SPHERE_RADIUS


@pytest.fixture(scope="module")
def views(tmp_path_factory: pytest.TempPathFactory) -> Views:
    return painted_views(tmp_path_factory.mktemp("capture"), 3)


@pytest.fixture(scope="module")
def target(views: Views) -> ViewTarget:
    return view_targets(views, 1.0, torch.device("cpu"))[0]


def seen_on(mesh, target: ViewTarget) -> SeenPlaces:
    solid = (target.mask.flatten() > 0.995).nonzero().squeeze(1)
    return seen_places(target, solid, build_tracer(mesh))


def in_doubles(seen: SeenPlaces) -> SeenPlaces:
    return replace(seen, wo=seen.wo.double(), weights=seen.weights.double())


def test_where_nothing_moved_weights_are_those_that_were_seen(target: ViewTarget):
    mesh = placed_sphere()
    seen = seen_on(mesh, target)
    assert torch.allclose(weights_where_seen(seen, mesh.vertices, mesh.vertices), seen.weights, atol=1e-4)


def test_a_moved_mesh_is_seen_where_its_own_rays_meet_it(target: ViewTarget):
    mesh, generator = placed_sphere(), torch.Generator().manual_seed(3)
    seen = seen_on(mesh, target)
    shift = 0.003 * SPHERE_RADIUS * torch.randn(mesh.vertices.shape, generator=generator)
    moved = replace(mesh, vertices=mesh.vertices + shift)
    hits = trace_rays(target.camera.center_world.expand_as(seen.wo).contiguous(), -seen.wo, build_tracer(moved))
    same = hits.hit & (hits.face.long() == seen.face)
    assert float(same.float().mean()) > 0.9
    found = weights_where_seen(seen, mesh.vertices, moved.vertices)
    facing = (seen.wo * vertex_normals(mesh.vertices, mesh.faces)[seen.corners[:, 0]]).sum(1) > 0.3
    both = same & facing
    assert torch.allclose(found[both][:, 1:], hits.barycentric[both], atol=2e-3)


def test_the_slope_of_weights_is_that_of_differences(target: ViewTarget):
    mesh, generator = placed_sphere(), torch.Generator().manual_seed(4)
    seen, before = in_doubles(seen_on(mesh, target)), mesh.vertices.double()
    positions = (before + 0.002 * SPHERE_RADIUS * torch.randn(before.shape, generator=generator)).requires_grad_()
    values = torch.randn(seen.weights.shape, generator=generator, dtype=torch.float64)
    (weights_where_seen(seen, before, positions) * values).sum().backward()
    assert positions.grad is not None
    along = torch.randn(before.shape, generator=generator, dtype=torch.float64)
    step = 1e-7 * SPHERE_RADIUS
    with torch.no_grad():
        ahead, behind = ((weights_where_seen(seen, before, positions + sign * step * along) * values).sum() for sign in (1, -1))
    assert float((ahead - behind) / (2 * step)) == pytest.approx(float((positions.grad * along).sum()), rel=1e-5)


def test_faces_that_are_seen_edge_on_keep_their_weights_and_have_no_slope(target: ViewTarget):
    mesh = placed_sphere()
    seen = seen_on(mesh, target)
    flat = replace(seen, wo=torch.nn.functional.normalize(mesh.vertices[seen.corners[:, 1]] - mesh.vertices[seen.corners[:, 0]], dim=-1))
    positions = (mesh.vertices * 1.001).requires_grad_()
    found = weights_where_seen(flat, mesh.vertices, positions)
    assert torch.equal(found, seen.weights)
    found.sum().backward()
    assert positions.grad is not None and not positions.grad.any()
    # no area at all
    collapsed = torch.zeros_like(mesh.vertices).requires_grad_()
    found = weights_where_seen(seen, mesh.vertices, collapsed)
    found.square().sum().backward()
    assert torch.equal(found, seen.weights) and collapsed.grad is not None and collapsed.grad.isfinite().all()


def started() -> FitState:
    surfels = surfel_sphere(600, radius=SPHERE_RADIUS, center=tuple(CENTER.tolist()))
    surface = start_surface(surfels, placed_sphere(), grey_light(), SurfaceSettings(), SPHERE_RADIUS)
    return start_mesh_materials(surface, MeshMaterialSettings(), SPHERE_RADIUS)


def test_even_offsets_move_along_normals_and_leave_these(views: Views):
    state = started()
    surface = DisplacedSurface(MovingSurface(views, placed_sphere().faces, state), state)
    before = torch.nn.functional.normalize(state.parameters["normals"].detach(), dim=-1)
    with torch.no_grad():
        state.parameters["offsets"].fill_(0.5)
        positions = surface.positions()
        normals = surface.normals(positions)
    away = (positions - state.parameters["vertices"]).norm(dim=1)
    assert float(away.std() / away.mean()) < 0.01
    assert torch.allclose((positions - CENTER).norm(dim=1), SPHERE_RADIUS + away, rtol=1e-3)
    assert torch.allclose(normals, before, atol=2e-3)


def test_normals_turn_as_the_surfaces_own_do(views: Views):
    state = started()
    surface = DisplacedSurface(MovingSurface(views, placed_sphere().faces, state), state)
    tilt = 0.02 * torch.tensor([1.0, 0.5, -0.3])
    with torch.no_grad():
        before = surface.normals(surface.positions())
        # a sphere that is displaced by a linear function of its normal is, to first order, the same sphere beside its place
        state.parameters["offsets"].copy_((placed_sphere().vertices - CENTER) / SPHERE_RADIUS @ tilt)
        positions = surface.positions()
        own = vertex_normals(positions, placed_sphere().faces) - vertex_normals(state.parameters["vertices"], placed_sphere().faces)
        found = surface.normals(positions)
    assert torch.allclose(found, torch.nn.functional.normalize(before + own, dim=-1), atol=1e-6)


def test_settled_the_surface_lies_where_it_was_displaced_to(views: Views):
    state = started()
    moving = MovingSurface(views, placed_sphere().faces, state)
    surface = DisplacedSurface(moving, state)
    with torch.no_grad():
        state.parameters["offsets"].copy_(0.1 * torch.randn(len(placed_sphere().vertices), generator=torch.Generator().manual_seed(5)))
        positions = surface.positions()
        normals = surface.normals(positions)
    before = state.parameters["vertices"].clone()
    surface.settle()
    assert torch.allclose(state.parameters["vertices"], positions, atol=1e-7) and not state.parameters["offsets"].any()
    assert torch.allclose(state.parameters["normals"], normals, atol=1e-6)
    assert torch.allclose(state.parameters["homeward"], before - positions, atol=1e-7)
    assert torch.equal(moving.tracer.mesh.vertices, state.parameters["vertices"])
    with torch.no_grad():
        assert torch.equal(surface.positions(), state.parameters["vertices"])
        assert torch.allclose(surface.normals(surface.positions()), state.parameters["normals"], atol=1e-6)


def test_faces_do_not_turn_nearly_over(views: Views):
    state = started()
    surface = DisplacedSurface(MovingSurface(views, placed_sphere().faces, state), state)
    before = vertex_normals(state.parameters["vertices"], placed_sphere().faces)
    with torch.no_grad():
        state.parameters["offsets"].copy_(6 * torch.randn(len(before), generator=torch.Generator().manual_seed(6)))
        displaced = surface.positions()
    surface.settle()

    def least_cosine(vertices: torch.Tensor) -> float:
        a, b, c = vertices[placed_sphere().faces.long()].unbind(1)
        own = torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a), dim=-1, eps=1e-30)
        return float((own * before[placed_sphere().faces.long()].mean(1)).sum(1).min())

    assert least_cosine(displaced) < 0.5 * TURNED < 0.9 * TURNED < least_cosine(state.parameters["vertices"])
