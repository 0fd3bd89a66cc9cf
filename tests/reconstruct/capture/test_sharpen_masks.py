"""Masks that are a pixel or two off are moved to the edges of their photographs; right ones, and ones of pictures that were cut out, stay."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from numpy import ndarray
from scipy.ndimage import distance_transform_edt, gaussian_filter

from drgs.maths.color_numpy import srgb_from_linear
from drgs.reconstruct.capture.sharpen_masks import _squared_distance, sharpen_masks
from drgs.reference.rasterize_gbuffer import look_at_camera
from drgs.scene.views import Views

SIDE = 160
ROOM, PAINT = np.array([0.35, 0.3, 0.25]), np.array([0.7, 0.15, 0.1])


def disc_distance(center: tuple[float, float] = (80.0, 78.0), radius: float = 50.0) -> ndarray:
    """[pixels] inwards from a disc's edge, at the pixels' centres."""
    row, column = np.mgrid[:SIDE, :SIDE] + 0.5
    return radius - np.hypot(column - center[0], row - center[1])


def ring_distance() -> ndarray:
    return np.minimum(disc_distance(), -disc_distance(radius=38.0))


def photographed(distance: ndarray, paint: ndarray = PAINT, seed: int = 0) -> tuple[ndarray, ndarray]:
    """A photograph (0..255) of what is where `distance` is positive, mottled and with grain, and how much of each pixel that covers."""
    random = np.random.default_rng(seed)
    covered = np.clip(distance + 0.5, 0, 1)
    mottled = paint * (1 + 0.25 * gaussian_filter(random.normal(size=(SIDE, SIDE, 1)), (2, 2, 0)) * 7)
    room = ROOM * (0.8 + 0.4 * np.linspace(0, 1, SIDE)[:, None, None])
    light = covered[..., None] * mottled + (1 - covered[..., None]) * room + random.normal(size=(SIDE, SIDE, 3)) * 0.004
    return (255 * srgb_from_linear(light.clip(0, 1)) + 0.5).astype(np.uint8), covered


def rough_mask(distance: ndarray, too_wide: float = 0.7, off: float = 1.0, seed: int = 1) -> ndarray:
    """0 or 1: too wide, and waving along the outline."""
    wave = gaussian_filter(np.random.default_rng(seed).normal(size=distance.shape), 6)
    return (distance + too_wide + off * wave / wave.std() > 0).astype(np.float64)


def views_of(image: ndarray, mask: ndarray) -> Views:
    camera = look_at_camera(SIDE, SIDE, 200.0)
    return Views((camera,), (torch.from_numpy(image),), (torch.from_numpy((255 * mask + 0.5).astype(np.uint8)),), None, None, True, "test")


def error(mask: ndarray, covered: ndarray) -> tuple[float, float]:
    """Mean absolute and mean signed distance of the outlines [pixels]."""
    length = (np.abs(np.gradient(covered)[0]) + np.abs(np.gradient(covered)[1])).sum() / np.sqrt(2)
    return np.abs(mask - covered).sum() / length, (mask - covered).sum() / length


@pytest.mark.parametrize("distance", [disc_distance(), ring_distance()], ids=["disc", "ring"])
@pytest.mark.parametrize("too_wide", [0.7, -0.7])
def test_rough_masks_are_moved_to_the_photographs_edges(distance: ndarray, too_wide: float) -> None:
    image, covered = photographed(distance)
    given = rough_mask(distance, too_wide)
    moved = sharpen_masks(views_of(image, given))
    before, after = error(given, covered), error(moved.coverage[0].numpy() / 255, covered)
    assert after[0] < 0.3 * before[0] and abs(after[1]) < 0.15
    assert 0.6 < moved.masks_moved < 2.5


def test_large_photographs_are_looked_at_when_shrunk_and_moved_as_they_are(monkeypatch: pytest.MonkeyPatch) -> None:
    distance = disc_distance()
    image, covered = photographed(distance)
    given = rough_mask(distance, 2.0, 2.0)
    monkeypatch.setattr("drgs.reconstruct.capture.sharpen_masks.LOOK_SIDE", SIDE // 2)
    moved = sharpen_masks(views_of(image, given)).coverage[0].numpy() / 255
    before, after = error(given, covered), error(moved, covered)
    assert after[0] < 0.25 * before[0] and abs(after[1]) < 0.3


def test_right_masks_stay_as_they_are() -> None:
    image, covered = photographed(disc_distance())
    views = views_of(image, covered)
    assert sharpen_masks(views) is views


def test_masks_of_pictures_that_were_cut_out_stay() -> None:
    image, _ = photographed(disc_distance())
    given = rough_mask(disc_distance())
    views = views_of(image * (given > 0)[..., None].astype(np.uint8), given)
    assert sharpen_masks(views) is views


def test_where_both_sides_look_alike_nothing_is_moved() -> None:
    image, covered = photographed(disc_distance())
    alike = image.copy()
    alike[2 * SIDE // 3 :] = image[-1, -1]
    given = rough_mask(disc_distance())
    moved = sharpen_masks(views_of(alike, given)).coverage[0].numpy() / 255
    below, above = slice(2 * SIDE // 3 + 12, None), slice(0, 2 * SIDE // 3 - 12)
    assert np.abs(moved - given)[below].sum() < 0.25 * np.abs(covered - given)[below].sum()
    assert np.abs(moved - covered)[above].sum() < 0.35 * np.abs(given - covered)[above].sum()


def test_an_outline_through_texture_is_no_edge() -> None:
    x, y = np.meshgrid(*[(np.arange(SIDE) + 0.5) / SIDE * 2 - 1] * 2)
    image = (255 * (0.4 + 0.3 * np.sin(15 * x) * np.sin(15 * y))[..., None].repeat(3, -1)).astype(np.uint8)
    views = views_of(image, rough_mask(disc_distance()))
    assert sharpen_masks(views) is views


def test_at_the_rim_colours_are_the_objects_own() -> None:
    plain = PAINT * 0 + np.array([0.1, 0.1, 0.6])
    image, _ = photographed(disc_distance(), plain)
    moved = sharpen_masks(views_of(image, rough_mask(disc_distance())))
    red = moved.images_srgb[0].numpy()[moved.coverage[0].numpy() > 64][:, 0].astype(float)
    inner = image[disc_distance() > 5][:, 0].astype(float)
    assert abs(red.mean() - inner.mean()) < 2 and red.max() < inner.max() + 3


def test_specks_of_a_mask_stay() -> None:
    image, covered = photographed(disc_distance())
    given = rough_mask(disc_distance())
    given[5:7, 5:7] = 1
    given[78:80, 80:82] = 0
    moved = sharpen_masks(views_of(image, given)).coverage[0].numpy() / 255
    assert (moved[:12, :12] == given[:12, :12]).all() and (moved[70:90, 70:90] == given[70:90, 70:90]).all()
    assert error(moved, covered)[0] < 0.4 * error(given, covered)[0]


def test_outlines_at_a_pictures_border_stay_there() -> None:
    distance = disc_distance((20.0, 80.0))
    image, covered = photographed(distance)
    given = rough_mask(distance)
    moved = sharpen_masks(views_of(image, given)).coverage[0].numpy() / 255
    assert (moved[:, 0] == given[:, 0])[40:120].all()
    assert error(moved, covered)[0] < 0.4 * error(given, covered)[0]


def test_views_without_an_outline_stay_beside_those_with_one() -> None:
    image, covered = photographed(disc_distance())
    rough, empty = views_of(image, rough_mask(disc_distance())), torch.zeros(SIDE, SIDE, dtype=torch.uint8)
    both = replace(rough, cameras=rough.cameras * 2, images_srgb=rough.images_srgb * 2, coverage=(rough.coverage[0], empty))
    moved = sharpen_masks(both)
    assert torch.equal(moved.coverage[1], empty) and torch.equal(moved.images_srgb[1], both.images_srgb[1])
    assert error(moved.coverage[0].numpy() / 255, covered)[0] < 0.3 * error(rough.coverage[0].numpy() / 255, covered)[0]


@pytest.mark.parametrize("most", [3.0, 7.5, 40.0])
def test_distances_that_matter_are_those_of_a_distance_transform(most: float) -> None:
    there = np.random.default_rng(0).random((30, 47)) > 0.985
    exact = np.rint(distance_transform_edt(~there) ** 2)
    found = _squared_distance(there, most)
    near = exact <= most**2
    assert (found[near] == exact[near]).all() and (found[~near] > most**2).all()
