"""The filter against its twin, and what it must and must not do to a picture."""

import dataclasses

import pytest
import torch

from drgs.reference import denoise as reference
from drgs.reference.denoise import reflectances
from drgs.render.film.denoise import denoise
from drgs.render.film.denoise.svgf import MOVING, FilterSettings, denoise_svgf, filter_pixels, filter_sixteen_pixels, settings_for
from drgs.render.records import DemodulatedLight, GBuffer, Radiance, RenderSettings
from drgs.render.render_frame import render_frame
from drgs.render.visible.trace_primary import trace_primary
from drgs.scene.posed_scene import PosedScene
from tests.render.closed_form_scenes import front_camera, sphere_mesh, sunny_sky

CAMERA = front_camera(40)


def noisy_radiance(gbuffer: GBuffer, deviation: float) -> Radiance:
    """Light of 1 times the textures, with independent noise whose variance is told."""
    factors = reflectances(gbuffer)
    size = gbuffer.coverage.shape
    parts = [f * (1 + deviation * torch.randn(*size, 1)) for f in factors]
    variances = [deviation**2 * f.square().mean(-1) for f in factors]
    return Radiance(*parts, variances[0], torch.ones(size), 1, *variances)


@pytest.mark.parametrize("moving", [False, True])
def test_kernel_filters_as_the_reference_does(moving: bool, device: str) -> None:
    gbuffer = trace_primary(sphere_mesh(3), CAMERA)
    noisy = noisy_radiance(gbuffer, 0.3)
    there = GBuffer(**{f.name: getattr(gbuffer, f.name).to(device) for f in dataclasses.fields(gbuffer)})
    values = {f.name: getattr(noisy, f.name) for f in dataclasses.fields(noisy)}
    moved = Radiance(**{k: v.to(device) if isinstance(v, torch.Tensor) else v for k, v in values.items()})
    ours = denoise(moved, there, CAMERA, "svgf", moving)
    settings = MOVING if moving else settings_for(moved.samples)
    factors = [f.double() for f in reflectances(gbuffer)]
    exact = GBuffer(**{f.name: getattr(gbuffer, f.name).double() for f in dataclasses.fields(gbuffer)})
    parts = (noisy.diffuse.double() / factors[0], noisy.specular.double() / factors[1])
    variance = torch.full((40, 40, 2), 0.3**2, dtype=torch.float64)
    sigmas = settings.sigma_luminance, settings.neighbour_variance
    for level in range(settings.levels):
        parts, variance = reference.filter_level(parts, variance, exact, 1 / float(CAMERA.intrinsics[0, 0]), 1 << level, *sigmas)
    covered = gbuffer.coverage > 0
    torch.testing.assert_close(ours.diffuse.cpu()[covered].double(), (parts[0] * factors[0])[covered], atol=1e-4, rtol=1e-3)
    torch.testing.assert_close(ours.specular.cpu()[covered].double(), (parts[1] * factors[1])[covered], atol=1e-4, rtol=1e-3)


@pytest.mark.parametrize(("size", "far"), [(40, 0.0), (7, 0.0), (40, 1000.0)])
def test_sixteen_pixels_at_once_are_the_pixels_one_by_one(size: int, far: float) -> None:
    camera = front_camera(size)
    gbuffer = trace_primary(sphere_mesh(3), camera)
    gbuffer = dataclasses.replace(gbuffer, position_world=gbuffer.position_world + far)
    light = DemodulatedLight(torch.rand(size, size, 3), torch.rand(size, size, 3), 0.1 * torch.rand(size, size, 2))
    covered = gbuffer.coverage > 0
    footprint = 1 / float(camera.intrinsics[0, 0])
    one_by_one, at_once = (
        filter_all(light, gbuffer, footprint, FilterSettings(5)) for filter_all in (filter_pixels, filter_sixteen_pixels)
    )
    for name in ("diffuse", "specular", "variance"):
        torch.testing.assert_close(getattr(one_by_one, name)[covered], getattr(at_once, name)[covered], atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("most_kept", [1 << 24, 0])
def test_a_picture_knows_nothing_of_the_one_before_it(most_kept: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Planes are kept from picture to picture, of the same size and of others, but for those that are given away."""
    monkeypatch.setattr("drgs.render.film.denoise.planes.MOST_KEPT_NUMBERS", most_kept)
    gbuffer, footprint, settings = trace_primary(sphere_mesh(3), CAMERA), 1 / float(CAMERA.intrinsics[0, 0]), FilterSettings(3)
    size = tuple(gbuffer.coverage.shape)
    light = DemodulatedLight(torch.rand(*size, 3), torch.rand(*size, 3), 0.1 * torch.rand(*size, 2))
    first = filter_sixteen_pixels(light, gbuffer, footprint, settings)
    kept = first.diffuse.clone()
    for narrower in (0, 11):
        inside = {name: values[:, narrower:].contiguous() for name, values in vars(gbuffer).items()}
        inside["coverage"] = torch.ones_like(inside["coverage"])
        nonsense = DemodulatedLight(*(torch.full_like(values[:, narrower:], torch.nan) for values in vars(light).values()))
        filter_sixteen_pixels(nonsense, GBuffer(**inside), footprint, settings)
        again = filter_sixteen_pixels(light, gbuffer, footprint, settings)
        assert torch.equal(first.diffuse, kept)
        for name in ("diffuse", "specular", "variance"):
            assert torch.equal(getattr(first, name), getattr(again, name))


def test_independent_noise_falls_and_the_mean_stays() -> None:
    gbuffer = trace_primary(sphere_mesh(4), CAMERA)
    noisy = noisy_radiance(gbuffer, 0.3)
    covered = gbuffer.coverage > 0
    factor = reflectances(gbuffer)[0]
    before, after = ((r.diffuse / factor)[covered] - 1 for r in (noisy, denoise_svgf(noisy, gbuffer, CAMERA)))
    assert float(after.square().mean()) < 0.2 * float(before.square().mean())
    assert abs(float(after.mean() - before.mean())) < 0.01


def test_a_picture_without_variance_is_left_alone() -> None:
    gbuffer = trace_primary(sphere_mesh(3), CAMERA)
    checkered = noisy_radiance(gbuffer, 0.5)
    zero = torch.zeros_like(gbuffer.coverage)
    told_exact = dataclasses.replace(checkered, diffuse_variance=zero, specular_variance=zero)
    covered = gbuffer.coverage > 0
    torch.testing.assert_close(denoise_svgf(told_exact, gbuffer, CAMERA).diffuse[covered], checkered.diffuse[covered], atol=1e-4, rtol=0)


def test_light_does_not_cross_a_silhouette_or_a_fold() -> None:
    """Left half faces left and is black, right half faces right and is white; noise is said to be huge."""
    gbuffer = trace_primary(sphere_mesh(3), CAMERA)
    size = (40, 40)
    left = (torch.arange(40) < 20).expand(size)
    normal = torch.where(left[..., None], torch.tensor([-0.8, -0.6, 0.0]), torch.tensor([0.8, -0.6, 0.0])).expand(40, 40, 3).contiguous()
    folded = dataclasses.replace(
        gbuffer,
        coverage=torch.ones(size),
        depth=torch.full(size, 4.0),
        normal_world=normal,
        position_world=torch.zeros(40, 40, 3),
        albedo=torch.ones(40, 40, 3),
    )
    white = torch.where(left, 0.0, 1.0)[..., None].expand(40, 40, 3).contiguous()
    huge = torch.full(size, 100.0)
    filtered = denoise_svgf(Radiance(white, white, huge, torch.ones(size), 1, huge, huge), folded, CAMERA)
    assert float(filtered.diffuse[left].max()) < 1e-3 and float(filtered.diffuse[~left].min()) > 1 - 1e-3


@pytest.mark.slow
def test_denoised_frames_are_nearer_to_the_truth_and_approach_it() -> None:
    scene = PosedScene(None, sphere_mesh(4), sunny_sky(sun=20.0))
    exact = render_frame(scene, CAMERA, RenderSettings(samples_per_pixel=2048, bounces=0, seed=7))
    inside = exact.gbuffer.coverage == 1
    errors = {}
    for samples in (8, 512):
        for method in ("none", "svgf"):
            frame = render_frame(scene, CAMERA, RenderSettings(samples_per_pixel=samples, bounces=0, denoise=method))
            errors[samples, method] = float((frame.radiance_linear - exact.radiance_linear)[inside].square().mean())
    assert errors[8, "svgf"] < 0.5 * errors[8, "none"]
    assert errors[512, "svgf"] < 0.25 * errors[8, "svgf"]


def test_a_denoiser_that_is_not_there_is_named() -> None:
    gbuffer = trace_primary(sphere_mesh(1), CAMERA)
    with pytest.raises(ValueError, match="'median' is unknown; expected none, svgf or oidn"):
        denoise(noisy_radiance(gbuffer, 0.1), gbuffer, CAMERA, "median")  # type: ignore[arg-type]


def test_fewer_rounds_are_run_the_more_is_known() -> None:
    rounds = [settings_for(samples).levels for samples in (1, 8, 32, 64, 4096)]
    assert rounds[1:] == sorted(rounds[1:], reverse=True) and rounds[0] > rounds[2] > rounds[3] >= 1
