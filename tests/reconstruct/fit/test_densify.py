"""Surfels are added where gradients are large, within the budget, and Adam's memory stays with the surfel it belongs to."""

import math

import pytest
import torch

from drgs.maths.frames import rotation_from_quat_wxyz
from drgs.reconstruct.capture.initial_points import InitialPoints
from drgs.reconstruct.fit.adam import Adam
from drgs.reconstruct.fit.densify import DensifySettings, ScreenGradientStats, densify, reset_opacity
from drgs.reconstruct.fit.surfel_parameters import (
    SURFEL_GROUPS,
    LearningRates,
    divide_surfels,
    initial_parameters,
    keep_surfels,
    make_optimizer,
)
from tests.reconstruct.surfel_spheres import fibonacci_sphere
from tests.render.closed_form_scenes import front_camera

COUNT = 50


def fit_with_moments(count: int = COUNT) -> tuple[Adam, dict[str, torch.Tensor]]:
    """Surfels on a sphere after one step, in which the gradient of surfel i was i + 1 in every entry."""
    points = fibonacci_sphere(count)
    start = InitialPoints(points, points, torch.full((count, 3), 0.5), torch.zeros(3), 1.0, "hull", None, None)
    parameters = initial_parameters(start, torch.device("cpu"), seed=0)
    parameters["environment_8"] = torch.zeros(1, 3, 8, 16, requires_grad=True)
    optimizer = make_optimizer(parameters, LearningRates(), radius=1.0)
    step(optimizer, parameters)
    return optimizer, parameters


def step(optimizer: Adam, parameters: dict[str, torch.Tensor]) -> None:
    for value in parameters.values():
        number = torch.arange(1.0, 1 + len(value)).reshape(-1, *[1] * (value.dim() - 1))
        value.grad = number.expand_as(value).clone()
    optimizer.step()
    optimizer.zero_grad()


def gradients_largest_at(count: int, largest: list[int]) -> ScreenGradientStats:
    """All seen once; the largest gradients at `largest`."""
    gradients = ScreenGradientStats(torch.rand(count), torch.ones(count))
    gradients.total[largest] += 10.0
    return gradients


def roomy(**changes) -> DensifySettings:
    return DensifySettings(**{"growth": 0.1, "budget": 1000, "prune_opacity": 0.05, "prune_radius": 0.5} | changes)


def first_moment(optimizer: Adam, parameters: dict[str, torch.Tensor], name: str) -> torch.Tensor:
    return optimizer.state[parameters[name]]["exp_avg"]


def assert_sizes_agree(optimizer: Adam, parameters: dict[str, torch.Tensor], count: int) -> None:
    for group in optimizer.param_groups:
        value = group["params"][0]
        assert value is parameters[group["name"]] and value.requires_grad and value.is_leaf
        assert optimizer.state[value]["exp_avg"].shape == optimizer.state[value]["exp_avg_sq"].shape == value.shape
        if group["name"] in SURFEL_GROUPS:
            assert len(value) == count, group["name"]
    assert len(optimizer.state) == len(parameters)


@pytest.mark.slow
def test_the_largest_gradients_are_divided_and_the_budget_is_kept():
    optimizer, parameters = fit_with_moments()
    generator = torch.Generator().manual_seed(0)
    before = parameters["centers"].detach().clone()
    gradients = densify(optimizer, parameters, gradients_largest_at(COUNT, [7, 30]), roomy(budget=COUNT + 2), 1.0, generator)
    assert_sizes_agree(optimizer, parameters, COUNT + 2)
    moved = (parameters["centers"][:COUNT] != before).any(1).nonzero().flatten()
    assert moved.tolist() == [7, 30]
    assert float(gradients.total.abs().sum()) == 0.0 and gradients.total.shape == gradients.seen.shape == (COUNT + 2,)
    densify(optimizer, parameters, gradients_largest_at(COUNT + 2, [3]), roomy(budget=COUNT + 2), 1.0, generator)
    assert len(parameters["centers"]) == COUNT + 2


def test_a_round_grows_by_its_share_at_most():
    optimizer, parameters = fit_with_moments()
    densify(optimizer, parameters, gradients_largest_at(COUNT, []), roomy(growth=0.2), 1.0, torch.Generator())
    assert_sizes_agree(optimizer, parameters, COUNT + 10)


def test_gradients_are_compared_by_their_mean_over_the_views_that_saw_the_surfel():
    optimizer, parameters = fit_with_moments()
    before = parameters["centers"].detach().clone()
    gradients = ScreenGradientStats(torch.ones(COUNT), torch.ones(COUNT))
    gradients.total[5], gradients.seen[5] = 20.0, 30.0  # seen often, small gradients
    gradients.total[9] = 3.0
    densify(optimizer, parameters, gradients, roomy(budget=COUNT + 1), 1.0, torch.Generator())
    assert (parameters["centers"][:COUNT] != before).any(1).nonzero().flatten().tolist() == [9]


def test_faint_huge_unseen_and_broken_surfels_vanish():
    optimizer, parameters = fit_with_moments()
    with torch.no_grad():
        parameters["opacity_logits"][3] = -5.0
        parameters["log_scales"][11, 0] = math.log(0.7)
        parameters["centers"][20, 1] = math.nan
    gradients = gradients_largest_at(COUNT, [3])
    gradients.seen[40] = 0
    gone = [3, 11, 20, 40]
    kept = [i for i in range(COUNT) if i not in gone]
    moments = first_moment(optimizer, parameters, "albedo_logits").clone()
    centers = parameters["centers"].detach().clone()
    densify(optimizer, parameters, gradients, roomy(growth=0.0), 1.0, torch.Generator())
    assert_sizes_agree(optimizer, parameters, COUNT - 4)
    assert torch.equal(parameters["centers"].detach(), centers[kept])
    assert torch.equal(first_moment(optimizer, parameters, "albedo_logits"), moments[kept])


def test_moments_follow_their_surfel_and_a_twin_starts_without():
    optimizer, parameters = fit_with_moments()
    expected = first_moment(optimizer, parameters, "quats").clone()
    assert float(expected[10, 0]) > float(expected[9, 0]) > 0  # surfels can be told apart by their moments
    divide_surfels(optimizer, parameters, torch.tensor([10, 4]), torch.Generator().manual_seed(1))
    moments = first_moment(optimizer, parameters, "quats")
    assert torch.equal(moments[:COUNT], expected)
    assert float(moments[COUNT:].abs().max()) == 0.0
    keep_surfels(optimizer, parameters, torch.arange(COUNT + 2) != 0)
    assert torch.equal(first_moment(optimizer, parameters, "quats")[: COUNT - 1], expected[1:])
    before = parameters["centers"].detach().clone()
    step(optimizer, parameters)  # the optimizer goes on with the new tensors
    assert float((parameters["centers"].detach() - before).abs().min()) > 0


def test_halves_lie_on_the_longer_axis_and_cover_what_the_surfel_covered():
    optimizer, parameters = fit_with_moments()
    with torch.no_grad():
        parameters["log_scales"][5] = torch.tensor([-3.0, -1.0])
    center, quat = parameters["centers"][5].detach().clone(), parameters["quats"][5].detach()
    divide_surfels(optimizer, parameters, torch.tensor([5]), torch.Generator().manual_seed(0))
    a, b = parameters["centers"][5].detach(), parameters["centers"][COUNT].detach()
    torch.testing.assert_close((a + b) / 2, center)
    apart = torch.nn.functional.normalize(b - a, dim=0)
    assert abs(float(apart @ rotation_from_quat_wxyz(quat)[:, 1])) > 0.9999
    scales = parameters["log_scales"].detach().exp()[[5, COUNT]]
    torch.testing.assert_close(scales[0], scales[1])
    torch.testing.assert_close(scales[0, 0], torch.tensor(-3.0).exp())
    # The mixture of both halves is about as long as the whole was: variance = within + between.
    length = math.exp(-1.0)
    assert abs(math.sqrt(float(scales[0, 1] ** 2 + ((b - a).norm() / 2) ** 2)) / length - 1) < 0.15
    for name in ("quats", "opacity_logits", "albedo_logits", "roughness_logits", "metallic_logits", "sh_dc", "sh_rest"):
        assert torch.equal(parameters[name][5], parameters[name][COUNT]), name


def test_division_is_the_same_for_the_same_generator():
    centers = []
    for seed in (1, 1, 2):
        optimizer, parameters = fit_with_moments()
        divide_surfels(optimizer, parameters, torch.arange(20), torch.Generator().manual_seed(seed))
        centers.append(parameters["centers"].detach())
    assert torch.equal(centers[0], centers[1]) and not torch.equal(centers[0], centers[2])


def test_resetting_opacity_lowers_the_opaque_and_forgets_their_momentum():
    optimizer, parameters = fit_with_moments()
    with torch.no_grad():
        parameters["opacity_logits"][0] = -4.0
    others = first_moment(optimizer, parameters, "centers").clone()
    reset_opacity(optimizer, parameters, ceiling=0.1)
    opacity = torch.sigmoid(parameters["opacity_logits"].detach())
    torch.testing.assert_close(opacity[1:], torch.full((COUNT - 1,), 0.1))
    torch.testing.assert_close(opacity[0], torch.sigmoid(torch.tensor(-4.0)))
    assert float(first_moment(optimizer, parameters, "opacity_logits").abs().max()) == 0.0
    assert torch.equal(first_moment(optimizer, parameters, "centers"), others)


def test_the_gradient_counts_across_the_screen_in_shares_of_the_image_width():
    found = []
    for size in (32, 64):
        camera = front_camera(size, distance=4.0)  # looks along +y
        stats = ScreenGradientStats.zeros(3, torch.device("cpu"))
        centers = torch.zeros(3, 3)
        # Pixels a world unit at the origin are focal / 4; the loss falls by 1 a pixel to the right, and along the view for surfel 1.
        focal = float(camera.intrinsics[0, 0])
        gradients = torch.tensor([[focal / 4, 0, 0], [0, focal / 4, 0], [0, 0, 0]]) / size  # a loss by shares of the image
        stats.add(centers, gradients, camera)
        found.append(stats)
    assert torch.allclose(found[0].total, found[1].total)  # whatever the image's size
    assert float(found[0].total[0]) == 1.0 and found[0].total[1:].tolist() == [0.0, 0.0]
    assert found[0].seen.tolist() == [1.0, 0.0, 0.0]
