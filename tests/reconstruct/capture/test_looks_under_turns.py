"""Under light that turns, what paint and shadows look like is taken out of the looks of places: by a light that is found, and of what is left a little by slopes."""

import math

import numpy as np
import pytest
import torch
import trimesh
from torch import Tensor

from drgs.maths.color import srgb_from_linear
from drgs.maths.spherical_harmonics import sh_basis
from drgs.reconstruct.capture.looks_under_turns import (
    HELD,
    SENT_BACK,
    as_if_still,
    irradiance_by_harmonics,
    light_of_looks,
    turned_harmonics,
    unexplained_looks,
)
from drgs.reconstruct.fit.light.split_sum import ENVIRONMENT_SIZE, filter_environment
from drgs.reconstruct.fit.light.turned_light import seen_sky
from drgs.render.intersect.tracer import AbstractTracer
from tests.reconstruct.capture.test_find_hollows import tracer_of
from tests.reconstruct.fit.light.test_turned_light import share_twin


def turns_of(count: int, seed: int = 0) -> Tensor:
    """Rotations by chance."""
    turns = torch.linalg.qr(torch.randn(count, 3, 3, generator=torch.Generator().manual_seed(seed)))[0]
    return turns * torch.linalg.det(turns).sign()[:, None, None]


def plate_and_balls() -> AbstractTracer:
    """Shadows everywhere on the plate."""
    balls = [trimesh.creation.icosphere(2, radius=0.3) for _ in range(3)]
    for ball, place in zip(balls, ((0.45, 0, 0.3), (-0.3, 0.4, 0.3), (-0.3, -0.4, 0.3)), strict=True):
        ball.apply_translation(place)
    plate = trimesh.creation.box((2, 2, 0.1)).subdivide().subdivide().subdivide().subdivide()
    plate.apply_translation((0, 0, -0.06))
    return tracer_of(trimesh.util.concatenate([plate, *balls]))


SKY = torch.tensor([1.0, 0.25, 0.3, -0.2, 0.1, -0.1, 0.05, 0.1, 0.1, 0, 0, 0, 0, 0, 0, 0])[:, None] * torch.tensor([3.8, 3.5, 3.2])
"""Harmonics of a light that is nowhere black."""


def looks(surface: AbstractTracer, paint: Tensor, turns: Tensor) -> Tensor:
    """SRGB of all vertices in all views, by what arrives there."""
    return srgb_from_linear((paint * (irradiance_by_harmonics(seen_sky(surface)) @ (turned_harmonics(turns) @ SKY))).clamp(0, 1))


def test_turned_harmonics_are_those_of_the_turned_light() -> None:
    turns, direction = turns_of(4), torch.nn.functional.normalize(torch.randn(50, 3, generator=torch.Generator().manual_seed(1)), dim=-1)
    in_world = sh_basis(direction) @ turned_harmonics(turns)
    torch.testing.assert_close(in_world, sh_basis(direction @ turns.mT), atol=1e-4, rtol=0)


def test_a_ball_alone_gets_the_cosine_lobes_share_of_each_degree() -> None:
    ball = tracer_of(trimesh.creation.icosphere(3))
    found = irradiance_by_harmonics(seen_sky(ball))
    by_degree = torch.tensor([1.0, *[2 / 3] * 3, *[1 / 4] * 5, *[0.0] * 7])  # over pi (Ramamoorthi and Hanrahan 2001)
    torch.testing.assert_close(found, sh_basis(ball.mesh.normals) * by_degree, atol=0.02, rtol=0)


def test_shadows_and_what_is_sent_back_are_those_of_whole_matrices() -> None:
    """Of the even part."""
    sky = seen_sky(plate_and_balls())
    found, count = irradiance_by_harmonics(sky)[:, :1], len(sky.coarse.normals)
    even = filter_environment(torch.ones(*ENVIRONMENT_SIZE, 3))
    share = share_twin(sky, torch.full((count, 3), SENT_BACK), even, torch.eye(3), by_table=False)[:, :1]
    cosines = (sky.coarse.normals @ sky.coarse.directions.T).clamp(min=0).double()
    open_sky = cosines.sum(1, keepdim=True) * (4 / len(sky.coarse.directions)) * float(sh_basis(sky.coarse.directions[0], 0))
    torch.testing.assert_close(found.double(), open_sky * share, atol=1e-5, rtol=0)
    assert float(share.min()) < 0.6


def test_light_is_found_from_looks_of_any_paint_and_in_spite_of_highlights() -> None:
    surface, turns = plate_and_balls(), turns_of(24)
    random = torch.Generator().manual_seed(2)
    arrives, turned = irradiance_by_harmonics(seen_sky(surface)), turned_harmonics(turns)
    paint = 0.1 + 0.6 * torch.rand(len(arrives), 3, generator=random)
    linear = paint * (arrives @ (turned @ SKY))
    linear += (torch.rand(linear.shape[:2], generator=random) < 0.1)[..., None] * 0.4
    linear[torch.rand(linear.shape[:2], generator=random) < 0.4] = torch.nan
    found = light_of_looks(arrives, turned, linear)
    lower = slice(0, 9)  # the cosine lobe leaves next to nothing of degree 3
    wanted = SKY / SKY[0]  # a channel's brightness goes with its paint
    assert float((found / found[0] - wanted)[lower].abs().max()) < 0.03
    assert math.isclose(float(found[0].mean()), 1 / float(sh_basis(torch.tensor([0.0, 0.0, 1.0]), 0)), rel_tol=1e-5)


@pytest.mark.parametrize("hidden", [0.0, 0.5])
def test_what_paint_and_shadows_look_like_is_taken_out_and_a_place_elsewhere_is_not(hidden: float) -> None:
    surface, turns = plate_and_balls(), turns_of(24)
    random = torch.Generator().manual_seed(3)
    paint = 0.1 + 0.6 * torch.rand(len(surface.mesh.vertices), 3, generator=random)
    shown = looks(surface, paint, turns)
    elsewhere = torch.stack([view[torch.randperm(len(view), generator=random)] for view in shown])
    unseen = torch.rand(shown.shape[:2], generator=random) < hidden
    shown[unseen], elsewhere[unseen] = torch.nan, torch.nan

    def scatter(values: Tensor) -> float:
        return float((values - values.nanmedian(0).values).abs().nanmean())

    loose, firm = unexplained_looks(surface, shown, turns)
    for left in (loose, firm):
        assert torch.equal(left.isnan(), shown.isnan())
        assert scatter(left) < 0.05 * scatter(shown)
    assert scatter(firm) < 0.4 * scatter(as_if_still(shown, turns, HELD[0])), "slopes alone do not explain shadows"
    # Where slopes may explain much they explain part of anything.
    loose_elsewhere, firm_elsewhere = unexplained_looks(surface, elsewhere, turns)
    assert scatter(firm_elsewhere) > 0.8 * scatter(elsewhere) and scatter(loose_elsewhere) > 0.5 * scatter(elsewhere)


@pytest.mark.parametrize("slope_held", [1.0, 30.0])
def test_what_goes_with_the_lights_turns_is_taken_out_as_far_as_it_is_not_held_and_nothing_else(slope_held: float) -> None:
    count = 40
    random = torch.Generator().manual_seed(0)
    turns = torch.linalg.qr(torch.randn(count, 3, 3, generator=random))[0]
    slopes, albedo = torch.randn(5, 3, 3, 3, generator=random), torch.rand(5, 3, generator=random)
    lit = albedo + torch.einsum("vcij,kij->kvc", slopes, turns)
    lit[::3, 0] = torch.nan
    still = as_if_still(lit, turns, slope_held)
    assert torch.equal(still.isnan(), lit.isnan())
    scatter = float((still - still.nanmean(0)).abs().nanmean()) / float((lit - lit.nanmean(0)).abs().nanmean())
    left_over = slope_held / (slope_held + count / 3)  # a turn's entry has a mean square of 1/3
    assert scatter < 0.2 if slope_held == 1 else 0.9 * left_over < scatter < 1.1 * left_over
    chance = torch.randn(count, 5, 3, generator=random)
    left = as_if_still(chance, turns, slope_held)
    assert float((left - left.mean(0)).square().mean()) > 0.6 * float((chance - chance.mean(0)).square().mean())


def test_a_photograph_that_hardly_shows_anything_is_no_trouble() -> None:
    surface, turns = plate_and_balls(), turns_of(6)
    shown = looks(surface, torch.full((len(surface.mesh.vertices), 3), 0.5), turns)
    shown[0] = torch.nan
    shown[1, 5:] = torch.nan
    for left in unexplained_looks(surface, shown, turns):
        assert bool(torch.isfinite(left[2:]).all()) and np.isnan(left[0].numpy()).all()
