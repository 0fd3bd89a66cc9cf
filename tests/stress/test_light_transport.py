"""Light transport at its extremes: small sweeps of what `python -m benchmarks stability` measures at length (docs/stability.md)."""

import re

import pytest
import torch

from benchmarks._stability_page import PAGE, rewritten
from benchmarks.deform import stability_deformation
from benchmarks.render import _light_sweeps as sweeps
from benchmarks.render import stability
from benchmarks.render._light_sweeps import Row
from drgs.render.integrate.environment_table import MAX_RADIANCE, build_environment_table
from drgs.render.intersect.trace_rays import build_tracer
from drgs.render.records import SampleCounts
from drgs.scene.environment import Environment
from tests.render.closed_form_scenes import constant_sky, points_seen_at, sphere_mesh, sunny_sky


def assert_right(rows: list[Row], largest: float, mean: float) -> None:
    for row in rows:
        assert row.not_finite == 0, row
        assert row.max_error is None or row.max_error < largest, row
        assert row.mean_error is None or row.mean_error < mean, row


def test_float32_follows_float64_from_mirrors_to_chalk() -> None:
    assert_right(sweeps.roughness_rows(8, 16), largest=5e-3, mean=3e-5)


def test_float32_follows_float64_at_grazing_angles() -> None:
    assert_right(sweeps.angle_rows(8, 16), largest=5e-3, mean=5e-5)


def test_float32_follows_float64_under_any_light() -> None:
    rows = sweeps.light_rows(8, 16)
    assert_right(rows, largest=2e-3, mean=1e-5)
    assert {"black sky", "sun of one texel, 1e6, in a black sky"} <= {row.case for row in rows}


def test_the_comparison_with_float64_finds_an_error_of_a_thousandth(monkeypatch: pytest.MonkeyPatch) -> None:
    """The sweeps can fail: a table 0.1 % off is seen."""
    honest = sweeps.build_environment_table
    points, sky = points_seen_at([45.0], roughness=0.5, copies=20), sunny_sky(8)

    def wrong(environment: Environment):
        table = honest(environment)
        if table.texels.dtype == torch.float32:
            table.texels[..., 3] *= 1.002
        return table

    right = sweeps.against_twin("", points, sky)
    monkeypatch.setattr(sweeps, "build_environment_table", wrong)
    assert sweeps.against_twin("", points, sky).mean_error > 20 * right.mean_error


def test_a_large_sky_with_a_sun_keeps_its_digits() -> None:
    assert_right([sweeps.large_sky_row(256, copies=5)], largest=5e-3, mean=5e-5)


def test_dim_texels_behind_a_sun_light_what_the_sun_does_not_reach() -> None:
    """The sun is below these points' horizon: what is left of the sky is a millionth of the table."""
    points = points_seen_at([30.0], albedo=1.0, roughness=1.0, copies=400)
    radiance = torch.ones(32, 64, 3)
    radiance[30, 10] = 1e6
    light = sweeps.estimate(points, Environment(radiance), SampleCounts(16, 0, 16))
    # The normal tilts 22 degrees: the sun's bilinear skirt stays 60 degrees below the horizon.
    assert float(light.diffuse.mean()) == pytest.approx(1.0, abs=0.01)


def test_white_surfaces_return_no_more_than_what_comes() -> None:
    rows = sweeps.furnace_rows(256, 128)
    assert_right(rows, 0, 0)
    worst = max(rows, key=lambda row: row.energy)
    assert worst.energy <= 1 + 2e-3, worst  # the noise of this many samples; the page's run has 1 + 1e-3
    mirror = next(row for row in rows if row.case == "white metal, roughness 0")
    assert mirror.energy > 0.995


@pytest.mark.slow
def test_a_scene_is_the_same_at_any_scale_and_degrades_as_stated_far_away() -> None:
    rows = sweeps.placement_rows(12)
    scaled = [row for row in rows if row.case.startswith("scale")]
    assert_right(scaled, largest=1e-3, mean=1e-5)
    far = [row for row in rows if not row.case.startswith("scale")]
    assert_right(far, largest=2.0, mean=2e-2)
    assert far[0].mean_error < 1e-5 and far[1].mean_error < 1e-3


@pytest.mark.slow
def test_faulty_meshes_give_finite_pictures_and_faults_that_show_nothing_change_nothing() -> None:
    rows = sweeps.mesh_rows(8)
    turned = [row for row in rows if "turned over" in row.case]
    assert_right([row for row in rows if row not in turned], largest=1e-6, mean=1e-6)
    assert len(turned) == 1 and turned[0].not_finite == 0


def test_pictures_of_a_pixel_are_drawn_and_of_none_refused() -> None:
    rows = sweeps.image_rows()
    assert_right(rows, 0, 0)
    assert [row.case for row in rows if row.refused is None] == ["picture of 1×1", "picture of 1×7", "picture of 17×1"]
    assert all("expected at least 1x1" in row.refused for row in rows[3:])


def test_light_and_places_that_cannot_be_right_are_refused() -> None:
    for row in sweeps.refused_rows():
        assert row.refused is not None and "expected" in row.refused, row


def test_what_lies_just_inside_the_limits_is_not_refused() -> None:
    build_environment_table(constant_sky(MAX_RADIANCE))
    nowhere = torch.zeros(3, dtype=torch.float64)
    for scale, offset in ((1e-5, 0.0), (1e8, 0.0), (1.0, 1e5)):
        build_tracer(sweeps.moved(sphere_mesh(1), scale, nowhere + offset))


def test_surfels_at_their_extremes_follow_float64_and_give_finite_frames() -> None:
    rows = sweeps.surfel_rows(100, 16)
    scaled = [row for row in rows if row.case.startswith("frame of")]
    assert_right([row for row in rows if row not in scaled], largest=5e-3, mean=1e-4)
    assert len(scaled) == 2
    assert_right(scaled, largest=0.5, mean=1e-4)  # a ray at an outline may fall to either side


def test_the_page_is_rewritten_between_its_markers_only() -> None:
    start, end = stability.BETWEEN
    page = f"before\n{start}\nold\n{end}\nafter\n"
    assert rewritten(page, stability.BETWEEN, "new\n") == f"before\n{start}\nnew\n{end}\nafter\n"
    with pytest.raises(ValueError, match="markers 0 and 1 times"):
        rewritten(page.replace(start, ""), stability.BETWEEN, "new")


@pytest.mark.parametrize("benchmark", [stability, stability_deformation], ids=["light", "matter"])
def test_the_page_has_what_each_benchmark_writes(benchmark) -> None:
    start, end = benchmark.BETWEEN
    page = PAGE.read_text()
    section = page[page.index(start) : page.index(end)]
    assert benchmark.INTRODUCTION in section and benchmark.LIMITS in section
    assert re.findall("^### (.*)", section, re.MULTILINE)[:-1] == [name.capitalize() for name in benchmark.NOTES]
