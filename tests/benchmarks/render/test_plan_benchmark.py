"""The plan's benchmark on a small scene: every skip has a switch, and exact ones change no pixel."""

from benchmarks.render.plan import measure_saving, measure_skips, measure_taken_over
from drgs.render.records import RenderSettings
from drgs.scene.posed_scene import PosedScene
from tests.render.closed_form_scenes import front_camera, sunny_sky, two_spheres

SCENE = PosedScene(None, two_spheres(roughness=0.4, metallic=0.5), sunny_sky(sun=20.0))
CAMERA, SETTINGS = front_camera(40, 20.0), RenderSettings(bounces=1, primary="mesh")


def test_every_skip_of_a_frame_is_switched_on_alone_and_exact_ones_change_nothing() -> None:
    rows = measure_skips(SCENE, CAMERA, SETTINGS, passes=4, repeats=1)
    assert len(rows) >= 3 and not any("note" in row for row in rows), rows
    exact = [row for row in rows if row["bound"] == "exact"]
    assert len(exact) >= 2 and all(row["largest_difference"] == 0 for row in exact)
    in_the_mean = [row for row in rows if row["bound"] == "exact in the mean"]
    assert in_the_mean and all(abs(row["mean_difference"]) < 5 * row["mean_difference_error"] for row in in_the_mean)


def test_what_is_taken_over_after_an_edit_changes_nothing() -> None:
    rows = measure_taken_over(SCENE, CAMERA, SETTINGS, repeats=1)
    assert len(rows) == 3 and all(row["largest_difference"] == 0 for row in rows)


def test_saved_time_is_told_at_equal_error() -> None:
    found = measure_saving(SCENE, CAMERA, SETTINGS, passes=2, truth_passes=16, repeats=1)
    cost = [found[name]["cpu_seconds"] * found[name]["relmse"] for name in ("with", "without")]
    assert found["saved"] == 1 - cost[0] / cost[1]
