"""Memory that was freed goes back to the system.

The allocator of glibc keeps what threads free, a heap for each, since it may be asked for again; a server that drew large pictures on several threads
holds their memory for ever. `malloc_trim` gives it back. Source: malloc_trim(3), Linux man-pages.
"""

import ctypes
from collections.abc import Callable


def memory_returner() -> Callable[[], None]:
    """What gives freed memory back; nothing where the C library has no such call (musl, macOS)."""
    try:
        trim = ctypes.CDLL(None).malloc_trim
    except (AttributeError, OSError, TypeError):
        return lambda: None
    trim.argtypes, trim.restype = [ctypes.c_size_t], ctypes.c_int

    def give_back() -> None:
        trim(0)

    return give_back
