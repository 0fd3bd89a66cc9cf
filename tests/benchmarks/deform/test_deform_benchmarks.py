import json

import pytest

from benchmarks.deform import arap, carry, simulate


def test_the_simulation_benchmark_prints_one_document_with_its_time(capsys):
    simulate.main(["--particles", "216", "--young", "1e3", "--frames", "1", "--json"])
    result = json.loads(capsys.readouterr().out)
    assert result["particles"] == 216 and result["ms_per_frame"] > 0


def test_the_carrying_benchmark_prints_one_document_with_its_time(capsys):
    carry.main(["--surfels", "500", "--particles", "216", "--repeats", "1", "--json"])
    result = json.loads(capsys.readouterr().out)
    assert result["surfels"] == 500 and result["ms"] > 0


def test_the_sweep_shows_our_second_order_ahead_of_the_papers_at_every_number_of_neighbours(capsys):
    carry.main(["--sweep", "--surfels", "300", "--particles", "216", "--repeats", "1", "--json"])
    rows = json.loads(capsys.readouterr().out)["sweep"]
    assert {row["particles"] for row in rows} == {216, 1728} and all(row["ms"] > 0 for row in rows)
    best = {}
    for row in rows:
        if row["neighbours"] >= 16 and row["particles"] == 1728:
            best.setdefault(row["neighbours"], {})[row["variant"]] = row["position_rms"]
    assert len(best) == 3
    for errors in best.values():
        assert errors["ours, p = 2"] < 0.3 * min(errors["paper, p = 1"], errors["paper, p = 2"], errors["ours, p = 1"])


def test_smaller_time_steps_cost_more_and_end_nearer_to_the_truth(capsys):
    simulate.main(["--sweep", "--particles", "216", "--young", "1e4", "--json"])
    rows = json.loads(capsys.readouterr().out)["sweep"]
    assert [row["courant"] for row in rows] == sorted(row["courant"] for row in rows) and rows[0]["substeps"] > rows[-1]["substeps"]
    assert rows[1]["position_rms"] < rows[-1]["position_rms"] and all(row["retries"] == 0 for row in rows)


def test_the_dragging_benchmark_prints_one_document_with_its_rate(capsys):
    arap.main(["--faces", "1200", "--surfels", "100", "--updates", "2", "--json"])
    result = json.loads(capsys.readouterr().out)
    assert result["faces"] == pytest.approx(1200, rel=0.1) and result["updates_per_second"] > 0 and result["unconverged"][0] < 0.1


def test_the_error_tables_show_the_paper_behind_ours(capsys):
    carry.main(["--errors", "--json"])
    tables = json.loads(capsys.readouterr().out)
    far = tables["interpolation"][2]
    assert far["taylor"] < far["paper_centred"] < far["paper"]
    shear = next(row for row in tables["surfels"] if row["gradient"] == "shear x += 1.0 z")
    assert shear["normal_degrees"] == pytest.approx(26.6, abs=0.1) and shear["covariance_ascending"] == pytest.approx(0.63, abs=0.01)
