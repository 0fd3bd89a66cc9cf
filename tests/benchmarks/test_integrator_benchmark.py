"""Times to a given error are read off measured points as the table says."""

import pytest

from benchmarks.integrator import time_to_error

ROWS = [{"spp": n, "relmse": 0.8 / n, "seconds": 0.01 * n} for n in (64, 8, 16)]


@pytest.mark.parametrize("target", [1.0, 0.07, 0.0125, 0.001])
def test_time_to_an_error_follows_the_curve_between_and_beyond_its_points(target: float) -> None:
    assert time_to_error(ROWS, target, "seconds") == pytest.approx(0.01 * 0.8 / target, rel=1e-6)
