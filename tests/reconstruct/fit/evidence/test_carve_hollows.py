"""A bump that photographs do not show is carved away; mirrors, and what no photograph shows behind the surface, stay."""

import dataclasses

import pytest
import torch

from drgs.reconstruct.fit.evidence import carve_hollows
from drgs.reconstruct.fit.evidence.carve_hollows import CarveSettings, carved_depths, view_differences
from drgs.reconstruct.fit.view_targets import ViewTarget, view_targets
from drgs.reconstruct.geometry.mesh_edges import mesh_edges
from drgs.render.intersect.trace_rays import build_tracer
from drgs.scene.mesh import TriangleMesh, vertex_normals
from tests.reconstruct.fit.painted_sphere import CENTER, painted_views, placed_sphere
from tests.reconstruct.tiny_capture import SPHERE_RADIUS

BUMP = 0.12
"""Of the radius."""
SETTINGS = CarveSettings(step=0.02, steps=12, shallowest=2, cost_rings=2, direction_rings=3)


@pytest.fixture(scope="module")
def targets(tmp_path_factory: pytest.TempPathFactory) -> list[ViewTarget]:
    return view_targets(painted_views(tmp_path_factory.mktemp("painted"), 24), 1.0, torch.device("cpu"))


def bumped(**materials: float) -> tuple[TriangleMesh, torch.Tensor]:
    """The painted sphere, fatter on one side, and how much of the bump each vertex has (0..1)."""
    sphere = placed_sphere(subdivisions=4)
    direction = (sphere.vertices - CENTER) / SPHERE_RADIUS
    share = ((direction[:, 0] - 0.5) / 0.3).clamp(0, 1)
    vertices = sphere.vertices + (BUMP * SPHERE_RADIUS * share)[:, None] * direction
    mesh = dataclasses.replace(sphere, vertices=vertices, normals=vertex_normals(vertices, sphere.faces))
    changed = {name: torch.full_like(mesh.roughness, value) for name, value in ({"roughness": 0.6, "metallic": 0.0} | materials).items()}
    return dataclasses.replace(mesh, **changed), share


def carved(mesh: TriangleMesh, evidence: float, targets: list[ViewTarget]) -> tuple[torch.Tensor, torch.Tensor]:
    known = torch.full_like(mesh.roughness, evidence)
    return carved_depths(build_tracer(mesh), known, targets, mesh_edges(mesh.faces), SPHERE_RADIUS, SETTINGS)


@pytest.mark.slow
def test_a_bump_on_paint_goes_and_the_rest_stays(targets: list[ViewTarget]):
    mesh, share = bumped()
    inward, depth = carved(mesh, -1.0, targets)
    before = ((mesh.vertices - CENTER).norm(dim=1) / SPHERE_RADIUS - 1).abs()
    after = ((mesh.vertices + depth[:, None] * inward - CENTER).norm(dim=1) / SPHERE_RADIUS - 1).abs()
    top = share > 0.95
    assert float(before[top].mean()) > 0.11 and float(after[top].mean()) < 0.05
    assert float(after[share == 0].mean()) < 0.01


@pytest.mark.parametrize(("materials", "evidence"), [({"metallic": 1.0}, -1.0), ({"roughness": 0.1}, -1.0), ({}, 0.5)])
def test_what_may_be_a_mirror_stays(targets: list[ViewTarget], materials: dict[str, float], evidence: float):
    _, depth = carved(bumped(**materials)[0], evidence, targets)
    assert float(depth.max()) == 0


def test_only_the_views_that_look_most_steeply_are_asked(targets: list[ViewTarget]):
    mesh, _ = bumped()
    tracer, some = build_tracer(mesh), torch.arange(0, len(mesh.vertices), 7)
    inward = -mesh.normals[some]
    place = mesh.vertices[some] + 0.1 * SPHERE_RADIUS * inward
    where = (tracer, targets, some, inward, 0.1 * SPHERE_RADIUS, SPHERE_RADIUS)
    (_, every), (_, steep) = view_differences(*where), view_differences(*where, steepest=0.4, fewest_steep=3)
    assert torch.equal(steep, torch.minimum(every, (0.4 * every).ceil().clamp(min=3)))
    # One picture is green: only the places that it looks at steeply can tell.
    green = dataclasses.replace(targets[5], saturation=torch.tensor([0.0, 1.0, 0.0]).expand_as(targets[5].saturation).contiguous())
    with_green = (tracer, [*targets[:5], green, *targets[6:]], *where[2:])
    by_steep, by_every = (view_differences(*with_green, *asked)[0] != view_differences(*where, *asked)[0] for asked in ((0.4, 3), (1.0, 0)))
    towards = torch.nn.functional.normalize(place - green.camera.center_world, dim=1)
    cosine = (towards * inward).sum(1)
    assert 10 < int(by_steep.sum()) < int(by_every.sum())
    assert float(cosine[by_steep].mean()) > float(cosine[by_every].mean()) + 0.05


@pytest.mark.slow
def test_where_the_surface_is_right_nothing_moves(targets: list[ViewTarget]):
    sphere = dataclasses.replace(placed_sphere(subdivisions=4), roughness=torch.full((2562,), 0.6))
    _, depth = carved(sphere, -1.0, targets)
    assert float(depth.mean()) < 0.003 * SPHERE_RADIUS


def test_what_wants_to_go_through_leaves_a_wall(targets: list[ViewTarget], monkeypatch: pytest.MonkeyPatch):
    """Whatever the photographs say, here: the deeper the better."""

    def deeper_is_better(tracer, targets, vertices, inward, depth, radius, steepest, fewest_steep):
        return torch.full((len(vertices),), max(0.0, 0.3 - depth)), torch.full((len(vertices),), 12.0)

    monkeypatch.setattr(carve_hollows, "view_differences", deeper_is_better)
    ball, _ = bumped()
    flat = ball.vertices.clone()
    flat[:, 2] = CENTER[2] + 0.03 * (flat[:, 2] - CENTER[2])
    plate = dataclasses.replace(ball, vertices=flat, normals=vertex_normals(flat, ball.faces))
    _, depth = carved(plate, -1.0, targets)
    middle = (flat[:, :2] - CENTER[:2]).norm(dim=1) < 0.5 * SPHERE_RADIUS
    thickness = 2 * (flat[:, 2] - CENTER[2]).abs()[middle]
    assert float(depth[middle].max()) > 0.015 * SPHERE_RADIUS
    assert float((thickness - depth[middle]).min()) > 0.025 * SPHERE_RADIUS
