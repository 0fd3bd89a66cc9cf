"""How idle threads of torch and NumPy wait for work. Read when these are loaded, so to be chosen before.

A fit is thousands of small operations, each given to all cores. Threads that sleep at once between them are woken too late: a step of stage 1
on a quiet machine of two cores takes 0.23 s, 0.15 s where they look for work a while first. GNU's default is to look for so long that two
programs on one machine stop each other: the same step beside another fit takes 1.5 s, 0.32 s with SPINS and 0.23 to 0.30 s asleep.

NumPy's and SciPy's matrices have threads of their own (OpenBLAS), which look for work for 20 milliseconds of a core after each product of matrices. They are
few among torch's operations: they sleep at once. 50 small solves with pauses between take 0.23 s of a core, where they took 0.98.
"""

import os

SPINS = "3000"
"""Of GNU's OpenMP, which torch's packages for Linux bring: a fraction of a millisecond."""
ASLEEP = "0"
BLAS_ASLEEP = "4"
"""OPENBLAS_THREAD_TIMEOUT, in log2 of clock ticks: the least that it takes. Its own is 26."""


def spin_briefly() -> None:
    """For programs that fit or render and do little else. What the user has set holds."""
    _choose(SPINS)


def spin_briefly_unless_told() -> None:
    """For who imports the library: what the user has set holds, and what the program that started this one chose."""
    if "GOMP_SPINCOUNT" not in os.environ:
        spin_briefly()


def sleep_at_once() -> None:
    """For a server, whose threads must not be in each other's way. What the user has set holds."""
    _choose(ASLEEP)


def spin_unless_told() -> bool:
    """Whether idle threads look for work before they sleep, and not because the user wants it so: brief_waits.py may shorten that. Also where torch was
    loaded before drgs, and does not know what was chosen."""
    return "OMP_WAIT_POLICY" not in os.environ and os.environ.get("GOMP_SPINCOUNT", SPINS) == SPINS


def _choose(spins: str) -> None:
    # A server's worker inherits the server's choice, which is not the user's.
    if "OMP_WAIT_POLICY" not in os.environ and os.environ.get("GOMP_SPINCOUNT", spins) in (SPINS, ASLEEP):
        os.environ["GOMP_SPINCOUNT"] = spins
        os.environ.setdefault("OPENBLAS_THREAD_TIMEOUT", BLAS_ASLEEP)
