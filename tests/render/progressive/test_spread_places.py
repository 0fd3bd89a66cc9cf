"""Passes that look where places differ: the same mean for less error, at the same cost, however passes are grouped."""

import dataclasses
import math

import pytest
import torch
from torch import Tensor

from drgs.render.integrate.plan import SPREAD_PLACES
from drgs.render.progressive.frame_state import FrameState
from drgs.render.progressive.refine import refine_frame
from drgs.render.progressive.spread_places import (
    EMPTY_COST,
    FIRST_LOOK,
    LEAST,
    MOST,
    ONE,
    is_look,
    list_looks,
    next_look,
    places_between,
    rates_of_rows,
)
from drgs.render.progressive.start_frame import start_frame
from drgs.render.records import RenderSettings, SampleCounts
from drgs.scene.posed_scene import PosedScene
from tests.render.closed_form_scenes import front_camera, sphere_mesh, sunny_sky

CAMERA = front_camera(48, distance=8)
METAL = PosedScene(None, sphere_mesh(3, metallic=1.0, roughness=0.2), sunny_sky(sun=50.0))


def started(seed: int = 0, spreads: bool = True, scene: PosedScene = METAL) -> FrameState:
    state = start_frame(scene, CAMERA, RenderSettings(bounces=0, seed=seed))
    assert state.plan.spread_places and SPREAD_PLACES in state.plan.skips
    return dataclasses.replace(state, plan=dataclasses.replace(state.plan, spread_places=spreads))


def picture(state: FrameState) -> Tensor:
    """(pixel,) luminance, 0 where nothing is seen."""
    return state.sums.luminance.double() / state.sums.places.double().clamp(min=1)


def test_looks_lie_where_passes_have_doubled() -> None:
    assert [index for index in range(40) if is_look(index)] == [4, 8, 16, 32]
    assert [next_look(index) for index in (1, 3, 4, 7, 8, 31)] == [4, 4, 8, 8, 16, 32]


@pytest.mark.parametrize("rate", [LEAST, 4, 8, MOST])
def test_between_two_looks_every_rate_has_whole_places_and_parts_add_up(rate: int) -> None:
    rates = torch.tensor([rate], dtype=torch.int32)
    for first in (4, 8, 16):
        assert int(places_between(rates, first, 2 * first)) == rate * first // ONE
        one_by_one = sum(int(places_between(rates, index, index + 1)) for index in range(first, 2 * first))
        assert one_by_one == rate * first // ONE


def test_listed_places_of_a_pixel_follow_each_other_from_where_it_was() -> None:
    numbers = torch.Generator().manual_seed(1)
    pixels = torch.arange(50, 90, dtype=torch.int32)
    rates = (2 ** torch.randint(1, 6, (40,), generator=numbers)).int()
    places = torch.randint(4, 30, (40,), generator=numbers).int()
    looks = list_looks(pixels, 9, 13, rates, places)
    for pixel, rate, before in zip(pixels, rates, places, strict=True):
        mine = looks.pixels == pixel
        count = int(places_between(rate[None], 9, 13))
        assert looks.rounds[mine].tolist() == list(range(int(before), int(before) + count))
        assert looks.passes[mine].tolist() == sorted(looks.passes[mine].tolist()) and bool(mine.sum() == count)
    assert set(looks.passes.tolist()) == {9, 10, 11, 12}
    even = list_looks(pixels, 9, 11, None, places)
    assert even.pixels.tolist() == 2 * pixels.tolist() and even.rounds.tolist() == 40 * [9] + 40 * [10]


def test_rates_go_where_places_differ_and_cost_what_one_place_each_costs() -> None:
    mean, variance, covered = torch.full((2, 16, 64), 0.5), torch.full((2, 16, 64), 0.01), torch.ones(2, 16, 64)
    variance[0, :, 20:30] = 4.0
    covered[:, :, 50:] = mean[:, :, 50:] = variance[:, :, 50:] = 0.0
    rates = rates_of_rows(mean, variance, covered, torch.ones(2, 16, 64, dtype=torch.bool))
    assert bool((rates[0, :, 22:28] >= 4 * rates[0, :, 2:3]).all()) and int(rates.min()) >= LEAST and int(rates.max()) <= MOST
    cost = EMPTY_COST + (1 - EMPTY_COST) * covered
    assert float((cost * rates / ONE).sum((1, 2)).max()) < 1.3 * float(cost.sum((1, 2)).max())
    # A row of tiles is by itself: bands hold whole ones.
    alone = rates_of_rows(mean[1:], variance[1:], covered[1:], torch.ones(1, 16, 64, dtype=torch.bool))
    assert torch.equal(alone[0], rates[1])


def test_what_a_pixel_has_found_itself_does_not_raise_its_rate() -> None:
    mean, variance, covered = torch.full((1, 16, 64), 0.5), torch.full((1, 16, 64), 0.01), torch.ones(1, 16, 64)
    chosen = torch.ones(1, 16, 64, dtype=torch.bool)
    before = rates_of_rows(mean, variance, covered, chosen)
    mean[0, 8, 31], variance[0, 8, 31] = 5.0, 100.0
    after = rates_of_rows(mean, variance, covered, chosen)
    assert int(after[0, 8, 31]) <= int(before[0, 8, 31]) and int(after[0, 8, 32]) > int(before[0, 8, 32])


def test_a_row_without_any_light_keeps_one_place_a_pass() -> None:
    dark = torch.zeros(1, 16, 32)
    assert bool((rates_of_rows(dark, dark, dark, torch.ones(1, 16, 32, dtype=torch.bool)) == ONE).all())


@pytest.mark.parametrize("intensity", [1e20, 1e30])
def test_light_whose_square_is_beyond_numbers_is_looked_at_evenly(intensity: float) -> None:
    state = refine_frame(started(scene=dataclasses.replace(METAL, environment_intensity=intensity)), 20)
    assert state.rates is not None and int(state.rates.min()) >= LEAST and int(state.rates.max()) <= MOST
    assert bool(torch.isfinite(state.sums.diffuse).all()) and bool((state.sums.places >= 0).all())


def test_passes_together_are_those_one_by_one_and_stop_anywhere() -> None:
    together, alone = refine_frame(started(), 21), started()
    for _ in range(21):
        alone = refine_frame(alone)
    assert together.rates is not None and alone.rates is not None and torch.equal(together.rates, alone.rates)
    assert len(together.rates.unique()) > 2 and FIRST_LOOK < 21
    for name, values in vars(together.sums).items():
        assert values is None or torch.equal(values, getattr(alone.sums, name)), name


@pytest.mark.slow
def test_the_mean_stays_and_the_error_falls() -> None:
    """Of forty frames each: their mean is that of frames of even passes within its noise, and each is nearer to it."""
    seeds = range(40)
    spread, even = (torch.stack([picture(refine_frame(started(seed, spreads), 16)) for seed in seeds]) for spreads in (True, False))
    sums, even_sums = spread.sum(1), even.sum(1)
    noise = math.sqrt(float(sums.var() + even_sums.var()) / len(seeds))
    assert abs(float(sums.mean() - even_sums.mean())) < 3 * noise and noise < 0.01 * float(even_sums.mean())
    truth = torch.cat([spread, even]).mean(0)

    def error(pictures: Tensor) -> float:
        return float(((pictures - truth).square() / (truth.square() + 0.01)).mean())

    assert error(spread) < 0.9 * error(even)


def test_frames_that_are_told_their_counts_or_to_skip_nothing_look_evenly() -> None:
    for settings in (RenderSettings(counts=SampleCounts(2, 1, 1)), RenderSettings(skip=False)):
        state = refine_frame(start_frame(METAL, CAMERA, settings), 6)
        assert not state.plan.spread_places and state.rates is None and bool((state.sums.places[state.sums.places > 0] == 6).all())
