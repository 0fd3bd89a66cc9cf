"""Fitting's loss terms against scikit-image, closed forms and what their gradients must do."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from skimage.metrics import structural_similarity

from drgs.maths.color import linear_from_srgb
from drgs.reconstruct.fit.losses import (
    crossed_halves,
    crossed_squares,
    display_image,
    edge_aware_smoothness,
    mask_loss,
    rough_light,
    structural_dissimilarity,
    texel_areas,
    white_light,
)
from drgs.reconstruct.fit.normal_consistency import normal_consistency
from drgs.reconstruct.fit.similarity import RADIUS, similarity_by_matrices
from drgs.reference.normal_consistency import normal_consistency as specified_consistency
from drgs.reference.normal_consistency import normals_from_depth
from drgs.scene.camera import Camera, pixel_rays_world
from tests.render.closed_form_scenes import front_camera


def skimage_similarity(a: torch.Tensor, b: torch.Tensor) -> np.ndarray:
    """(height, width, 3) map at the settings that benchmarks score with."""
    return structural_similarity(
        a.double().numpy(), b.double().numpy(), gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=1, channel_axis=2, full=True
    )[1]  # fmt: skip


def test_dissimilarity_equals_scikit_image_inside_a_black_frame():
    # A frame wider than the window on black makes borders alike: zero padding and reflection see the same zeros.
    generator = torch.Generator().manual_seed(0)
    a, b = torch.zeros(44, 52, 3), torch.zeros(44, 52, 3)
    inside = (slice(RADIUS * 2, -RADIUS * 2), slice(RADIUS * 2, -RADIUS * 2))
    a[inside] = torch.rand(*a[inside].shape, generator=generator)
    b[inside] = (a[inside] + 0.3 * torch.randn(*a[inside].shape, generator=generator)).clamp(0, 1)
    expected = (1 - skimage_similarity(a, b).mean()) / 2
    assert 0.05 < expected < 0.5
    assert float(structural_dissimilarity(a, b)) == pytest.approx(expected, abs=1e-5)


def test_equal_images_are_not_dissimilar():
    image = torch.rand(20, 30, 3)
    assert float(structural_dissimilarity(image, image)) == pytest.approx(0.0, abs=1e-6)


def test_dissimilaritys_gradient_is_that_of_finite_differences():
    a, b, direction = (torch.rand(9, 7, 3, dtype=torch.float64) for _ in range(3))
    (gradient,) = torch.autograd.grad(structural_dissimilarity(a.requires_grad_(True), b), a)
    with torch.no_grad():
        ahead, behind = (float(structural_dissimilarity(a + step * direction, b)) for step in (1e-6, -1e-6))
    assert float((gradient * direction).sum()) == pytest.approx((ahead - behind) / 2e-6, rel=1e-5)


@pytest.mark.parametrize(("height", "width"), [(43, 37), (11, 3), (3, 100), (30, 80), (12, 170)])
def test_dissimilarity_by_rows_is_that_by_matrices_with_its_gradient(height: int, width: int):
    generator = torch.Generator().manual_seed(height)
    photo = torch.rand(height, width, 3, generator=generator)
    image = (photo + 0.2 * torch.randn(height, width, 3, generator=generator)).requires_grad_(True)
    exact = image.detach().double().requires_grad_(True)
    found, expected = structural_dissimilarity(image, photo), (1 - similarity_by_matrices(exact, photo.double())) / 2
    assert float(found.detach()) == pytest.approx(float(expected.detach()), abs=3e-7)
    (3 * found).backward()
    (3 * expected).backward()
    torch.testing.assert_close(image.grad.double(), exact.grad, atol=2e-6 * float(exact.grad.abs().max()), rtol=0)


def turned_camera() -> Camera:
    """front_camera seen from elsewhere, with unequal focal lengths and a shifted middle."""
    camera = front_camera(size=96, distance=4.0)
    turn = torch.linalg.matrix_exp(torch.tensor([[0.0, -0.4, 0.2], [0.4, 0.0, -0.3], [-0.2, 0.3, 0.0]]))
    pose = camera.camera_from_world.clone()
    pose[:3, :3] = pose[:3, :3] @ turn
    intrinsics = camera.intrinsics @ torch.diag(torch.tensor([1.0, 1.1, 1.0]))
    intrinsics[0, 2] += 5
    return Camera(pose, intrinsics, 96, 90)


def depth_of(camera: Camera, distance: torch.Tensor, directions: torch.Tensor) -> torch.Tensor:
    return distance * (directions @ camera.camera_from_world[2, :3])


def test_normals_of_a_planes_depth_are_the_planes():
    camera = turned_camera()
    origin, directions = pixel_rays_world(camera)
    normal = torch.nn.functional.normalize(torch.tensor([0.3, -0.5, 0.2]) - 0.7 * camera.camera_from_world[2, :3], dim=0)
    distance = -(origin @ normal + 0.1) / (directions @ normal)
    assert float(distance.min()) > 0
    found = normals_from_depth(depth_of(camera, distance, directions), camera)
    facing = normal if float(normal @ directions[45, 48]) < 0 else -normal
    torch.testing.assert_close(found[1:-1, 1:-1], facing.expand(88, 94, 3), atol=3e-3, rtol=0)
    torch.testing.assert_close(found.norm(dim=-1), torch.ones(90, 96))


def test_normals_of_a_spheres_depth_are_the_spheres():
    camera = turned_camera()
    origin, directions = pixel_rays_world(camera)
    b = directions @ origin
    discriminant = b * b - (origin @ origin - 1)
    inside = discriminant > 0.15  # away from the outline, where depth is steep
    distance = -b - discriminant.clamp(min=0).sqrt()
    normal = origin + distance[..., None] * directions
    found = normals_from_depth(depth_of(camera, distance, directions), camera)
    away = 1 - (found * normal).sum(-1)[inside]
    assert int(inside.sum()) > 500
    assert math.degrees(math.acos(1 - float(away.max()))) < 2.0


def test_surfels_that_lie_in_the_surface_they_draw_cost_nothing_and_gradients_reach_both():
    camera = turned_camera()
    facing = -camera.camera_from_world[2, :3]
    depth = torch.full((90, 96), 4.0).requires_grad_(True)
    normal = facing.expand(90, 96, 3).contiguous()
    flat = normal_consistency(normal, depth.detach(), torch.ones(90, 96), camera)
    assert float(flat) == pytest.approx(0.0, abs=1e-5)
    tilted = torch.nn.functional.normalize(normal + 0.3 * camera.camera_from_world[0, :3], dim=-1).requires_grad_(True)
    coverage = torch.zeros(90, 96)
    coverage[20:60, 30:70] = 1.0
    loss = normal_consistency(tilted, depth, coverage, camera)
    loss.backward()
    assert float(loss.detach()) == pytest.approx(1 - 1 / math.sqrt(1.09), rel=1e-3)
    assert float(tilted.grad.abs().max()) > 0 and float(depth.grad.abs().max()) > 0
    assert float(tilted.grad[:20].abs().max()) == 0.0  # outside the covered part nothing is compared
    assert float(tilted.grad[20, 30:70].abs().max()) == 0.0  # nor on its rim, where depth belongs to two surfaces


@pytest.mark.parametrize("solid", ["all", "a part up to two borders", "none"])
def test_normals_are_compared_as_the_specification_says_and_gradients_are_its(solid: str):
    camera = turned_camera()
    generator = torch.Generator().manual_seed(3)
    normal, depth = torch.randn(90, 96, 3, generator=generator), 4 + 0.02 * torch.randn(90, 96, generator=generator)
    coverage = {"all": torch.ones, "none": torch.zeros}.get(solid, torch.zeros)(90, 96)
    if solid not in ("all", "none"):
        coverage[:50, 40:] = torch.rand(50, 56, generator=generator) + 0.45
    exact = replace(camera, intrinsics=camera.intrinsics.double(), camera_from_world=camera.camera_from_world.double())
    results = []
    for view, of, dtype in ((camera, normal_consistency, torch.float32), (exact, specified_consistency, torch.float64)):
        maps = [x.to(dtype).clone().requires_grad_(True) for x in (normal, depth)]
        loss = of(*maps, coverage.to(dtype), view)
        (2 * loss).backward()
        results.append([x.double() for x in (loss.detach(), *(x.grad for x in maps))])
    assert (float(results[1][0]) > 0.1) == (solid != "none")
    for found, expected in zip(*results, strict=True):
        torch.testing.assert_close(found, expected, atol=1e-5 * float(expected.abs().max()), rtol=0)


def gradient_of_display(radiance: float, photo: float) -> float:
    value = torch.full((1, 1, 3), radiance, requires_grad=True)
    display_image(value, torch.ones(1, 1), torch.full((1, 1, 3), photo)).sum().backward()
    return float(value.grad[0, 0, 0])


def test_overexposure_is_neither_punished_nor_rewarded_where_the_photo_is_saturated():
    assert gradient_of_display(radiance=3.0, photo=1.0) == 0.0
    assert gradient_of_display(radiance=0.5, photo=1.0) > 0.1
    assert gradient_of_display(radiance=3.0, photo=0.8) > 0.05
    assert gradient_of_display(radiance=0.5, photo=0.8) > 0.1


def test_an_image_is_shown_in_srgb_times_its_coverage():
    srgb = torch.rand(4, 5, 3)
    coverage = torch.rand(4, 5)
    torch.testing.assert_close(display_image(linear_from_srgb(srgb), coverage, 0.5 * srgb), srgb * coverage[..., None], atol=1e-5, rtol=0)


def test_mask_loss_is_least_at_the_mask_and_finite_at_its_opposite():
    mask = (torch.rand(12, 12) > 0.5).float()
    right, wrong = mask_loss(mask, mask), mask_loss(1 - mask, mask)
    assert float(right) < 1e-3 < 1.0 < float(wrong) < 10.0


def test_smoothness_counts_steps_between_solid_pixels_only_and_less_at_the_photos_edges():
    maps, photo, solid = torch.zeros(10, 10, 2), torch.zeros(10, 10, 3), torch.ones(10, 10)
    maps[:, 5:] = 1.0
    plain = float(edge_aware_smoothness(maps, photo, solid))
    assert plain == pytest.approx(10 / 100)  # ten steps of 1 over a hundred solid pixels
    photo[:, 5:] = 0.5
    assert float(edge_aware_smoothness(maps, photo, solid)) == pytest.approx(plain * math.exp(-4), rel=1e-4)
    solid[:, 5] = 0.0
    assert float(edge_aware_smoothness(maps, photo, solid)) == 0.0


def test_grey_light_is_white_at_any_brightness_and_coloured_light_is_not():
    grey = torch.rand(16, 32, 1).expand(16, 32, 3) + 0.1
    assert float(white_light(grey)) == pytest.approx(0.0, abs=1e-6)
    red = grey * torch.tensor([2.0, 0.5, 0.5])
    assert float(white_light(red)) == pytest.approx(2 / 3, rel=1e-4)  # (|2 - 1| + 2 |0.5 - 1|) / 3
    assert float(white_light(100 * red)) == pytest.approx(float(white_light(red)), rel=1e-4)


def test_that_light_is_white_makes_it_no_dimmer():
    random = torch.rand(16, 32, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64) + 0.1
    brightness = torch.ones(16, 32, 1, dtype=torch.float64, requires_grad=True)
    white_light(random * brightness).backward()
    assert brightness.grad is not None and float(brightness.grad.abs().max()) < 1e-12


def test_texels_share_the_sphere_and_those_at_the_poles_count_less():
    areas = texel_areas(torch.zeros(16, 32, 3))
    assert float(areas.sum() * 32) == pytest.approx(1.0, rel=1e-5)
    colour = torch.ones(16, 32, 3)
    pole, equator = colour.clone(), colour.clone()
    pole[0, 3, 0] = equator[8, 3, 0] = 2.0
    assert float(white_light(pole)) < 0.2 * float(white_light(equator))


def test_even_light_is_not_rough_and_a_step_counts_the_same_at_the_seam_and_at_any_brightness():
    even = torch.full((8, 16, 3), 0.3)
    assert float(rough_light(even)) == 0.0
    middle, seam = even.clone(), even.clone()
    middle[3, 7] = 0.6
    seam[3, 15] = 0.6
    assert float(rough_light(middle)) > 0
    assert float(rough_light(seam)) == pytest.approx(float(rough_light(middle)))
    assert float(rough_light(100 * middle)) == pytest.approx(float(rough_light(middle)), rel=1e-4)


def test_the_gradient_of_crossed_halves_does_not_lean_towards_low_variance():
    # An estimate of 1 with noise in proportion to its parameter: with one set for value and derivative the gradient of |estimate - 1| is
    # the noise's mean size; with crossed sets it is 0 in the mean.
    generator = torch.Generator().manual_seed(0)
    noise = torch.randn(2, 200_000, 3, generator=generator)
    spread = torch.tensor(0.3, requires_grad=True)
    photo = torch.ones(200_000, 3)
    halves = [1 + spread * noise[k] for k in (0, 1)]
    (crossed,) = torch.autograd.grad(crossed_halves(*halves, photo), spread, retain_graph=True)
    (plain,) = torch.autograd.grad((halves[0] - photo).abs().mean(), spread)
    assert abs(float(crossed)) < 0.01 < 0.7 < float(plain)


def test_the_value_of_crossed_halves_is_the_error_of_their_mean():
    halves = [torch.full((4, 3), value, requires_grad=True) for value in (0.2, 0.6)]
    loss = crossed_halves(*halves, torch.full((4, 3), 0.5)).detach()
    assert abs(float(loss) - 0.1) < 1e-6


def test_crossed_squares_do_not_count_noise():
    generator = torch.Generator().manual_seed(0)
    noise = 0.3 * torch.randn(2, 200_000, 3, generator=generator)
    photo = torch.full((200_000, 3), 0.5)
    first, second = (0.6 + noise[k] for k in (0, 1))
    assert abs(float(crossed_squares(first, second, photo).mean()) - 0.01) < 1e-3
    assert float((first - photo).square().mean()) > 0.09
