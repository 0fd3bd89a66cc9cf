"""Where rays of splatted points start: the kernels against the same steps with whole batches of rays."""

import pytest
import torch

from drgs.reference import lift_points as reference
from drgs.render.intersect.tracer import AbstractTracer
from drgs.render.intersect.tracer_embree import EmbreeTracer
from drgs.render.intersect.tracer_warp import WarpTracer
from drgs.render.records import ShadingPoints
from drgs.render.visible.lift_points import FAR, NEAR, lift_points
from tests.render.closed_form_scenes import sphere_mesh


def points_near_a_sphere(tracer_class: type, count: int = 3000) -> tuple[ShadingPoints, AbstractTracer]:
    """Points on, just off and far off a sphere, seen from all around; some far outside its outline."""
    numbers = torch.Generator().manual_seed(2)
    tracer = tracer_class(sphere_mesh(3))
    outward = torch.nn.functional.normalize(torch.randn(count, 3, generator=numbers), dim=-1)
    share = torch.tensor([0.0, 0.3 * NEAR, 0.4 * FAR, 2.0])[torch.arange(count) % 4]
    position = outward * (1 + (share * tracer.extent * (2 * torch.rand(count, generator=numbers) - 1))[:, None])
    normal = torch.nn.functional.normalize(outward + 0.3 * torch.randn(count, 3, generator=numbers), dim=-1)
    wo = torch.nn.functional.normalize(outward + 0.8 * torch.randn(count, 3, generator=numbers), dim=-1)
    one = torch.ones(count)
    return ShadingPoints(position, normal, wo, torch.ones(count, 3), one, one, torch.arange(count).int()), tracer


@pytest.mark.parametrize("tracer_class", [EmbreeTracer, WarpTracer])
def test_the_kernel_starts_rays_where_batches_of_rays_say(tracer_class: type) -> None:
    points, tracer = points_near_a_sphere(tracer_class)
    kernel = lift_points(points, tracer)
    batches = reference.lift_points(points, tracer)
    assert kernel.face is not None and batches.face is not None
    assert 0.1 < float((kernel.face < 0).float().mean()) < 0.9  # both kinds are there
    same = kernel.face == batches.face
    assert float(same.float().mean()) > 0.999  # rounding may decide right at a bound
    torch.testing.assert_close(kernel.origin_world[same], batches.origin_world[same], atol=2e-6, rtol=0)
    torch.testing.assert_close(kernel.surface_normal_world[same], batches.surface_normal_world[same])


def test_points_that_meet_no_mesh_stay_where_they_are() -> None:
    points, tracer = points_near_a_sphere(EmbreeTracer)
    starts = lift_points(points, tracer)
    assert starts.face is not None
    alone = starts.face < 0
    torch.testing.assert_close(starts.origin_world[alone], (points.position_world + tracer.lift * points.normal_world)[alone])
    assert torch.equal(starts.surface_normal_world[alone], points.normal_world[alone])
