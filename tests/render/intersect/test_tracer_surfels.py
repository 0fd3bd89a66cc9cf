"""The surfel tracer against closed forms, its float64 twin and finite differences."""

import math
import sys

import pytest
import torch

from drgs.maths.frames import rotation_from_quat_wxyz
from drgs.reference import tracer_surfels as twin
from drgs.render.intersect.tracer_surfels import SurfelScene, build_surfel_scene, trace_surfel_radiance
from drgs.scene.materials import Materials
from drgs.scene.posed_scene import PosedSurfels


def posed(centers: torch.Tensor, tangents: torch.Tensor, opacities: torch.Tensor) -> PosedSurfels:
    count = centers.shape[0]
    return PosedSurfels(centers, tangents, opacities, Materials(torch.full((count, 3), 0.5), torch.full((count,), 0.5), torch.zeros(count)))


def random_surfels(count: int, seed: int, size: float = 0.25) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Sheared discs in a ball: centres, tangents, opacities, SH radiance; float64, rounded to float32."""
    generator = torch.Generator().manual_seed(seed)
    centers = torch.randn(count, 3, generator=generator) * 0.4
    rotation = rotation_from_quat_wxyz(torch.randn(count, 4, generator=generator))
    shear = torch.eye(3) + 0.3 * torch.randn(count, 3, 3, generator=generator)
    scales = size * (0.3 + torch.rand(count, 1, 2, generator=generator))
    tangents = shear @ rotation[:, :, :2] * scales
    opacities = 0.05 + 0.9 * torch.rand(count, generator=generator)
    radiance = 0.3 * torch.randn(count, 16, 3, generator=generator)
    return centers.double(), tangents.double(), opacities.double(), radiance.double()


def random_rays(count: int, seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Towards the ball from outside; every fourth from within."""
    generator = torch.Generator().manual_seed(seed)
    origins = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=-1) * 2.5
    origins[::4] *= 0.1
    targets = 0.3 * torch.randn(count, 3, generator=generator)
    return origins.double(), torch.nn.functional.normalize((targets - origins).double(), dim=-1)


def stacked_discs(distances: list[float], opacity: float) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Unit discs across the z axis."""
    count = len(distances)
    centers = torch.zeros(count, 3)
    centers[:, 2] = torch.tensor(distances)
    return centers, torch.eye(3)[:, :2].expand(count, 3, 2).clone(), torch.full((count,), opacity)


AXIS_RAY = torch.zeros(1, 3), torch.tensor([[0.0, 0.0, 1.0]])


def scene_of(centers: torch.Tensor, tangents: torch.Tensor, opacities: torch.Tensor, radiance: torch.Tensor | None = None) -> SurfelScene:
    radiance = torch.zeros(centers.shape[0], 3) if radiance is None else radiance
    return build_surfel_scene(posed(centers.float(), tangents.float(), opacities.float()), radiance.float())


def transmittance(origins: torch.Tensor, directions: torch.Tensor, scene: SurfelScene, t_min: float) -> torch.Tensor:
    """(R,) what the surfels let through."""
    return 1 - trace_surfel_radiance(origins, directions, scene, t_min)[1]


def test_transmittance_is_the_product_over_all_hits():
    surfels, rays = random_surfels(150, 0, size=0.06)[:3], random_rays(400, 1)
    got = transmittance(rays[0].float(), rays[1].float(), scene_of(*surfels), 0.05)
    alpha, t = twin.meet_surfels(*rays, *surfels)
    expected = torch.where(t > 0.05, 1 - alpha, torch.ones_like(alpha)).prod(-1)  # in no order, and never cut short
    opaque = expected < twin.MIN_TRANSMITTANCE
    assert (got[opaque] < twin.MIN_TRANSMITTANCE).all()
    assert_close_but_for_edges(got[~opaque], expected[~opaque], 2e-5, step=1 / 255)
    assert (expected < 0.5).sum() > 50 and (expected > 0.9).sum() > 5


def assert_close_but_for_edges(got: torch.Tensor, expected: torch.Tensor, tolerance: float, step: float) -> None:
    """Equal within `tolerance`, except in 1 % of the entries, where a hit may fall on either side of the alpha cutoff."""
    difference = (got.double() - expected).abs()
    assert difference.max() <= 1.5 * step
    assert (difference > tolerance).double().mean() <= 0.01


@pytest.mark.parametrize("constant", [False, True])
def test_radiance_opacity_and_depth_match_the_twin(constant):
    centers, tangents, opacities, sh = random_surfels(150, 2)
    radiance = sh[:, 0].abs() if constant else sh
    rays = random_rays(400, 3)
    got = trace_surfel_radiance(rays[0].float(), rays[1].float(), scene_of(centers, tangents, opacities, radiance), 0.05)
    expected = twin.trace_surfel_radiance(*rays, centers, tangents, opacities, radiance, 0.05)
    assert_close_but_for_edges(got[0], expected[0], 5e-5, step=2 / 255)
    assert_close_but_for_edges(got[1], expected[1], 5e-5, step=1 / 255)
    seen = expected[1] > 0.1
    assert_close_but_for_edges(got[2][seen], (expected[2] / expected[1].clamp(min=1e-12))[seen], 5e-4, step=0.05)
    assert torch.isinf(got[2][expected[1] == 0]).all()


@pytest.mark.parametrize("degree", [0, 1, 2])
def test_lower_degrees_of_harmonics_match_the_twin(degree):
    centers, tangents, opacities, sh = random_surfels(40, 4)
    sh = sh[:, : (degree + 1) ** 2].contiguous()
    rays = random_rays(100, 5)
    got = trace_surfel_radiance(rays[0].float(), rays[1].float(), scene_of(centers, tangents, opacities, sh), 0.0)[0]
    assert_close_but_for_edges(got, twin.trace_surfel_radiance(*rays, centers, tangents, opacities, sh, 0.0)[0], 5e-5, step=2 / 255)


def test_nearer_surfels_come_first_whatever_their_index():
    surfels = stacked_discs([3.0, 1.0, 2.0], 0.5)
    colors = torch.eye(3)
    radiance, opacity, depth = trace_surfel_radiance(*AXIS_RAY, scene_of(*surfels, colors), 0.0)
    torch.testing.assert_close(radiance, torch.tensor([[0.125, 0.5, 0.25]]))
    assert opacity.item() == pytest.approx(0.875)
    assert depth.item() == pytest.approx((0.5 * 1 + 0.25 * 2 + 0.125 * 3) / 0.875)


@pytest.mark.parametrize("count", [15, 16, 17, 33, 100])
def test_no_hit_is_lost_or_met_twice_when_many_overlap(count):
    order = torch.randperm(count, generator=torch.Generator().manual_seed(count))
    surfels = stacked_discs((1 + order / 7.0).tolist(), 0.05)
    colors = torch.rand(count, 3, generator=torch.Generator().manual_seed(6))
    radiance, opacity, _ = trace_surfel_radiance(*AXIS_RAY, scene_of(*surfels, colors), 0.0)
    weights = 0.05 * 0.95 ** order.double()
    torch.testing.assert_close(radiance[0].double(), (weights[:, None] * colors).sum(0), atol=2e-6, rtol=1e-5)
    assert opacity.item() == pytest.approx(1 - 0.95**count, abs=2e-6)


@pytest.mark.parametrize("count", [3, 16, 40])
def test_equal_distances_are_blended_once_each_in_index_order(count):
    surfels = stacked_discs([2.0] * count, 0.1)
    colors = torch.zeros(count, 3)
    colors[:, 0] = torch.arange(count)
    radiance, opacity, _ = trace_surfel_radiance(*AXIS_RAY, scene_of(*surfels, colors), 0.0)
    weights = 0.1 * 0.9 ** torch.arange(count, dtype=torch.float64)
    assert radiance[0, 0].item() == pytest.approx((weights * torch.arange(count)).sum().item(), rel=1e-5)
    assert opacity.item() == pytest.approx(1 - 0.9**count, rel=1e-5)


def test_hits_behind_the_origin_or_before_t_min_do_not_count():
    scene = scene_of(*stacked_discs([-1.0, 0.5, 2.0], 0.5), torch.eye(3))
    assert transmittance(*AXIS_RAY, scene, 0.0).item() == pytest.approx(0.25)
    assert transmittance(*AXIS_RAY, scene, 0.5).item() == pytest.approx(0.5)  # at t_min itself: not counted
    radiance, _, depth = trace_surfel_radiance(*AXIS_RAY, scene, 0.5)
    torch.testing.assert_close(radiance, torch.tensor([[0.0, 0.0, 0.5]]))
    assert depth.item() == pytest.approx(2.0)


@pytest.mark.parametrize("opacity", [0.5 / 255, 1 / 255, 1.02 / 255, 1.5 / 255, 1.0])
def test_opacity_near_its_bounds_is_cut_and_clamped(opacity):
    scene = scene_of(*stacked_discs([1.0], opacity), torch.ones(1, 3))
    expected = 0.0 if opacity <= 1 / 255 else min(0.99, opacity)
    assert trace_surfel_radiance(*AXIS_RAY, scene, 0.0)[1].item() == pytest.approx(expected, rel=1e-4, abs=1e-9)
    assert transmittance(*AXIS_RAY, scene, 0.0).item() == pytest.approx(1 - expected, rel=1e-5)


def test_disc_ends_where_alpha_falls_below_the_cutoff():
    scene = scene_of(*stacked_discs([1.0], 0.8))
    edge = math.sqrt(2 * math.log(255 * 0.8))
    origins = torch.tensor([[edge * s * math.cos(a), edge * s * math.sin(a), 0.0] for a in (0.0, 0.7, 2.1) for s in (0.999, 1.001)])
    left = transmittance(origins, torch.tensor([[0.0, 0.0, 1.0]]).expand(6, 3).contiguous(), scene, 0.0)
    assert (left[::2] < 1).all() and (left[1::2] == 1).all()


def test_grazing_rays_stay_finite_and_match_the_twin():
    surfels = stacked_discs([0.0], 0.9)
    angles = torch.tensor([0.0, 1e-7, 1e-5, 2e-4, 1e-3, 1e-2], dtype=torch.float64)
    directions = torch.stack([angles.cos(), torch.zeros_like(angles), angles.sin()], -1)
    origins = -2.0 * directions + torch.tensor([0.0, 0.3, 0.0])
    inputs = [x.clone().requires_grad_() for x in surfels]
    scene = build_surfel_scene(posed(*inputs), torch.ones(1, 3))
    radiance, opacity, _ = trace_surfel_radiance(origins.float(), directions.float(), scene, 0.0)
    expected = twin.trace_surfel_radiance(origins, directions, *(x.double() for x in surfels), torch.ones(1, 3).double(), 0.0)
    torch.testing.assert_close(opacity.double(), expected[1], atol=2e-3, rtol=0)
    assert (opacity[:3] == 0).all() and (opacity[3:] > 0.5).all()
    radiance.sum().backward()
    assert all(torch.isfinite(x.grad).all() for x in inputs)


def test_degenerate_surfels_are_left_out():
    centers, tangents, opacities = stacked_discs([1.0, 2.0, 3.0, 4.0], 0.5)
    tangents[0, :, 1] = 2 * tangents[0, :, 0]
    tangents[1] = 0
    centers[2, 0] = torch.nan
    scene = scene_of(centers, tangents, opacities)
    assert scene.kept.tolist() == [3]
    assert transmittance(*AXIS_RAY, scene, 0.0).item() == pytest.approx(0.5)


def test_empty_scene_is_transparent():
    scene = scene_of(*stacked_discs([1.0], 0.001), torch.ones(1, 3).requires_grad_())
    radiance, opacity, depth = trace_surfel_radiance(*AXIS_RAY, scene, 0.0)
    assert radiance.abs().sum() == 0 and opacity.item() == 0 and math.isinf(depth.item())
    assert transmittance(*AXIS_RAY, scene, 0.0).item() == 1


def gradients(trace, inputs: list[torch.Tensor], weights: list[torch.Tensor]) -> list[torch.Tensor]:
    """Gradients of a fixed random combination of radiance, opacity and sum of weight times t."""
    leaves = [x.clone().requires_grad_() for x in inputs]
    radiance, opacity, weighted_t = trace(*leaves)
    loss = (weights[0] * radiance).sum() + (weights[1] * opacity).sum() + (weights[2] * weighted_t).sum()
    return list(torch.autograd.grad(loss, leaves))


def smooth_rays(surfels: tuple[torch.Tensor, ...], count: int, seed: int, t_min: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Rays none of whose hits stands on an edge of the gradient: cutoff, clamp, t_min, stop, or nearly equal t."""
    origins, directions = random_rays(count, seed)
    alpha, t = twin.meet_surfels(origins, directions, *surfels[:3])
    uncut, _ = twin.meet_surfels(origins, directions, *surfels[:3], min_alpha=0.0)
    uv_edge = (((uncut * 255 - 1).abs() < 0.05) | (uncut > twin.MAX_ALPHA - 1e-3)).any(1)
    hit_t = torch.where((alpha > 0) & (t > t_min), t, torch.inf).sort(1).values
    gaps = hit_t.diff(dim=1)
    close = (torch.where(torch.isfinite(gaps), gaps, torch.ones_like(gaps)) < 1e-5).any(1)
    before = torch.cumprod(torch.where(t.sort(1).values > t_min, 1 - alpha.gather(1, t.sort(1).indices), torch.ones_like(t)), 1)
    stop = ((before / twin.MIN_TRANSMITTANCE - 1).abs() < 1e-2).any(1)
    good = ~(uv_edge | close | stop | ((alpha > 0) & ((t - t_min).abs() < 1e-3)).any(1))
    return origins[good].contiguous(), directions[good].contiguous()


@pytest.mark.parametrize("constant", [False, True])
@pytest.mark.parametrize("count", [12, 120])
def test_every_gradient_matches_the_twin(count, constant):
    surfels = random_surfels(count, 7)
    if constant:
        surfels = (*surfels[:3], surfels[3][:, 0].abs())
    origins, directions = smooth_rays(surfels, 300, 8, 0.05)
    assert len(origins) > 100
    generator = torch.Generator().manual_seed(9)
    weights = [torch.randn(len(origins), *s, generator=generator, dtype=torch.float64) for s in ((3,), (), ())]
    expected = gradients(lambda *x: twin.trace_surfel_radiance(origins, directions, *x, 0.05), list(surfels), weights)

    def trace(centers, tangents, opacities, radiance):
        scene = build_surfel_scene(posed(centers, tangents, opacities), radiance)
        blended, opacity, depth = trace_surfel_radiance(origins.float(), directions.float(), scene, 0.05)
        return blended, opacity, torch.where(opacity > 0, depth * opacity, torch.zeros_like(opacity))

    got = gradients(trace, [x.float() for x in surfels], [w.float() for w in weights])
    for name, a, b in zip(("centers", "tangents", "opacities", "radiance"), got, expected, strict=True):
        assert b.abs().max() > 0, name
        error = (a.double() - b).norm() / b.norm()
        assert error < 1e-3, (name, error)
        assert (a.double() - b).abs().max() < 5e-3 * b.abs().max(), name


def test_twin_gradient_matches_finite_differences():
    surfels = random_surfels(5, 10)
    origins, directions = smooth_rays(surfels, 12, 11, 0.0)
    leaves = tuple(x.clone().requires_grad_() for x in (*surfels[:3], surfels[3][:, :4]))
    assert torch.autograd.gradcheck(lambda *x: twin.trace_surfel_radiance(origins, directions, *x, 0.0), leaves, atol=1e-5)


def test_gradient_is_that_of_the_tracer_itself_by_finite_differences():
    """In float32 and so coarse, but with nothing of the twin in it."""
    centers, tangents, opacities, sh = (x.float() for x in random_surfels(6, 12))
    origins, directions = (x.float() for x in smooth_rays(random_surfels(6, 12), 200, 13, 0.0))

    def loss(shift: torch.Tensor, stretch: torch.Tensor) -> torch.Tensor:
        scene = build_surfel_scene(posed(centers + shift, tangents * stretch, opacities), sh)
        radiance, opacity, _ = trace_surfel_radiance(origins, directions, scene, 0.0)
        return (radiance.double().sum(1) + opacity.double()).sum()

    shift, stretch = torch.zeros(6, 3, requires_grad=True), torch.ones(6, 1, 1, requires_grad=True)
    gradient = torch.autograd.grad(loss(shift, stretch), (shift, stretch))
    step = 3e-4
    for surfel in (0, 3):
        for leaf, place in ((0, (surfel, 1)), (1, (surfel, 0, 0))):
            moved = [torch.zeros(6, 3), torch.ones(6, 1, 1)]
            moved[leaf][place] += step
            ahead = loss(*moved)
            moved[leaf][place] -= 2 * step
            difference = ((ahead - loss(*moved)) / (2 * step)).item()
            assert gradient[leaf][place].item() == pytest.approx(difference, rel=0.02, abs=0.3)


def test_gradient_beyond_sixteen_hits_matches_the_twin():
    count = 40
    centers, tangents, opacities = (x.double() for x in stacked_discs([1 + k / 5 for k in range(count)], 0.06))
    colors = torch.rand(count, 3, generator=torch.Generator().manual_seed(14), dtype=torch.float64)
    origins, directions = torch.tensor([[0.2, -0.1, 0.0]], dtype=torch.float64), AXIS_RAY[1].double()
    weights = [torch.ones(1, 3, dtype=torch.float64), torch.ones(1, dtype=torch.float64), torch.full((1,), 0.3, dtype=torch.float64)]
    expected = gradients(
        lambda *x: twin.trace_surfel_radiance(origins, directions, *x, 0.0), [centers, tangents, opacities, colors], weights
    )

    def trace(*x):
        blended, opacity, depth = trace_surfel_radiance(origins.float(), directions.float(), build_surfel_scene(posed(*x[:3]), x[3]), 0.0)
        return blended, opacity, depth * opacity

    got = gradients(trace, [x.float() for x in (centers, tangents, opacities, colors)], [w.float() for w in weights])
    for a, b in zip(got, expected, strict=True):
        torch.testing.assert_close(a.double(), b, atol=2e-4, rtol=2e-3)


def test_clamped_opacity_and_negative_radiance_have_no_gradient():
    centers, tangents, opacities = stacked_discs([1.0, 2.0], 0.999)
    opacities[1] = 0.5
    leaves = [x.requires_grad_() for x in (centers, tangents, opacities, torch.full((2, 16, 3), -2.0))]
    scene = build_surfel_scene(posed(*leaves[:3]), leaves[3])
    radiance, opacity, _ = trace_surfel_radiance(*AXIS_RAY, scene, 0.0)
    (radiance.sum() + opacity.sum()).backward()
    assert leaves[2].grad[0] == 0 and leaves[2].grad[1] > 0
    assert leaves[3].grad.abs().sum() == 0


def test_results_and_gradients_are_the_same_bits_every_time_and_in_any_chunks(monkeypatch):
    surfels = [x.float() for x in random_surfels(200, 15)]
    origins, directions = (x.float() for x in random_rays(500, 16))
    weights = [torch.ones(500, 3), torch.ones(500), torch.zeros(500)]

    def run() -> list[torch.Tensor]:
        return gradients(
            lambda *x: (*trace_surfel_radiance(origins, directions, build_surfel_scene(posed(*x[:3]), x[3]), 0.0)[:2], torch.zeros(500)),
            surfels,
            weights,
        )

    first, second = run(), run()
    monkeypatch.setattr(sys.modules["drgs.render.intersect.tracer_surfels.tracer_surfels"], "HITS_PER_CHUNK", 97)
    chunked = run()
    for a, b, c in zip(first, second, chunked, strict=True):
        assert torch.equal(a, b)
        torch.testing.assert_close(a, c, atol=1e-5, rtol=1e-4)


def test_what_lies_behind_a_thousandth_of_the_light_still_counts():
    """The promise is MIN_TRANSMITTANCE, 1e-4: two discs leave 6e-4, of which the third takes its part."""
    scene = scene_of(*stacked_discs([1.0, 2.0, 3.0], 0.975), torch.eye(3))
    radiance, opacity, _ = trace_surfel_radiance(*AXIS_RAY, scene, 0.0)
    assert radiance[0, 2].item() == pytest.approx(0.025**2 * 0.975, rel=1e-4)
    assert 1 - opacity.item() == pytest.approx(0.025**3, rel=1e-2)


def test_radiance_of_a_wrong_shape_is_refused():
    with pytest.raises(ValueError, match=r"shape \(1, 5, 3\); expected \(1, 3\) or"):
        scene_of(*stacked_discs([1.0], 0.5), torch.ones(1, 5, 3))
