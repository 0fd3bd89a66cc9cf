"""Computed environments: the sun's energy over its solid angle, a sky that is physically possible, lamps on the sides they are named after."""

import math

import numpy as np
import pytest
import torch

from drgs.scene.environment import Environment, direction_from_uv, environment_radiance
from drgs.scene.lat_long import direction_of_degrees, texel_directions, texel_means, texel_solid_angles
from drgs.scene.sun_and_sky import AZIMUTH_DEGREES, RADIUS_DEGREES, UNIT, paint_sun_and_sky, sky_radiance, sun_irradiance, sun_share
from drgs.scene.three_point_lights import FILL, KEY, RIM, paint_three_point_lights
from drgs_worker.jobs.start_view import start_view

HALF_FLOAT_MAX = 65504


def luminance(radiance: np.ndarray) -> np.ndarray:
    return radiance @ np.array([0.2126, 0.7152, 0.0722])


def flux_through(radiance: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """(3,) irradiance of a surface with this normal."""
    height = len(radiance)
    cosine = (texel_directions(height) @ normal).clip(0)
    return (radiance * (cosine * texel_solid_angles(height)[:, None])[..., None]).sum((0, 1))


def test_texel_directions_are_those_of_the_lookup_and_their_weights_integrate_it() -> None:
    height = 6
    v, u = torch.meshgrid((torch.arange(6.0) + 0.5) / 6, (torch.arange(12.0) + 0.5) / 12, indexing="ij")
    np.testing.assert_allclose(texel_directions(height), direction_from_uv(torch.stack([u, v], -1)).numpy(), atol=1e-6)
    assert math.isclose(texel_solid_angles(height).sum() * 2 * height, 4 * math.pi)
    # Against a fine sum over the bilinear lookup of a random table.
    table = np.random.default_rng(0).random((height, 2 * height, 3))
    rows = 300
    fine = torch.from_numpy(texel_directions(rows).copy())
    shown = environment_radiance(Environment(torch.from_numpy(table)), fine).numpy()
    summed = (shown * (np.sin((np.arange(rows) + 0.5) * np.pi / rows) * (np.pi / rows) ** 2)[:, None, None]).sum((0, 1))
    np.testing.assert_allclose((table * texel_solid_angles(height)[:, None, None]).sum((0, 1)), summed, rtol=1e-4)
    np.testing.assert_allclose(texel_means(np.repeat(np.repeat(table, 2, 0), 2, 1), 2), table)


@pytest.mark.parametrize("elevation", [2.0, 17.3, 40.0, 85.0])
def test_the_sun_keeps_its_energy_and_its_place_on_the_table(elevation: float) -> None:
    painted = paint_sun_and_sky(elevation).astype(float)
    sun = direction_of_degrees(AZIMUTH_DEGREES, elevation)
    disc = sun_share(sun, 256) > 0
    sky = np.where(disc[..., None], sky_radiance(texel_directions(256), sun), painted)
    weighted = (painted - sky) * texel_solid_angles(256)[:, None, None]
    np.testing.assert_allclose(weighted.sum((0, 1)), sun_irradiance(elevation), rtol=1e-4)
    # Radiance of the disc times its true solid angle: what is written down of the sun is its irradiance.
    solid_angle = 2 * math.pi * (1 - math.cos(math.radians(RADIUS_DEGREES)))
    disc_luminance = luminance(sun_irradiance(elevation)) * UNIT / solid_angle
    assert 6e2 < disc_luminance < 1.9e6, "of the sun, between the horizon and outside the air [kcd/m2]"
    middle = (weighted.sum(-1)[..., None] * texel_directions(256)).sum((0, 1))
    assert math.degrees(math.acos(middle @ sun / np.linalg.norm(middle))) < 0.2
    assert painted.max() < HALF_FLOAT_MAX


def test_the_sky_is_finite_positive_blue_above_and_brighter_with_a_higher_sun() -> None:
    irradiance = []
    for elevation in (2.0, 10.0, 40.0, 85.0):
        painted = paint_sun_and_sky(elevation)
        assert np.isfinite(painted).all() and (painted > 0).all()
        irradiance.append(luminance(flux_through(painted, np.array([0.0, 0.0, 1.0]))))
    assert irradiance == sorted(irradiance)
    usual = paint_sun_and_sky()
    assert usual[0, 0, 2] > 2 * usual[0, 0, 0], "up is the first row"
    assert luminance(usual[:128]).min() > luminance(usual[128:]).max() * 0.5 and np.ptp(usual[128:], axis=(0, 1)).max() < 1e-6
    # A clear day: 60 to 90 klx on the ground, most of them from the sun, which is warmer than the sky.
    assert 60 < irradiance[2] * UNIT < 90
    assert 0.5 < luminance(sun_irradiance(40.0)) * math.sin(math.radians(40)) / irradiance[2] < 0.85
    assert sun_irradiance(5.0)[0] > 2 * sun_irradiance(5.0)[2]
    with pytest.raises(ValueError, match="-3 degrees"):
        paint_sun_and_sky(-3.0)


def test_each_lamp_of_the_studio_stands_where_its_name_says() -> None:
    painted = paint_three_point_lights()
    assert np.isfinite(painted).all() and (painted > 0).all()
    camera = start_view((-1, -1, -1), (1, 1, 1))
    right, backward = camera[:3, 0], camera[:3, 2]
    assert KEY.direction @ right < -0.3 and KEY.direction[2] > 0.5, "left and above"
    assert FILL.direction @ right > 0.3 > FILL.direction[2], "right and low"
    assert RIM.direction @ backward < -0.3, "behind"
    bright = luminance(painted) > 5
    seen = texel_directions(256)[bright]
    to_key, to_rim = seen @ KEY.direction, seen @ RIM.direction
    assert (np.maximum(to_key, to_rim) > 0.7).all() and (to_key > 0.9).any() and (to_rim > 0.9).any()
    key, fill = (luminance(flux_through(painted, lamp.direction)) for lamp in (KEY, FILL))
    assert 2 < key / fill < 8, "the classic ratio of contrast"
    # Floor and backdrop are dim, and the backdrop is what the camera looks at.
    assert luminance(painted[-1]).max() < 0.3
    behind = direction_of_degrees(-54.0 + 180, 5.0)
    place = np.unravel_index((texel_directions(256) @ behind).argmax(), (256, 512))
    assert 0.1 < luminance(painted[place]) < 0.5
