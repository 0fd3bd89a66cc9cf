"""The vectorised rasteriser, and the plain kernel that CUDA uses, against the float64 twin."""

import math

import pytest
import torch

from drgs.maths.frames import rotation_from_quat_wxyz
from drgs.reference.rasterize_gbuffer import look_at_camera
from drgs.reference.rasterize_gbuffer import rasterize as rasterize_reference
from drgs.render.visible.rasterize import RasterSettings, rasterize


def random_surfels(count, seed=0, spread=0.6, scale=0.15, channels=5):
    generator = torch.Generator().manual_seed(seed)
    rand = lambda *shape: torch.rand(*shape, generator=generator)  # noqa: E731
    centers = (rand(count, 3) - 0.5) * 2 * spread
    rotation = rotation_from_quat_wxyz(torch.randn(count, 4, generator=generator))
    tangents = rotation[:, :, :2] * (0.2 + rand(count, 1, 2)) * scale
    return centers, tangents, 0.05 + 0.9 * rand(count), rand(count, channels)


def assert_maps_close(maps, expected, tolerance=2e-5, outliers=0.0):
    for name in ("features", "coverage", "depth_sum"):
        difference = (getattr(maps, name).double().cpu() - getattr(expected, name)).abs()
        assert (difference > tolerance).double().mean() <= outliers, f"{name}: {difference.max():.2e}"


@pytest.mark.parametrize("per_pixel", [False, True])
@pytest.mark.parametrize("size", [(48, 32), (37, 51)])
def test_maps_equal_the_twin(per_pixel, size, device):
    surfels = random_surfels(60)
    camera = look_at_camera(*size, focal=70.0)
    settings = RasterSettings(median=True)
    expected = rasterize_reference(*(x.double() for x in surfels), camera, settings)
    maps = rasterize(*(x.to(device) for x in surfels), camera.to(device), settings, per_pixel=per_pixel)
    assert_maps_close(maps, expected)
    flips = (maps.median_depth.double().cpu() - expected.median_depth).abs() > 1e-4
    assert flips.double().mean() < 0.005  # T = 0.5 exactly at a rounding error


CASES = {
    "ordinary": {},
    "tile borders": {"spread": 0.05, "scale": 0.01},
    "sub-pixel (filter branch)": {"scale": 0.004},
    "huge": {"scale": 3.0, "count": 8},
    "opaque": {"opacity": 0.9999},
    "faint": {"opacity": 0.006},
    "edge-on": {"edge_on": True},
    "behind and around the camera": {"spread": 6.0, "scale": 0.5},
}


@pytest.mark.parametrize("per_pixel", [False, True])
@pytest.mark.parametrize("case", CASES)
def test_gradients_equal_the_twin(case, per_pixel, device):
    options = dict(CASES[case])
    edge_on, opacity, count = options.pop("edge_on", False), options.pop("opacity", None), options.pop("count", 30)
    centers, tangents, opacities, features = random_surfels(count, seed=3, **options)
    camera = look_at_camera(40, 36, focal=60.0)
    if opacity is not None:
        opacities = torch.full_like(opacities, opacity)
    if edge_on:  # tangent v along the viewing ray up to 1e-3: the plane is seen from its side
        view = torch.nn.functional.normalize(centers - camera.center_world, dim=-1)
        side = torch.nn.functional.normalize(torch.linalg.cross(view, torch.tensor([0.0, 0.0, 1.0]).expand_as(view)), dim=-1)
        tangents = torch.stack([side * 0.1, (view + 1e-3 * torch.linalg.cross(view, side)) * 0.1], -1)
    generator = torch.Generator().manual_seed(5)
    weights = [torch.randn(n, 36, 40, generator=generator) for n in (features.shape[1], 1, 1)]

    def loss(maps):
        parts = [maps.features, maps.coverage[None], maps.depth_sum[None]]
        return sum((w.to(p) * p).sum() for w, p in zip(weights, parts, strict=True))

    def gradients(function, dtype, where, **extra):
        inputs = [x.detach().to(where, dtype).requires_grad_(True) for x in (centers, tangents, opacities, features)]
        maps = function(*inputs, camera.to(where), **extra)
        return maps, [g.cpu() for g in torch.autograd.grad(loss(maps), inputs)]

    expected_maps, expected = gradients(rasterize_reference, torch.float64, "cpu")
    maps, actual = gradients(rasterize, torch.float32, device, per_pixel=per_pixel)
    # A pixel on the rim (alpha = 1/255, T = 1e-4, equal depths) may fall on the other side in float32.
    assert_maps_close(maps, expected_maps, tolerance=1e-3 if edge_on else 1e-4, outliers=0.003)
    for name, a, e in zip(("centers", "tangents", "opacities", "features"), actual, expected, strict=True):
        assert torch.isfinite(a).all(), name
        scale = e.abs().max().clamp(min=1e-6)
        error = ((a.double() - e).abs() / (e.abs() + 1e-2 * scale)).flatten()
        assert error.quantile(0.95) < 2e-3, f"{name}: {error.quantile(0.95):.1e}"
        assert error.median() < 1e-4, f"{name}: {error.median():.1e}"


def test_the_twins_gradient_is_that_of_finite_differences():
    surfels = [x.double().requires_grad_(True) for x in random_surfels(4, seed=8, spread=0.2, scale=0.3, channels=2)]
    camera = look_at_camera(6, 5, focal=9.0)

    def maps(*inputs):
        m = rasterize_reference(*inputs, camera, depth_origin=4.0)
        return m.features, m.coverage, m.depth_sum

    assert torch.autograd.gradcheck(maps, surfels, eps=1e-6, atol=1e-5)


def test_median_depth_passes_its_gradient_to_one_surfel():
    centers = torch.tensor([[0.0, 0.0, 0.0]], requires_grad=True)
    camera = look_at_camera(16, 16, focal=30.0)
    forward = camera.camera_from_world[2, :3]
    tangents = torch.stack([camera.camera_from_world[0, :3], camera.camera_from_world[1, :3]], -1)[None] * 0.5
    maps = rasterize(centers, tangents, torch.tensor([0.95]), torch.ones(1, 1), camera, RasterSettings(median=True))
    (gradient,) = torch.autograd.grad(maps.median_depth[8, 8], centers)
    torch.testing.assert_close(gradient[0], forward, atol=1e-4, rtol=0)


def test_a_surfel_facing_the_camera_shows_its_gaussian():
    camera = look_at_camera(33, 33, focal=40.0)
    tangents = torch.stack([camera.camera_from_world[0, :3], camera.camera_from_world[1, :3]], -1)[None] * 0.5
    maps = rasterize(torch.zeros(1, 3), tangents, torch.tensor([0.8]), torch.ones(1, 1), camera)
    pixel = camera.intrinsics @ (camera.camera_from_world @ torch.tensor([0.0, 0.0, 0.0, 1.0]))[:3]
    x, y = pixel[0] / pixel[2], pixel[1] / pixel[2]
    u = (20.5 - x) * 4.0 / 40.0 / 0.5
    v = (12.5 - y) * 4.0 / 42.0 / 0.5
    torch.testing.assert_close(maps.coverage[12, 20], 0.8 * torch.exp(-0.5 * (u * u + v * v)), rtol=1e-4, atol=0)
    depth = maps.depth_sum / maps.coverage.clamp(min=1e-6) + maps.depth_origin
    torch.testing.assert_close(depth[12, 20], torch.tensor(4.0), rtol=1e-5, atol=0)


def test_same_bits_whatever_the_number_of_threads(monkeypatch):
    surfels = [x.requires_grad_(True) for x in random_surfels(300, seed=2)]
    camera = look_at_camera(64, 48, focal=70.0)
    results = []
    for threads in ("1", "2"):
        monkeypatch.setenv("DRGS_THREADS", threads)
        maps = rasterize(*surfels, camera)
        results.append([maps.features, *torch.autograd.grad(maps.features.square().sum(), surfels)])
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))


def test_nothing_in_view_gives_empty_maps_and_zero_gradients():
    centers, tangents, opacities, features = random_surfels(5)
    centers = (centers + torch.tensor([50.0, 50.0, 50.0])).requires_grad_(True)
    maps = rasterize(centers, tangents, opacities, features, look_at_camera(20, 20, focal=30.0))
    assert maps.coverage.abs().max() == 0
    (gradient,) = torch.autograd.grad(maps.features.sum(), centers)
    assert gradient.abs().max() == 0


def test_surfels_that_are_not_numbers_are_not_drawn():
    centers, tangents, opacities, features = random_surfels(6)
    centers[0, 0], tangents[1, 0, 0], opacities[2] = math.nan, math.inf, math.nan
    maps = rasterize(centers, tangents, opacities, features, look_at_camera(32, 32, focal=40.0), RasterSettings(depth=False))
    expected = rasterize(
        centers[3:], tangents[3:], opacities[3:], features[3:], look_at_camera(32, 32, focal=40.0), RasterSettings(depth=False)
    )
    torch.testing.assert_close(maps.features, expected.features)


def test_too_many_channels_are_refused():
    centers, tangents, opacities, _ = random_surfels(3)
    with pytest.raises(ValueError, match="at most 48 feature channels"):
        rasterize(centers, tangents, opacities, torch.zeros(3, 49), look_at_camera(16, 16, focal=20.0))
