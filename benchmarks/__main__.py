"""`python -m benchmarks NAME ...`: run one benchmark; `--help` after the name lists its arguments."""

import sys
from importlib import import_module
from pathlib import Path

from drgs.openmp import spin_briefly

HERE = Path(__file__).parent
MODULES = {path.stem: path.stem for path in HERE.glob("*.py") if not path.stem.startswith("_")}
MODULES |= {path.parent.name: f"{path.parent.name}.command" for path in HERE.glob("*/command.py")}
NAMES = tuple(sorted(MODULES))
"""Each file here is a benchmark with a `main(arguments)`, and each folder whose command.py has one."""


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
