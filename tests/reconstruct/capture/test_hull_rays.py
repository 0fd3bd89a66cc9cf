"""What other views see at a place is the mean of their rays that end there, and of nothing else; on the surface itself paint looks alike, mirrors do not."""

from dataclasses import replace

import torch

from drgs.reconstruct.capture.hull_rays import seen_from_elsewhere, unlikeness
from drgs.reconstruct.capture.turning_light import with_light_of_camera
from drgs.reconstruct.fit.view_targets import view_targets
from drgs.render.intersect.trace_rays import build_tracer
from drgs.render.intersect.tracer import AbstractTracer
from drgs.scene.views import Views
from tests.reconstruct.capture.test_find_hollows import CPU, bowl_and_ball, lit_from_the_camera, mirror, paint, photographed


def test_a_ray_is_compared_with_other_views_rays_in_its_cell() -> None:
    random = torch.Generator().manual_seed(0)
    count, cell = 400, 0.25
    places = 2 * torch.rand(count, 3, generator=random) - 1
    ended = torch.rand(count, generator=random) < 0.8
    colors, view = torch.rand(count, 3, generator=random), torch.randint(0, 5, (count,), generator=random)
    mean, seen = seen_from_elsewhere(places, ended, colors, view, cell)
    corner = torch.floor(places / cell)
    for ray in range(count):
        others = (corner == corner[ray]).all(1) & (view != view[ray]) & ended
        assert bool(seen[ray]) == bool(others.any())
        torch.testing.assert_close(mean[ray], colors[others].mean(0) if bool(others.any()) else torch.zeros(3), atol=1e-5, rtol=1e-5)
    assert 0.1 < float(seen.float().mean()) < 0.9


def test_paint_looks_alike_on_the_surface_and_not_before_it_nor_do_mirrors() -> None:
    bowl = bowl_and_ball()
    painted, mirrored = (view_targets(photographed(bowl, shade, count=16), 1.0, CPU) for shade in (paint, mirror))
    right = unlikeness(bowl, painted, rings=1)
    seen = torch.isfinite(right)
    assert 0.5 < float(seen.float().mean()) < 1, "what the ball touches and the wall hides no view sees"
    mesh = bowl.mesh
    fatter = build_tracer(replace(mesh, vertices=mesh.vertices + 0.05 * mesh.normals))
    assert float(right[seen].median()) < 0.02
    for other in (unlikeness(fatter, painted, rings=1), unlikeness(bowl, mirrored, rings=1)):
        assert float(other[torch.isfinite(other)].median()) > 3 * float(right[seen].median())
    one = [replace(painted[0], saturation=1 - painted[0].saturation), *painted[1:]]
    changed = (unlikeness(bowl, one, rings=1) - right)[seen].abs()
    assert float(changed.median()) < 0.02, "the looks that differ most are left out"
    assert torch.isinf(unlikeness(bowl, painted[:2], rings=1)).all(), "two views are too few"


def test_under_light_that_turns_paint_looks_alike_where_it_is_and_mirrors_do_not() -> None:
    bowl = bowl_and_ball()
    lit, mirrored = (photographed(bowl, shade, count=32) for shade in (lit_from_the_camera, mirror))
    fatter = build_tracer(replace(bowl.mesh, vertices=bowl.mesh.vertices + 0.05 * bowl.mesh.normals))

    def median(surface: AbstractTracer, views: Views) -> float:
        differences = unlikeness(surface, view_targets(views, 1.0, CPU), rings=1)
        return float(differences[torch.isfinite(differences)].median())

    right = median(bowl, with_light_of_camera(lit))
    assert right < 0.7 * median(bowl, lit)
    assert median(fatter, with_light_of_camera(lit)) > 2 * right
    assert median(bowl, with_light_of_camera(mirrored)) > 3 * right
