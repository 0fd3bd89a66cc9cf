"""What pixels show of a surface: two places each, apart within the pixel; and what is finer than a pixel stays as it is."""

import pytest
import torch

from drgs.reconstruct.fit.losses import crossed_halves
from drgs.reconstruct.fit.surface.shade_surface import SeenPlaces, seen_places, seen_twice, steep_enough
from drgs.reconstruct.fit.view_targets import ViewTarget, view_targets
from drgs.render.intersect.trace_rays import build_tracer
from drgs.render.intersect.tracer import AbstractTracer
from tests.reconstruct.fit.painted_sphere import painted_views, placed_sphere


@pytest.fixture(scope="module")
def target(tmp_path_factory: pytest.TempPathFactory) -> ViewTarget:
    return view_targets(painted_views(tmp_path_factory.mktemp("capture"), 3), 1.0, torch.device("cpu"))[0]


@pytest.fixture(scope="module")
def tracer() -> AbstractTracer:
    return build_tracer(placed_sphere(subdivisions=4))


def solid(target: ViewTarget) -> torch.Tensor:
    return (target.mask.flatten() > 0.995).nonzero().squeeze(1)


def places_world(seen: SeenPlaces, tracer: AbstractTracer) -> torch.Tensor:
    return (tracer.mesh.vertices[seen.corners] * seen.weights[..., None]).sum(1)


def image_places(seen: SeenPlaces, tracer: AbstractTracer, target: ViewTarget) -> torch.Tensor:
    """(place, 2) where the camera sees them [pixels]."""
    camera = target.camera
    turned = places_world(seen, tracer) @ camera.camera_from_world[:3, :3].T + camera.camera_from_world[:3, 3]
    flat = turned @ camera.intrinsics.T
    return flat[:, :2] / flat[:, 2:]


def test_two_places_of_a_pixel_lie_apart_and_within_it(target: ViewTarget, tracer: AbstractTracer):
    first, second = seen_twice(target, solid(target), tracer, torch.Generator().manual_seed(1))
    assert torch.equal(first.pixels, second.pixels) and len(first.pixels) > 100
    inside = []
    for seen in (first, second):
        pixel = torch.stack([seen.pixels % target.camera.width, seen.pixels // target.camera.width], -1)
        inside.append(image_places(seen, tracer, target) - pixel)
        assert float(inside[-1].min()) > -1e-2 and float(inside[-1].max()) < 1 + 1e-2
        assert torch.allclose(inside[-1].mean(0), torch.full((2,), 0.5), atol=0.05)
        assert torch.allclose(inside[-1].std(0), torch.full((2,), 12**-0.5), atol=0.05)
    # drawn anew: what one says of the place the other does not know
    assert abs(float(torch.corrcoef(torch.stack([inside[0][:, 0], inside[1][:, 0]]))[0, 1])) < 0.15
    middles = image_places(seen_places(target, first.pixels, tracer), tracer, target)
    assert torch.allclose(middles % 1, torch.full_like(middles, 0.5), atol=1e-2)


def test_all_that_is_seen_steeply_is_compared(target: ViewTarget, tracer: AbstractTracer):
    seen = seen_places(target, solid(target), tracer)
    outward = torch.nn.functional.normalize(tracer.mesh.vertices - tracer.mesh.vertices.mean(0), dim=-1)
    assert float(steep_enough(seen, outward).float().mean()) > 0.95
    assert not steep_enough(seen, -outward).any()


def test_what_is_finer_than_a_pixel_is_not_flattened(target: ViewTarget):
    """Of a pattern within the pixels the photograph shows the mean. By two places the mean gradient of its contrast is next to nothing; by one place
    for both estimates the pattern is drawn to grey."""
    fine = build_tracer(placed_sphere(subdivisions=6))  # a dozen vertices a pixel
    pattern = torch.randn(len(fine.mesh.vertices), generator=torch.Generator().manual_seed(7))
    generator = torch.Generator().manual_seed(2)

    def mean_gradient(places: tuple[int, int]) -> float:
        contrast = torch.tensor(0.1, requires_grad=True)
        for _ in range(12):
            twice = seen_twice(target, solid(target), fine, generator)
            first, second = (
                (0.5 + contrast * (pattern[twice[k].corners] * twice[k].weights).sum(1))[:, None].expand(-1, 3) for k in places
            )
            (crossed_halves(first, second, torch.full_like(first, 0.5)) / 12).backward()
        assert contrast.grad is not None
        return float(contrast.grad)

    assert mean_gradient((0, 0)) > 0.3
    assert abs(mean_gradient((0, 1))) < 0.1
