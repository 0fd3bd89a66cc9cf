"""The size of moving pictures follows the machine and cannot spiral down."""

from itertools import pairwise

from drgs_server.live.pace import TARGET_SECONDS, Pace

WIDTH, HEIGHT = 960, 720


def measure(pace: Pace, seconds_at_full_size: float, fixed_seconds: float = 0.0) -> float:
    """One moving picture on a machine with this cost; returns its scale."""
    scale = pace.scale(WIDTH, HEIGHT)
    pace.measured(int(WIDTH * scale), int(HEIGHT * scale), scale, fixed_seconds + seconds_at_full_size * scale**2)
    return scale


def test_a_fast_machine_always_sends_full_size() -> None:
    pace = Pace()
    assert {measure(pace, 0.01) for _ in range(20)} == {1.0}


def test_a_slow_machine_goes_to_half_and_no_further() -> None:
    pace = Pace()
    scales = [measure(pace, 5.0) for _ in range(20)]
    assert scales[0] == 1.0 and set(scales[1:]) == {0.5}


def test_a_fixed_cost_a_picture_does_not_pull_the_size_down() -> None:
    pace = Pace()
    scales = [measure(pace, 0.055, fixed_seconds=0.02) for _ in range(50)]
    # 75 ms at full size is within the target; a controller that trusted small pictures would end at half.
    assert scales[-1] == 1.0


def test_the_size_recovers_when_the_machine_does() -> None:
    pace = Pace()
    for _ in range(5):
        measure(pace, 1.0)
    assert measure(pace, 1.0) == 0.5
    assert [measure(pace, 0.02) for _ in range(10)][-1] == 1.0


def test_the_size_recovers_from_a_slow_start_though_small_pictures_cost_more_a_pixel() -> None:
    pace = Pace()
    measure(pace, 0.5)
    scales = [measure(pace, 0.03, fixed_seconds=0.02) for _ in range(80)]
    assert scales[0] == 0.5 and scales[-1] == 1.0, "50 ms at full size; what small ones cost says 80"
    assert len([scale for scale, next_ in pairwise(scales) if next_ < scale]) <= 1


def test_a_larger_size_is_tried_ever_more_seldom_where_it_is_too_slow() -> None:
    pace = Pace()
    scales = [measure(pace, 0.12) for _ in range(600)]
    tried = [k for k, scale in enumerate(scales) if scale == 1.0][1:]
    assert set(scales[1:]) == {0.75, 1.0} and 3 <= len(tried) <= 5
    assert all(b >= a for a, b in pairwise([b - a for a, b in pairwise(tried)]))
    slow = Pace()
    assert {measure(slow, 0.5) for _ in range(200)} == {1.0, 0.5}, "twice as long as wanted at the least: not tried"
    assert [measure(slow, 0.5) for _ in range(200)].count(1.0) == 0


def test_reduced_pictures_that_are_too_slow_get_smaller_and_larger_again_when_others_are_gone() -> None:
    pace = Pace()
    assert [measure(pace, 0.1) for _ in range(10)][-1] == 0.75
    busy = [measure(pace, 0.2) for _ in range(10)]
    assert busy[-1] == 0.6 and sorted(busy, reverse=True) == busy, "0.2 * 0.75**2 is more than is wanted, 0.2 * 0.6**2 is not"
    assert [measure(pace, 0.1) for _ in range(10)][-1] == 0.75


def test_the_size_does_not_flicker_at_a_limit() -> None:
    pace = Pace()
    scales = [measure(pace, TARGET_SECONDS + (0.001 if k % 2 else -0.001)) for k in range(60)]
    assert sum(a != b for a, b in pairwise(scales[5:])) <= 2, "but for the one picture that is tried larger"


def test_small_pictures_are_not_reduced() -> None:
    pace = Pace()
    for _ in range(3):
        pace.measured(300, 200, 1.0, 3.0)
    assert pace.scale(300, 200) == 1.0
    assert pace.scale(640, 480) == 0.5
