"""The denoising benchmark on a small scene, and the plots that benchmarks draw."""

import re

import pytest

from benchmarks._plot import Curve, log_log_svg
from benchmarks.render.denoise import one_frame_after
from drgs.scene.posed_scene import PosedScene
from tests.render.closed_form_scenes import front_camera, sunny_sky, two_spheres


@pytest.mark.slow
def test_an_edit_leaves_no_trail_and_a_small_move_keeps_what_was_seen() -> None:
    scene = PosedScene(None, two_spheres(roughness=0.6), sunny_sky(sun=30.0))
    rows = {row["edit"]: row for row in one_frame_after(scene, front_camera(24, 8.0), bounces=0, before=64, truth_samples=256)}
    for name in ("albedo halved", "roughness 0.1", "light turned by 40°"):
        assert rows[name]["after"] == pytest.approx(rows[name]["fresh"], rel=1e-3), name
    assert rows["albedo halved"]["kept"] > 2 * rows["albedo halved"]["after"]  # the edit is one that a trail would show
    dimmed, moved = rows["light dimmed to a half"], rows["camera moved by 0.25°"]
    assert dimmed["after"] < dimmed["fresh"] and moved["after"] < moved["fresh"]


def test_equal_ratios_are_equal_distances_in_a_log_log_plot() -> None:
    svg = log_log_svg([Curve("a < b", [(100.0, 0.01), (1.0, 1.0), (10.0, 0.1)])], "t", "x", "y")
    (line,) = re.findall(r'points="([^"]+)"', svg)
    (x0, y0), (x1, y1), (x2, y2) = ([float(v) for v in point.split(",")] for point in line.split())
    assert x0 < x1 < x2 and y0 < y1 < y2  # to the right and down
    assert x1 - x0 == pytest.approx(x2 - x1, abs=0.2) and y1 - y0 == pytest.approx(y2 - y1, abs=0.2)
    assert "a &lt; b" in svg


@pytest.mark.parametrize("points", [[], [(1.0, 0.0)], [(-1.0, 1.0)], [(1.0, float("nan"))]])
def test_what_has_no_logarithm_is_refused(points: list[tuple[float, float]]) -> None:
    with pytest.raises(ValueError, match="above 0"):
        log_log_svg([Curve("c", points)], "t", "x", "y")
