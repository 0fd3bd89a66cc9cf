"""Pictures made band after band hold the bits of those made at once, whatever is seen and however it is shown."""

import math

import pytest
import torch
from torch import Tensor

from drgs.render.film.resolve_frame import linear_picture, resolve_frame
from drgs.render.progressive.refine import refine_frame
from drgs.render.progressive.start_frame import start_frame
from drgs.render.records import RenderSettings
from drgs.render.render_bands import Band, band_rows, render_bands
from drgs.render.render_frame import render_frame
from drgs.render.visible.draw_surfels import draw_surfels
from drgs.scene.camera import Camera
from drgs.scene.materials import Materials
from drgs.scene.posed_scene import PosedScene, PosedSurfels
from tests.render.closed_form_scenes import front_camera, sunny_sky, two_spheres

SIDE = 75
"""No multiple of a tile's."""
FOUR_BANDS = 20 * SIDE
"""Pixels of a band that make bands of one row of tiles."""


def scene_of(primary: str) -> PosedScene:
    mesh = two_spheres(metallic=0.3)
    if primary == "mesh":
        return PosedScene(None, mesh, sunny_sky(sun=20.0))
    corners = mesh.vertices[mesh.faces.long()]
    tangents = torch.stack([corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]], -1) * 0.4
    count, numbers = len(corners), torch.Generator().manual_seed(2)
    materials = Materials(torch.rand(count, 3, generator=numbers), torch.rand(count, generator=numbers), torch.zeros(count))
    opacities = 0.5 + 0.49 * torch.rand(count, generator=numbers)
    return PosedScene(PosedSurfels(corners.mean(1), tangents, opacities, materials), mesh, sunny_sky(sun=20.0))


def camera() -> Camera:
    return front_camera(SIDE, distance=5)


def bands(scene: PosedScene, settings: RenderSettings, band_pixels: int = FOUR_BANDS, slice_seconds: float | None = None) -> list[Band]:
    made = [band for band in render_bands(scene, camera(), settings, None, slice_seconds, band_pixels) if band is not None]
    assert [band.rows.start for band in made][1:] == [band.rows.stop for band in made][:-1]
    assert (made[0].rows.start, made[-1].rows.stop) == (0, SIDE)
    return made


def assembled(made: list[Band], show) -> Tensor:
    return torch.cat([show(band.state)[band.within] for band in made])


@pytest.mark.slow
@pytest.mark.parametrize("primary", ["mesh", "gaussians"])
@pytest.mark.parametrize("denoise", ["none", "svgf"])
@pytest.mark.parametrize("background", ["transparent", "environment"])
def test_bands_hold_the_bits_of_the_whole(primary: str, denoise: str, background: str) -> None:
    scene = scene_of(primary)
    settings = RenderSettings(samples_per_pixel=64, denoise=denoise, background=background, seed=3)  # type: ignore[arg-type]
    made, whole = bands(scene, settings), render_frame(scene, camera(), settings)
    assert len(made) == 5
    assert torch.equal(assembled(made, lambda state: resolve_frame(state).rgba_srgb), whole.rgba_srgb)
    for name in ("depth", "normal_world", "albedo", "coverage", "roughness"):
        assert torch.equal(
            assembled(made, lambda state, name=name: getattr(resolve_frame(state).gbuffer, name)), getattr(whole.gbuffer, name)
        )
    assert torch.equal(assembled(made, lambda state: resolve_frame(state).radiance.variance), whole.radiance.variance)


@pytest.mark.parametrize("samples", [8, 24, 64])
def test_a_denoiser_sees_as_far_beyond_a_band_as_it_reaches(samples: int) -> None:
    """Few samples, more rounds: up to sixty rows from either side."""
    scene, settings = scene_of("mesh"), RenderSettings(samples_per_pixel=samples, denoise="svgf")
    whole = render_frame(scene, camera(), settings)
    assert torch.equal(assembled(bands(scene, settings), lambda state: resolve_frame(state).rgba_srgb), whole.rgba_srgb)


def test_slices_of_time_change_nothing() -> None:
    scene, settings = scene_of("mesh"), RenderSettings(samples_per_pixel=32)
    made = list(render_bands(scene, camera(), settings, None, 1e-9, FOUR_BANDS))
    assert made.count(None) >= 3 * 5, "a call ends after one pass where no time is left"
    found = assembled([band for band in made if band is not None], linear_picture)
    assert torch.equal(found, assembled(bands(scene, settings, SIDE * SIDE), linear_picture))


def test_one_band_is_the_whole_picture_and_its_sums_hold_its_own_rows_only() -> None:
    scene, settings = scene_of("mesh"), RenderSettings(samples_per_pixel=4)
    (only,) = bands(scene, settings, SIDE * SIDE * 2)
    assert only.rows == slice(0, SIDE)
    second = bands(scene, settings)[1].state
    assert second.inputs.rows == slice(16, 32) and second.sums.weight.shape == (16 * SIDE,)
    first_row = refine_frame(start_frame(scene, camera(), settings)).sums.weight.view(SIDE, SIDE)[16:32]
    assert torch.equal(second.sums.weight.view(16, SIDE), first_row)


def test_surfels_are_drawn_in_bands_as_in_the_whole() -> None:
    surfels = scene_of("gaussians").surfels
    assert surfels is not None
    whole = draw_surfels(surfels, camera())
    assert torch.equal(torch.cat([draw_surfels(surfels, camera(), rows) for rows in band_rows(SIDE, SIDE, FOUR_BANDS)]), whole)


def test_bands_are_whole_tiles_and_as_high_as_asked_for() -> None:
    rows = band_rows(4096, 2160)
    assert {band.stop - band.start for band in rows[:-1]} == {64} and rows[-1].stop == 2160
    assert [band.start % 16 for band in band_rows(100, 100, 1, at_least=32)] == [0] * math.ceil(100 / 32)


def test_a_denoiser_that_needs_the_whole_picture_is_refused() -> None:
    with pytest.raises(ValueError, match="oidn looks at the whole picture"):
        next(render_bands(scene_of("mesh"), camera(), RenderSettings(denoise="oidn")))
