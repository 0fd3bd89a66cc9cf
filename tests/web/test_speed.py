"""What a user of the viewer waits for, within what the viewer promises: the benchmark's own figures, from a short run of it.

Rates are promised on machines that can keep them: each is held against what the machine itself did in the same minute (a page that draws
nothing but a ball; the renderer without server and browser), since the machines that run this differ by a factor of three from hour to hour.
"""

import pytest

from benchmarks.serve.viewer import bundle_bytes, measure_bare_local, measure_bare_traced, measure_edits_and_local, measure_traced, started

ATTEMPTS = 3
"""Of a measurement on a machine that others may use too: one that keeps a promise shows that the code does."""
REPEATS, TURN_SECONDS = 3, 1.0
AT_MOST = {"edit_to_pixel_ms": 250, "reconnect_s": 2, "bundle_gz_kb": 1500}
AT_LEAST = {"local_fps": 30, "traced_fps": 5}
SHARE_OF_BARE = {"local_fps": 0.6, "traced_fps": 0.6}
"""Of the rate that the machine allows, where that is too little for the promise."""


def missed(measured: dict[str, float]) -> list[str]:
    too_much = [f"{name} is {measured[name]}" for name, most in AT_MOST.items() if measured.get(name, 0) > most]
    too_little = []
    for name, least in AT_LEAST.items():
        allowed = measured.get(f"bare_{name}", float("inf"))
        if name in measured and measured[name] < min(least, SHARE_OF_BARE[name] * allowed):
            too_little.append(f"{name} is {measured[name]}, of {allowed} by itself")
    return too_much + too_little


@pytest.mark.alone
def test_the_viewer_is_as_quick_as_promised(built: None) -> None:
    taken = {"bundle_gz_kb": bundle_bytes() / 1000}
    with started(None) as viewer:
        for take, take_bare in (
            (lambda: measure_edits_and_local(viewer, REPEATS, TURN_SECONDS), lambda: measure_bare_local(viewer, TURN_SECONDS)),
            (lambda: measure_traced(viewer, TURN_SECONDS), lambda: measure_bare_traced(viewer, TURN_SECONDS)),
        ):
            for _ in range(ATTEMPTS):
                measured = take()
                if missed(measured):  # only then it matters what the machine allows
                    measured |= take_bare()
                print(measured)
                if not missed(measured):
                    break
            taken |= measured
    assert taken.keys() >= AT_MOST.keys() | AT_LEAST.keys()
    assert missed(taken) == []


def test_a_promise_that_is_not_kept_is_named() -> None:
    assert missed({"edit_to_pixel_ms": 250, "reconnect_s": 2, "local_fps": 30, "traced_fps": 5}) == []
    assert missed({"reconnect_s": 2.1, "local_fps": 29.9}) == ["reconnect_s is 2.1", "local_fps is 29.9, of inf by itself"]


def test_a_slow_machine_lowers_what_is_due_and_a_quick_one_does_not_raise_it() -> None:
    assert missed({"local_fps": 12, "bare_local_fps": 20, "traced_fps": 3, "bare_traced_fps": 5}) == []
    assert missed({"local_fps": 11.9, "bare_local_fps": 20}) == ["local_fps is 11.9, of 20 by itself"]
    assert missed({"local_fps": 30, "bare_local_fps": 60}) == []
    assert missed({"local_fps": 29, "bare_local_fps": 60}) == ["local_fps is 29, of 60 by itself"]
