"""What pixels show of a surface: two places each, apart within the pixel; and what is finer than a pixel stays as it is."""

from dataclasses import replace

import pytest
import torch

from drgs.reconstruct.fit.light.mesh_light import MeshLight
from drgs.reconstruct.fit.light.split_sum import filter_environment
from drgs.reconstruct.fit.losses import crossed_halves
from drgs.reconstruct.fit.surface.shade_surface import (
    SeenPlaces,
    joined,
    seen_places,
    seen_twice,
    shade_photographs,
    shade_places,
    steep_enough,
)
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
    first, second = seen_twice(target, solid(target), tracer, torch.Generator().manual_seed(1)).halves()
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
            twice = seen_twice(target, solid(target), fine, generator).halves()
            first, second = (
                (0.5 + contrast * (pattern[twice[k].corners] * twice[k].weights).sum(1))[:, None].expand(-1, 3) for k in places
            )
            (crossed_halves(first, second, torch.full_like(first, 0.5)) / 12).backward()
        assert contrast.grad is not None
        return float(contrast.grad)

    assert mean_gradient((0, 0)) > 0.3
    assert abs(mean_gradient((0, 1))) < 0.1


def test_colours_change_with_the_place_as_differences_say(target: ViewTarget, tracer: AbstractTracer):
    """Weights that want a gradient get that of the colour's change along the face, and leave the colour what it is."""
    generator = torch.Generator().manual_seed(3)
    count = len(tracer.mesh.vertices)
    outward = torch.nn.functional.normalize(tracer.mesh.vertices - tracer.mesh.vertices.mean(0), dim=-1)
    packed = torch.cat([outward, 0.4 + 0.5 * torch.rand(count, 4, generator=generator), torch.zeros(count, 1)], 1)
    around = torch.linspace(0, 2 * torch.pi, 257)[:-1].expand(128, 256)
    smooth = 1 + 0.6 * torch.stack([around.cos(), around.sin(), (2 * around).cos()], -1)
    light = MeshLight(filter_environment(smooth), torch.full((count, 3), 0.8))
    seen = seen_places(target, solid(target)[::7], tracer)

    def colors(weights: torch.Tensor, surface: torch.Tensor) -> torch.Tensor:
        moved = replace(seen, weights=weights)
        return shade_places(moved, target, tracer, surface, light, torch.Generator().manual_seed(4))

    wanted, surface = seen.weights.clone().requires_grad_(), packed.clone().requires_grad_()
    known = packed.clone().requires_grad_()
    by_place, by_kernel = colors(wanted, surface), colors(seen.weights, known)
    assert torch.allclose(by_place, by_kernel, atol=1e-5)
    factor = torch.rand(by_place.shape, generator=generator)
    (by_place * factor).sum().backward()
    (by_kernel * factor).sum().backward()
    assert surface.grad is not None and known.grad is not None and wanted.grad is not None
    assert torch.allclose(surface.grad, known.grad, rtol=1e-3, atol=1e-4)
    step = 2e-3 * torch.tensor([1.0, -1.0, 0.0])
    with torch.no_grad():
        difference = ((colors(seen.weights + step, packed) - colors(seen.weights - step, packed)) * factor).sum(1)
    slope = 2 * (wanted.grad * step).sum(1)
    assert float(difference.abs().mean()) > 1e-4
    # what blocks light, and where, is taken as known: here it is the same everywhere
    assert float((difference - slope).abs().mean()) < 0.01 * float(difference.abs().mean())


def test_photographs_shaded_at_once_have_the_colours_and_gradients_of_one_by_one(target: ViewTarget, tracer: AbstractTracer):
    """Three with two ceilings and two lights, of different sizes; from a sphere every mirrored ray escapes, so nothing differs by what is drawn."""
    generator, count = torch.Generator().manual_seed(5), len(tracer.mesh.vertices)
    outward = torch.nn.functional.normalize(tracer.mesh.vertices - tracer.mesh.vertices.mean(0), dim=-1)
    packed = torch.cat([outward, 0.2 + 0.6 * torch.rand(count, 5, generator=generator)], 1).requires_grad_()
    lights = [MeshLight(filter_environment((k + 0.5) * torch.ones(128, 256, 3)), torch.full((count, 3), 0.9)) for k in range(2)]
    targets = [target, replace(target, ceiling=0.4, saturation=target.saturation.clamp(max=0.4)), replace(target)]
    light_of = {id(one): lights[k] for one, k in zip(targets, (0, 0, 1), strict=True)}
    looks = [seen_twice(one, solid(one)[:: k + 2], tracer, generator) for k, one in enumerate(targets)]

    first, second, photo = shade_photographs(looks, targets, tracer, packed, lambda one: light_of[id(one)], generator)
    factor = torch.rand(first.shape, generator=generator)
    at_once = torch.autograd.grad((first * factor).sum() + 2 * (second * factor).sum(), packed)[0]

    alone = [
        [shade_places(half, one, tracer, packed, light_of[id(one)], generator) for half in look.halves()]
        for look, one in zip(looks, targets, strict=True)
    ]
    expected = [torch.cat([halves[k] for halves in alone]) for k in range(2)]
    assert len({len(look.pixels) for look in looks}) == 3 and float(expected[0].detach().max()) > 0.5
    torch.testing.assert_close(first, expected[0], rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(second, expected[1], rtol=1e-5, atol=1e-6)
    shown = [one.saturation.reshape(-1, 3)[look.halves()[0].pixels] for look, one in zip(looks, targets, strict=True)]
    assert torch.equal(photo, torch.cat(shown))
    one_by_one = torch.autograd.grad((expected[0] * factor).sum() + 2 * (expected[1] * factor).sum(), packed)[0]
    torch.testing.assert_close(at_once, one_by_one, rtol=1e-4, atol=1e-5)


def test_what_is_joined_comes_apart_again(target: ViewTarget, tracer: AbstractTracer):
    seen = seen_places(target, solid(target)[::9], tracer)
    for half in joined([seen, seen]).halves():
        assert all(torch.equal(values, getattr(seen, name)) for name, values in vars(half).items())


def test_photographs_that_see_nothing_have_no_colours(target: ViewTarget, tracer: AbstractTracer):
    nothing = seen_twice(target, solid(target)[:0], tracer, torch.Generator().manual_seed(1))
    count = len(tracer.mesh.vertices)
    light = MeshLight(filter_environment(torch.ones(128, 256, 3)), torch.ones(count, 3))
    values = shade_photographs([nothing] * 2, [target] * 2, tracer, torch.rand(count, 8), lambda _: light, torch.Generator())
    assert [value.shape for value in values] == [(0, 3)] * 3
