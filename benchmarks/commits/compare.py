"""Two commits of this repository, run in turns: is anything slower? Look before it lands.

    python -m benchmarks compare A B [NAME ...] [--repeats 5] [--threshold 3] [--gate] [--out DIR] [--json] [-- ARGUMENTS OF THE ONE BENCHMARK]

A and B are what git takes for a commit; `.` or `worktree` is the working tree as it is. Each commit is checked out into a folder that is gone
afterwards, and runs its own code with this Python. NAMEs are benchmarks that print numbers with --json: {quick} by default, with few
and small repetitions; others want their arguments behind `--`:

    python -m benchmarks compare main . frame --repeats 8 --gate -- --asset ASSET --no-server

After one run of each that compiles, runs go A B, B A, A B, ... Each time and rate gets the medians of A and B, the median of the pairs' ratios
B / A with the middle half of them and the least and the most, and a verdict: `slower` or `faster` where the ratio is more than --threshold
percent from 1 and the pairs agree on the side, all but one in eight; else `same` (benchmarks/commits/_compare_runs.py has the rule). With fewer than five pairs
agreement proves nothing, so --gate refuses them. Other figures are listed where they differ. Paths in arguments are those of the folder where you are. What git ignores
(the built viewer, node_modules) is the working tree's on both sides. With --gate the exit code is 1 if anything is slower.
--out DIR keeps the document of every run, in DIR/runs.jsonl, and has the checkouts in DIR/A and DIR/B meanwhile.
"""

import argparse
import json
import sys
import tempfile
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from benchmarks.commits._check_out import checked_out
from benchmarks.commits._compare_runs import DEFAULT_THRESHOLD_PERCENT, PAIRS_THAT_PROVE, compare_runs
from benchmarks.commits._run_in_turns import run_in_turns
from benchmarks.measures.machine import machine
from benchmarks.measures.report_table import markdown_table
from benchmarks.scenes.torus_workload import write_torus_workload

REPOSITORY = Path(__file__).resolve().parents[2]
QUICK = {
    "rasterize": ["--scene", "{torus}", "--repeats", "9"],
    "simulate": ["--particles", "8000", "--frames", "20"],
    "carry": ["--surfels", "50000", "--particles", "8000", "--repeats", "15"],
}
"""Seconds a run, of which most is to load torch and Warp."""
TORUS_SURFELS = 20_000


@dataclass(frozen=True)
class CompareSettings:
    """What is compared, and how often."""

    a: str
    b: str
    benchmarks: dict[str, list[str]]
    """Arguments by name."""
    repeats: int
    """Pairs of runs."""
    threshold_percent: float


def main(arguments: list[str]) -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks compare",
        description=(__doc__ or "").format(quick=", ".join(QUICK)),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("a", metavar="A")
    parser.add_argument("b", metavar="B")
    parser.add_argument("names", metavar="NAME", nargs="*", help=f"default: {', '.join(QUICK)}")
    parser.add_argument("--repeats", type=int, default=5, help="pairs of runs (default: 5)")
    parser.add_argument("--threshold", type=float, default=DEFAULT_THRESHOLD_PERCENT, metavar="PERCENT", help="default: 3")
    parser.add_argument("--gate", action="store_true", help="exit code 1 if anything is slower")
    parser.add_argument("--out", type=Path, metavar="DIR", help="default: a temporary folder")
    parser.add_argument("--json", action="store_true")
    behind = arguments.index("--") if "--" in arguments else len(arguments)
    given = parser.parse_intermixed_args(arguments[:behind])
    if given.repeats < 1 or given.threshold <= 0:
        raise ValueError(f"--repeats and --threshold are {given.repeats} and {given.threshold}; expected at least 1, and more than 0")
    if given.gate and given.repeats < PAIRS_THAT_PROVE:
        raise ValueError(f"--repeats is {given.repeats}; a gate wants at least {PAIRS_THAT_PROVE} pairs, for fewer may agree by chance")
    benchmarks = asked_benchmarks(given.names, arguments[behind + 1 :])
    settings = CompareSettings(given.a, given.b, benchmarks, given.repeats, given.threshold)
    with ExitStack() as stack:
        folder = given.out or Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="drgs_compare_")))
        folder.mkdir(parents=True, exist_ok=True)
        result = compare_commits(REPOSITORY, settings, folder)
    print(json.dumps(result) if given.json else table(result))
    if given.gate and any(entry["verdict"] == "slower" for entries in result["benchmarks"].values() for entry in entries.values()):
        sys.exit(1)


def asked_benchmarks(names: Sequence[str], arguments: list[str]) -> dict[str, list[str]]:
    """The arguments of each benchmark that is to run; those of the user stand in place of the quick ones.

    Raises:
        ValueError: there are arguments, but not exactly one benchmark that they could belong to.
    """
    if arguments and len(names) != 1:
        raise ValueError(f"arguments behind -- are those of one benchmark; {', '.join(names) or 'none'} named")
    return {name: arguments or QUICK.get(name, []) for name in names or QUICK}


def compare_commits(repository: Path, settings: CompareSettings, folder: Path) -> dict:
    """Run all benchmarks in both commits; what `--json` prints. The folder gets runs.jsonl."""
    torus = folder.resolve() / "torus.npz"
    if any("{torus}" in arguments for arguments in settings.benchmarks.values()):
        write_torus_workload(torus, TORUS_SURFELS)
    compared, figures = {}, {}
    with checked_out(repository, (settings.a, settings.b), folder) as sides, (folder / "runs.jsonl").open("w") as runs:
        for name, arguments in settings.benchmarks.items():
            pairs = []
            for a, b in run_in_turns(sides, name, [text.replace("{torus}", str(torus)) for text in arguments], settings.repeats):
                pairs.append((a, b))
                runs.write(json.dumps({"benchmark": name, "pair": len(pairs), "a": a, "b": b}) + "\n")
                runs.flush()
            comparison = compare_runs(pairs, settings.threshold_percent)
            compared[name], figures[name] = comparison.times, comparison.figures
        return {
            "a": sides[0].title,
            "b": sides[1].title,
            "repeats": settings.repeats,
            "threshold_percent": settings.threshold_percent,
            "benchmarks": compared,
            "figures": figures,
            "machine": machine(),
        }


def table(result: dict) -> str:
    """For people: times and rates, then other figures that differ."""
    lines = [f"A: {result['a']}", f"B: {result['b']}", f"{result['repeats']} pairs of runs, {result['machine']}"]
    for name, entries in result["benchmarks"].items():
        rows: list[dict[str, object]] = [
            {
                name: key,
                "A": f"{entry['a']:.6g}",
                "B": f"{entry['b']:.6g}",
                "B / A": f"{entry['ratio']:.3f}",
                "middle half": " to ".join(f"{quartile:.3f}" for quartile in entry["quartiles"]),
                "least to most": f"{entry['least']:.3f} to {entry['most']:.3f}",
                "verdict": entry["verdict"],
            }
            for key, entry in entries.items()
        ]
        columns = [name, "A", "B", "B / A", "middle half", "least to most", "verdict"]
        lines += ["", markdown_table(rows, columns) if rows else f"{name}: prints no time and no rate."]
        lines += [f"{name}: {key} is {found['a']} in A, {found['b']} in B." for key, found in result["figures"][name].items()]
    return "\n".join(lines)


if __name__ == "__main__":
    main(sys.argv[1:])
