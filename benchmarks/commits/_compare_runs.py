"""What the documents of two commits say of their speed. It knows numbers and their keys, not how they came about.

A number is a time or a rate by its key: one of the words between its dots and underscores is a unit of time, or names a rate. It is
compared by the ratio B / A of the two runs of each pair, which the machine treats most alike. The rule of the verdict:

`slower` or `faster` is what meets all of these, anything else is `same`:
1. The median of the ratios is more than the threshold from 1: beyond 1 + t, or below 1 / (1 + t).
2. Pairs agree: their ratios lie on the median's side of 1, all but one in eight. From five pairs on that is a sign test at 5 %; fewer pairs
   prove nothing, though they may all agree.
3. The medians of A and B differ by more than one unit of the last digit that is printed, so that rounding is not taken for a change.
Of a rate, more is faster.
"""

import math
import re
import statistics
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from decimal import Decimal
from typing import Any

from benchmarks.measures.report_table import flat_figures

TIME_WORDS = {"ns", "us", "ms", "s", "nanoseconds", "microseconds", "milliseconds", "seconds", "minutes"}
RATE_WORDS = {"fps", "hz"}
RATE_ENDS = re.compile(r"(per|a)_(second|minute|s)(_|\.|$)")
PAIRS_A_DISSENTER = 8
PAIRS_THAT_PROVE = 5
"""All five on one side have a probability of 1 / 32 where nothing differs."""
DEFAULT_THRESHOLD_PERCENT = 3.0


@dataclass(frozen=True)
class Comparison:
    """Of one benchmark, by dotted keys."""

    times: dict[str, dict]
    """Times and rates: {"a", "b", "ratio", "least", "most", "quartiles", "verdict"}."""
    figures: dict[str, dict]
    """What else differs, and times that are zero or that only one side prints: {"a", "b"}, medians of numbers, null where there is none."""


def compare_runs(pairs: Sequence[tuple[dict, dict]], threshold_percent: float = DEFAULT_THRESHOLD_PERCENT) -> Comparison:
    """Compare the documents (of A, of B) of each pair of runs."""
    runs_a, runs_b = ([dict(leaves(pair[side])) for pair in pairs] for side in (0, 1))
    times, figures = {}, {}
    for key in dict.fromkeys(key for run in (*runs_a, *runs_b) for key in run):
        values_a, values_b = ([run[key] for run in runs if key in run] for runs in (runs_a, runs_b))
        if kind_of(key) != "figure" and len(values_a) == len(values_b) == len(pairs) and all(map(_is_positive, values_a + values_b)):
            times[key] = compare_times(values_a, values_b, threshold_percent, kind_of(key) == "rate")
        elif (typical_a := _typical(values_a)) != (typical_b := _typical(values_b)):
            figures[key] = {"a": typical_a, "b": typical_b}
    return Comparison(times, figures)


def leaves(document: object, name: str = "") -> Iterator[tuple[str, Any]]:
    """(dotted name, value) of all that is no list and no object; items of lists have their numbers as names."""
    for key, value in flat_figures(document, name):
        if isinstance(value, list):
            for number, item in enumerate(value):
                yield from leaves(item, f"{key}.{number}" if key else str(number))
        else:
            yield key, value


def kind_of(key: str) -> str:
    """`time`, `rate` or `figure`.

    The words of the keys around it count, too: `milliseconds.trace` is a time.
    """
    words = set(re.split(r"[._ ]", key))
    if RATE_ENDS.search(key) or words & RATE_WORDS:
        return "rate"
    return "time" if words & TIME_WORDS else "figure"


def compare_times(values_a: Sequence[float], values_b: Sequence[float], threshold_percent: float, is_rate: bool) -> dict:
    """The entry of one number, from its value in each run, pair by pair."""
    ratios = [b / a for a, b in zip(values_a, values_b, strict=True)]
    ratio, median_a, median_b = (statistics.median(values) for values in (ratios, values_a, values_b))
    quartiles = statistics.quantiles(ratios, n=4, method="inclusive") if len(ratios) > 1 else [ratio] * 3
    beyond = max(ratio, 1 / ratio) > 1 + threshold_percent / 100
    agreeing = sum((each > 1) == (ratio > 1) and each != 1 for each in ratios)
    agreed = len(ratios) - agreeing <= len(ratios) // PAIRS_A_DISSENTER
    printed = abs(median_b - median_a) > 1.001 * _last_digit([*values_a, *values_b])  # 0.4 - 0.3 > 0.1, to a computer
    verdict = "same"
    if beyond and agreed and printed:
        verdict = "slower" if (ratio > 1) != is_rate else "faster"
    return {
        "a": float(f"{median_a:.6g}"),
        "b": float(f"{median_b:.6g}"),
        "ratio": round(ratio, 4),
        "least": round(min(ratios), 4),
        "most": round(max(ratios), 4),
        "quartiles": [round(quartiles[0], 4), round(quartiles[2], 4)],
        "verdict": verdict,
    }


def _is_positive(value: Any) -> bool:
    return _is_number(value) and value > 0


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _typical(values: Sequence[Any]) -> Any:
    """The median of numbers, the first of others, None of none."""
    if values and all(map(_is_number, values)):
        return statistics.median(values)
    return values[0] if values else None


def _last_digit(values: Sequence[float]) -> float:
    """The unit of the finest digit that any of the numbers is printed with."""
    return min(10.0 ** int(Decimal(repr(value)).as_tuple().exponent) for value in values)
