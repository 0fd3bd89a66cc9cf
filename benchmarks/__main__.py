"""`python -m benchmarks NAME ...`: run one benchmark; `--help` after the name lists its arguments."""

import sys
from importlib import import_module
from pathlib import Path

from drgs.openmp import spin_briefly

HERE = Path(__file__).parent
FOLDERS = ("reconstruct", "deform", "render", "convert", "serve", "commits")
"""Each file in them is a benchmark with a `main(arguments)`, but for those whose names begin with _."""
MODULES = {path.stem: f"{folder}.{path.stem}" for folder in FOLDERS for path in (HERE / folder).glob("[!_]*.py")}
MODULES |= {path.parent.name: f"{path.parent.name}.command" for path in HERE.glob("*/command.py")}
"""And so is each folder whose command.py has one."""
NAMES = tuple(sorted(MODULES))


def main(arguments: list[str]) -> None:
    """Run the benchmark that the first argument names with the rest.

    Raises:
        ValueError: there is no such benchmark.
    """
    if not arguments or arguments[0] in ("-h", "--help"):
        print(f"usage: python -m benchmarks {{{','.join(NAMES)}}} ...")
        return
    if arguments[0] not in NAMES:
        raise ValueError(f"there is no benchmark {arguments[0]!r}; expected one of {', '.join(NAMES)}")
    spin_briefly()  # as `drgs` does
    import_module(f"benchmarks.{MODULES[arguments[0]]}").main(arguments[1:])


if __name__ == "__main__":
    try:
        main(sys.argv[1:])
    except (ValueError, OSError) as error:
        print(f"benchmarks: {error}", file=sys.stderr)
        sys.exit(2)
