"""How many steps work takes, whatever the machine is doing beside: calls of functions."""

import sys
from collections.abc import Callable


def count_calls(work: Callable[[], object]) -> int:
    """Of functions, Python's and C's, while `work` runs."""
    count = 0

    def see(frame: object, event: str, argument: object) -> None:
        nonlocal count
        count += event in ("call", "c_call")

    sys.setprofile(see)
    try:
        work()
    finally:
        sys.setprofile(None)
    return count
