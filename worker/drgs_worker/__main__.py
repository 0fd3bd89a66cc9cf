"""`python -m drgs_worker --data DIR`: how the server starts its worker."""

import argparse
import sys
from pathlib import Path

from drgs_worker.run import run_worker


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m drgs_worker")
    parser.add_argument("--data", type=Path, default=None)
    parser.add_argument("--device", choices=["auto", "cpu", "cuda"], default=None)
    parser.add_argument("--parent-pid", type=int, default=None, help="end when this process is gone")
    arguments = parser.parse_args()
    try:
        return run_worker(arguments.data, arguments.device, arguments.parent_pid)
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1


if __name__ == "__main__":
    sys.exit(main())
