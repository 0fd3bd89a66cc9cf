"""Heights of columns below a lid: where rays meet them, and what that leaves between the views, against the float64 twin."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from drgs.reconstruct.capture.column_trials import ColumnTrials
from drgs.reconstruct.capture.find_pit import FAR
from drgs.reference import column_trials as reference

RAYS = 400


@pytest.fixture
def trials(device: str) -> ColumnTrials:
    random = np.random.default_rng(0)
    tensor = lambda values: torch.from_numpy(values).float().to(device)  # noqa: E731
    origin = np.concatenate([random.uniform(0, 1.3, (RAYS, 2)), np.full((RAYS, 1), 0.4)], 1)
    direction = random.normal(size=(RAYS, 3)) - [0, 0, 0.6]
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    returns = np.where(random.random(RAYS) < 0.3, random.uniform(2, 3, RAYS), -1.0)
    view = torch.from_numpy(random.integers(0, 7, RAYS)).to(device)
    return ColumnTrials(
        tensor(origin), tensor(direction), tensor(np.full(RAYS, 0.05)), tensor(random.uniform(0.3, 2.0, RAYS)), tensor(returns),
        tensor(random.random((RAYS, 3))), view, 0.2, 0.35, 0.3,
    )  # fmt: skip


def heights_of(count: int, device: str) -> torch.Tensor:
    random = np.random.default_rng(1)
    return torch.from_numpy(np.where(random.random((count, 9, 7)) < 0.2, FAR, random.uniform(-1, 0, (count, 9, 7)))).float().to(device)


def test_rays_meet_columns_where_the_twin_finds_them(trials: ColumnTrials, device: str) -> None:
    (height,) = heights_of(1, device)
    found, expected = trials.ends(height).cpu().numpy(), reference.ends(trials, height.cpu().double().numpy())
    assert (np.abs(found - expected) < 1e-4).mean() > 0.99  # a place on a border may fall to either side
    assert (expected < 0).any() and (expected > 0).any()


def test_what_trials_leave_is_the_twins_whatever_they_are_near(trials: ColumnTrials, device: str) -> None:
    heights = heights_of(5, device)
    heights[1:, :, :3] = heights[0, :, :3]
    heights[1:, 6:] = heights[0, 6:]
    expected = [reference.left(trials, height.cpu().double().numpy()) for height in heights]
    assert np.ptp(expected) > 1e-3
    for near in (heights[0], torch.full_like(heights[0], FAR)):
        assert trials.left(heights, near).tolist() == pytest.approx(expected, abs=2e-3)
    # Which rays fall on borders is all that they differ by: of one set of ends it is the same to the last bits.
    for height, left in zip(heights, trials.left(heights, heights[0]).tolist(), strict=True):
        difference, known = trials.differences(height)
        assert left == pytest.approx(float(difference[known].mean()), abs=1e-6)


def test_nothing_that_others_see_leaves_the_most(trials: ColumnTrials, device: str) -> None:
    alone = replace(trials, view=torch.zeros_like(trials.view), returns=torch.full_like(trials.returns, 2.5))
    assert alone.left(heights_of(1, device), heights_of(1, device)[0]).tolist() == pytest.approx([0.3])


def test_the_way_of_other_devices_gives_the_same(trials: ColumnTrials) -> None:
    heights = heights_of(3, "cpu")
    alone = replace(trials, view=torch.zeros_like(trials.view), returns=torch.full_like(trials.returns, 2.5))
    for rays in (trials, alone):
        means = [float(rays._mean_of(*rays.differences(height))) for height in heights.to(rays.origin.device)]
        assert means == pytest.approx(rays.left(heights.to(rays.origin.device), heights[0].to(rays.origin.device)).tolist(), abs=1e-6)


def test_an_object_far_from_the_worlds_middle_leaves_the_same(trials: ColumnTrials, device: str) -> None:
    up = torch.tensor([0.0, 0.0, 2.0**15 * trials.cell], device=device)
    far, heights = replace(trials, origin=trials.origin + up), heights_of(2, device) + up[2]
    for height, left in zip(heights, far.left(heights, heights[0]).tolist(), strict=True):
        difference, known = far.differences(height)
        assert left == pytest.approx(float(difference[known].mean()), abs=1e-6)
