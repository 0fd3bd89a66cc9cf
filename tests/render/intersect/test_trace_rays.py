"""Both tracers against each other and against spheres."""

import pytest
import torch

from drgs.render.intersect.trace_rays import build_tracer, trace_rays
from drgs.render.intersect.tracer_embree import EmbreeTracer
from drgs.render.intersect.tracer_warp import WarpTracer
from tests.render.closed_form_scenes import on_device, sphere_mesh, two_spheres


def random_rays(count: int) -> tuple[torch.Tensor, torch.Tensor]:
    origins = torch.nn.functional.normalize(torch.randn(count, 3), dim=-1) * 3
    targets = torch.rand(count, 3) * 4 - 2
    return origins, torch.nn.functional.normalize(targets - origins, dim=-1)


def test_embree_and_warp_meet_the_same_triangles() -> None:
    mesh = two_spheres()
    origins, directions = random_rays(20_000)
    a, b = (trace_rays(origins, directions, tracer) for tracer in (EmbreeTracer(mesh), WarpTracer(mesh)))
    assert float((a.hit == b.hit).float().mean()) > 0.9995
    both = a.hit & b.hit
    assert int(both.sum()) > 4000
    torch.testing.assert_close(a.distance[both], b.distance[both], atol=1e-4, rtol=1e-4)
    same = both & (a.face == b.face)
    assert float(same.sum() / both.sum()) > 0.999
    torch.testing.assert_close(a.barycentric[same], b.barycentric[same], atol=1e-3, rtol=0)
    assert bool((a.face[~a.hit] == -1).all()) and bool(torch.isinf(a.distance[~a.hit]).all())


@pytest.mark.parametrize("tracer_class", [EmbreeTracer, WarpTracer])
def test_barycentric_weights_rebuild_the_hit_point(tracer_class: type) -> None:
    mesh = sphere_mesh()
    origins, directions = random_rays(3000)
    hits = trace_rays(origins, directions, tracer_class(mesh))
    corners = mesh.vertices[mesh.faces[hits.face[hits.hit]].long()]
    weights = torch.cat([1 - hits.barycentric.sum(-1, keepdim=True), hits.barycentric], -1)[hits.hit]
    met = origins[hits.hit] + hits.distance[hits.hit, None] * directions[hits.hit]
    torch.testing.assert_close((weights[..., None] * corners).sum(1), met, atol=1e-4, rtol=0)


def test_visibility_is_the_absence_of_hits(device: str) -> None:
    tracer = build_tracer(on_device(two_spheres(), device))
    origins, directions = (t.to(device) for t in random_rays(200_000))  # more than one slice
    assert torch.equal(tracer.occluded(origins, directions), trace_rays(origins, directions, tracer).hit)


def test_void_rays_from_far_outside_miss() -> None:
    for tracer in (EmbreeTracer(sphere_mesh()), WarpTracer(sphere_mesh())):
        origin = torch.full((10, 3), 1e15)
        assert not bool(tracer.occluded(origin, torch.full((10, 3), 3**-0.5)).any())


def test_no_rays_give_no_hits() -> None:
    for tracer in (EmbreeTracer(sphere_mesh()), WarpTracer(sphere_mesh())):
        assert len(trace_rays(torch.zeros(0, 3), torch.zeros(0, 3), tracer).hit) == 0
        assert len(tracer.occluded(torch.zeros(0, 3), torch.zeros(0, 3))) == 0


def test_a_refitted_tree_follows_its_vertices(device: str) -> None:
    mesh = on_device(sphere_mesh(), device)
    tracer = WarpTracer(mesh)
    ray = torch.tensor([[0.0, 0.0, 10.0]], device=device), torch.tensor([[0.0, 0.0, -1.0]], device=device)
    before = float(trace_rays(*ray, tracer).distance[0])
    tracer.refit(mesh.vertices + torch.tensor([0.0, 0.0, 2.0], device=device))
    assert abs(float(trace_rays(*ray, tracer).distance[0]) - (before - 2)) < 1e-4
