"""What a user of the viewer waits for, within what the viewer promises: the benchmark's own figures, from a short run of it."""

import pytest

from benchmarks.viewer import bundle_bytes, measure_edits_and_local, measure_traced, started

ATTEMPTS = 3
"""Of a measurement on a machine that others may use too: one that keeps a promise shows that the code does."""
REPEATS, TURN_SECONDS = 3, 2.0
AT_MOST = {"edit_to_pixel_ms": 250, "reconnect_s": 2, "bundle_gz_kb": 1500}
AT_LEAST = {"local_fps": 30, "traced_fps": 5}


def missed(measured: dict[str, float]) -> list[str]:
    too_much = [name for name, most in AT_MOST.items() if measured.get(name, 0) > most]
    too_little = [name for name, least in AT_LEAST.items() if measured.get(name, least) < least]
    return [f"{name} is {measured[name]}" for name in too_much + too_little]


@pytest.mark.alone
def test_the_viewer_is_as_quick_as_promised(built: None) -> None:
    taken = {"bundle_gz_kb": bundle_bytes() / 1000}
    with started(None) as viewer:
        for take in (lambda: measure_edits_and_local(viewer, REPEATS, TURN_SECONDS), lambda: measure_traced(viewer, TURN_SECONDS)):
            for _ in range(ATTEMPTS):
                measured = take()
                print(measured)
                if not missed(measured):
                    break
            taken |= measured
    assert taken.keys() >= AT_MOST.keys() | AT_LEAST.keys()
    assert missed(taken) == []


def test_a_promise_that_is_not_kept_is_named() -> None:
    assert missed({"edit_to_pixel_ms": 250, "reconnect_s": 2, "local_fps": 30, "traced_fps": 5}) == []
    assert missed({"reconnect_s": 2.1, "local_fps": 29.9}) == ["reconnect_s is 2.1", "local_fps is 29.9"]
