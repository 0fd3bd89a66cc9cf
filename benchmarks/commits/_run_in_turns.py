"""One benchmark in both trees: A B, B A, A B, ..., so that what changes on the machine meanwhile meets both alike.

In: the sides, the benchmark's name and arguments. Out: the JSON documents of each pair of runs. Each run is a process of its own.
"""

import json
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence

from benchmarks.commits._check_out import Side

LAST_LINES = 12
"""Of what a failed run said."""


def run_in_turns(sides: tuple[Side, Side], name: str, arguments: Sequence[str], repeats: int) -> Iterator[tuple[dict, dict]]:
    """Documents of A and of B, pair by pair, after a run of each that compiles and is not counted.

    Raises:
        ValueError: a run failed, or printed something else than one document.
    """
    for side in sides:
        _say(f"{name}, warm-up of {side.letter}")
        run_once(side, name, arguments)
    for pair in range(repeats):
        documents = {}
        for side in turned(sides, pair):
            started = time.perf_counter()
            documents[side.letter] = run_once(side, name, arguments)
            _say(f"{name}, pair {pair + 1} of {repeats}: {side.letter} ran for {time.perf_counter() - started:.1f} s")
        yield documents["A"], documents["B"]


def turned(sides: tuple[Side, Side], pair: int) -> tuple[Side, Side]:
    """In the order in which they run in that pair, counted from 0."""
    return sides if pair % 2 == 0 else (sides[1], sides[0])


def run_once(side: Side, name: str, arguments: Sequence[str]) -> dict:
    """The document of one run of `python -m benchmarks NAME`, started where the user is, so that paths mean what they mean there."""
    command = [sys.executable, "-m", "benchmarks", name, *arguments, "--json"]
    done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True, env=side.environment())
    said = "\n".join(done.stderr.strip().splitlines()[-LAST_LINES:])
    if done.returncode != 0:
        raise ValueError(f"{name} of {side.letter} ({side.title}) ended with exit code {done.returncode}; its stderr ends: {said}")
    try:
        document = json.loads(done.stdout)
    except json.JSONDecodeError as error:
        raise ValueError(f"{name} of {side.letter} ({side.title}) printed no JSON ({error}), but {done.stdout[:200]!r}") from error
    if not isinstance(document, dict):
        raise ValueError(f"{name} of {side.letter} ({side.title}) printed a {type(document).__name__}; expected one JSON object")
    return document


def _say(line: str) -> None:
    print(f"compare: {line}", file=sys.stderr, flush=True)
