"""A thing on paper is cut out; its shadow, a scale beside it and the paper's own gradient are not it."""

import numpy as np
import pytest
from scipy import ndimage

from drgs.reconstruct.pose.backdrop_masks import backdrop_mask

SIDE = 200
Y, X = np.mgrid[:SIDE, :SIDE] + 0.5
RADIUS = np.hypot(X - 105, Y - 95)
THING = (RADIUS < 45) & ~(np.hypot(X - 95, Y - 80) < 9)


def on_paper(thing: tuple[int, int, int], paper: tuple[int, int, int] = (225, 222, 214), noise: float = 2.0) -> np.ndarray:
    light = 0.85 + 0.15 * X / SIDE
    shadow = 1 - 0.35 * ndimage.gaussian_filter((np.hypot(X - 112, Y - 118) < 40).astype(float), 8)
    picture = np.array(paper) * (light * shadow)[..., None]
    picture[THING] = np.array(thing) * (0.6 + 0.4 * np.sin(X[THING] / 6) ** 2)[:, None]
    picture[177:183, 20:80] = 20  # a scale
    picture += np.random.default_rng(0).normal(0, noise, picture.shape)
    return picture.clip(0, 255).astype(np.uint8)


@pytest.mark.parametrize("thing", [(150, 90, 40), (40, 60, 130), (30, 28, 30)], ids=["wood", "blue", "black"])
def test_the_thing_is_cut_out_with_its_hole_and_without_shadow_and_scale(thing: tuple[int, int, int]) -> None:
    mask = backdrop_mask(on_paper(thing))
    assert mask is not None and set(np.unique(mask)) == {0, 255}
    inside = mask > 0
    assert (inside & THING).sum() / (inside | THING).sum() > 0.95
    assert not inside[177:183, 20:80].any() and not inside[80, 95]


def test_it_may_touch_the_border() -> None:
    picture = np.roll(on_paper((150, 90, 40)), -62, axis=1)
    mask = backdrop_mask(picture)
    assert mask is not None
    true = np.roll(THING, -62, axis=1)
    assert ((mask > 0) & true).sum() / ((mask > 0) | true).sum() > 0.93


def test_dark_cloth_is_a_backdrop_too() -> None:
    mask = backdrop_mask(on_paper((210, 180, 90), paper=(35, 35, 40)))
    assert mask is not None
    assert ((mask > 0) & THING).sum() / ((mask > 0) | THING).sum() > 0.9


def test_a_room_is_none_and_an_empty_sheet_has_nothing_on_it() -> None:
    room = ndimage.gaussian_filter(np.random.default_rng(1).uniform(0, 255, (SIDE, SIDE, 3)), (6, 6, 0))
    room = ((room - room.min()) / np.ptp(room) * 255).astype(np.uint8)
    assert backdrop_mask(room) is None
    assert backdrop_mask(np.full((SIDE, SIDE, 3), 230, np.uint8)) is None
