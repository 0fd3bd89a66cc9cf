"""Deformation and simulation at their extremes: small sweeps of what `python -m benchmarks stability_deformation` measures at length."""

import pytest
import torch

from benchmarks.deform import _matter_sweeps as sweeps
from benchmarks.deform import stability_deformation
from benchmarks.deform._matter_sweeps import Row
from drgs.deform.matter.mpm import LAWS


def assert_contained(rows: list[Row]) -> None:
    """Nothing is NaN or infinite, nobody is outside."""
    for row in rows:
        assert row.not_finite == 0 and row.values.get("outside_the_room", 0) == 0, row


def assert_moves(rows: list[Row], energy: float = 1.0) -> None:
    """And nothing had to be stopped or taken back; energy does not grow."""
    assert_contained(rows)
    for row in rows:
        if row.refused is None:
            assert row.values["frozen"] == 0 and row.values["retries"] == 0 and row.values["energy_left"] <= energy + 1e-3, row


def refused(rows: list[Row]) -> dict[str, str]:
    return {row.case: row.refused for row in rows if row.refused is not None}


def test_surfels_keep_an_area_and_a_side_under_gradients_of_every_determinant():
    rows = sweeps.surfel_rows(20)
    assert_contained(rows)
    for row in rows:
        assert row.values["least_stretch"] > 0.99e-2 and row.values["most_stretch"] < 1.01e2 and row.values["normal_length_error"] < 1e-5, (
            row
        )


def test_points_are_carried_by_flat_thin_lonely_and_distant_neighbourhoods():
    rows = sweeps.neighbourhood_rows()
    assert_contained(rows)
    for row in rows:
        assert max(row.values["rigid_error"], row.values["affine_error"]) < 1e-3, row


def test_folded_flat_and_shuffled_meshes_give_surfels_an_area():
    rows = sweeps.mesh_rows()
    assert_contained(rows)
    assert all(row.values["least_stretch"] > 0.99e-2 and row.values["most_stretch"] < 1.01e2 for row in rows)


def test_targets_that_no_shape_can_follow_leave_it_finite():
    rows = sweeps.handle_rows()
    assert_contained(rows)
    assert set(refused(rows)) == {"1e6 lengths away", "NaN"}
    near = {row.case: row for row in rows}
    for case in ("at rest", "one end through the other", "a half turn of one end", "mirrored"):
        assert near[case].values["missed"] < 0.02, near[case]  # of a length of 4


@pytest.mark.parametrize("law", LAWS)
def test_matter_that_starts_with_any_gradient_does_not_leave_the_numbers(law):
    assert_contained(sweeps.strained_rows(64, 0.005, determinants=(-1.0, 0.0, 1e-6, 1.0, 1e3), laws=[law]))


def test_matter_that_bursts_is_contained_and_not_refused_half_way():
    rows = sweeps.strained_rows(512, 0.02, determinants=(1e3,), laws=("neo_hookean",))
    assert_contained(rows)
    assert rows[0].refused is None and rows[0].values["retries"] > 0


def test_matter_of_every_stiffness_lands():
    assert_moves(sweeps.stiffness_rows(64, 0.05))


def test_matter_of_every_compressibility_lands_and_more_is_refused():
    rows = sweeps.poisson_rows(64, 0.03)
    assert_moves(rows)
    assert "expected 0 to 0.49" in refused(rows)["nu = 0.499"]


def test_every_law_lands_hard():
    assert_moves(sweeps.speed_rows(64, 0.05))


@pytest.mark.slow
def test_half_the_limit_to_the_limit_is_stable_and_twice_the_limit_is_contained():
    rows = sweeps.time_step_rows(216, 0.1)
    assert_contained(rows)
    assert_moves([row for row in rows if "past" not in row.case])
    assert "at most 0.9" in refused(rows)["C = 0.95"]


def test_one_particle_falls_and_so_do_a_thousand():
    rows = sweeps.count_rows([1, 2, 8, 1000], 0.02)
    assert_moves(rows)
    assert [row.values["particles"] for row in rows] == [1, 1, 8, 1000]


def test_nobody_leaves_the_room_and_who_starts_outside_is_refused():
    rows = sweeps.room_rows(64, 0.05)
    assert_contained(rows)
    assert "1 particles lie outside the room" in refused(rows)["one particle outside the room"]
    assert "more than 2000" in refused(rows)["E = 1e9 Pa, 4096 particles, 1/6 s in one call"]


def test_the_page_has_every_sweep_and_every_refusal():
    rows = [Row("a case", {"energy_left": 0.5}), Row("another", refused="no")]
    text = stability_deformation.section(dict.fromkeys(stability_deformation.NOTES, rows))
    assert text.count("| a case | 0.5 | 0 |") == text.count("- another: refused: no") == len(stability_deformation.NOTES)
    assert "### Limits" in text
    bad = Row("bad", not_finite=sweeps.count_not_finite(torch.tensor([1.0, torch.nan, torch.inf])))
    with pytest.raises(AssertionError):
        assert_contained([bad])
